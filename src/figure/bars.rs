//! What figures of bars share: their groups, and how far the values reach.

use crate::figure::{Data, FigureError};

/// Groups in order of first appearance, and the least and greatest value or end of a whisker, 0 included.
pub(super) fn extent<'a>(data: &'a Data, figure: &'static str) -> Result<(Vec<&'a str>, (f64, f64)), FigureError> {
    if data.bars.is_empty() {
        return Err(FigureError::Empty { figure, needs: "bar" });
    }
    let mut groups: Vec<&str> = Vec::new();
    let (mut low, mut high) = (0.0_f64, 0.0_f64);
    for bar in &data.bars {
        for value in [bar.value, bar.low, bar.high] {
            if !value.is_finite() {
                let what = format!("the bar of {:?} at {:?}", bar.series, bar.group);
                return Err(FigureError::NotFinite { figure, what, value });
            }
            (low, high) = (low.min(value), high.max(value));
        }
        if !groups.contains(&bar.group.as_str()) {
            groups.push(&bar.group);
        }
    }
    Ok((groups, (low, high)))
}
