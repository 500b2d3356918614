//! Values over lags: a line per estimator of a table's pair, or per link of a store.

use crate::cli::estimates::class;
use crate::figure::{Curve, Data, Point};
use crate::mi::{Estimate, Unit};

/// Most lines: as many as there are colours.
const LINES: usize = 8;

/// The lines, and what they are; `None` where no value is finite.
pub(super) fn data(rows: &[Estimate]) -> Option<(Data, String)> {
    // one axis has one unit: that of information, if there is any
    let finite = || rows.iter().filter(|r| r.value.is_finite());
    let first = finite().find(|r| r.unit != Unit::Jsd).or_else(|| finite().next())?;
    let of_links = first.sender.is_some();
    let mut curves: Vec<Curve> = Vec::new();
    for row in finite().filter(|r| r.unit == first.unit && (!of_links || r.estimator == first.estimator)) {
        let series = match (&row.sender, &row.receiver, row.delivered) {
            (Some(sender), Some(receiver), Some(delivered)) => format!("{sender} → {receiver} {}", class(delivered)),
            _ => row.estimator.clone(),
        };
        let point = Point { step: lag(&row.y), value: row.value, band: row.interval_low.zip(row.interval_high) };
        match curves.iter_mut().find(|c| c.series == series) {
            Some(curve) => curve.points.push(point),
            None => curves.push(Curve { series, points: vec![point] }),
        }
    }
    let all = curves.len();
    curves.truncate(LINES);
    for curve in &mut curves {
        curve.points.sort_by(|a, b| a.step.total_cmp(&b.step));
    }
    let y = first.y.rsplit_once("[+").map_or(first.y.as_str(), |(y, _)| y);
    let shown = if all > LINES { format!("; the first {LINES} of {all} lines") } else { String::new() };
    let data = Data {
        title: if of_links { "Mutual information by lag".to_owned() } else { format!("{} ; {y} by lag", first.x) },
        subtitle: if of_links {
            format!("{}: {}, whiskers: 95 % intervals{shown}", first.estimator, first.kind.name())
        } else {
            format!("whiskers: 95 % intervals{shown}")
        },
        unit: format!("mutual information, {}", first.unit.name()),
        series: curves.iter().map(|c| c.series.clone()).collect(),
        mi_by_lag: curves,
        ..Data::default()
    };
    let what = format!("{} lines over lags", data.series.len());
    Some((data, what))
}

/// The lag in the label of a y: `b[+3]`.
fn lag(y: &str) -> f64 {
    let lag = y.rsplit_once("[+").and_then(|(_, lag)| lag.strip_suffix(']')?.parse::<u32>().ok());
    lag.map_or(0.0, f64::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::Kind;
    use crate::schema::SampleLabels;

    #[test]
    fn lines_are_in_one_unit_in_the_order_of_lags_and_links_go_by_their_names() {
        let labels = |y: &str| SampleLabels { x: "a".to_owned(), y: y.to_owned(), ..SampleLabels::default() };
        let row = |name: &str, y: &str, value, unit| Estimate::new(name, &labels(y), value, unit, Kind::Estimate, 9);
        let rows = [
            row("jsd", "b", 0.3, Unit::Jsd),
            row("gaussian", "b[+10]", 0.1, Unit::Nats),
            row("gaussian", "b", 0.4, Unit::Nats),
            row("ksg1:3", "b", f64::INFINITY, Unit::Nats),
            row("ksg1:3", "b[+2]", 0.2, Unit::Nats),
        ];
        let (data, what) = data(&rows).unwrap();
        let found: Vec<Vec<(f64, f64)>> =
            data.mi_by_lag.iter().map(|c| c.points.iter().map(|p| (p.step, p.value)).collect()).collect();
        assert_eq!(found, [vec![(0.0, 0.4), (10.0, 0.1)], vec![(2.0, 0.2)]]);
        assert_eq!((what.as_str(), data.title.as_str()), ("2 lines over lags", "a ; b by lag"));
        let mut many: Vec<Estimate> = (0..9).map(|_| rows[1].clone()).collect();
        for (i, row) in many.iter_mut().enumerate() {
            row.sender = Some(format!("agent_{i}"));
            (row.receiver, row.delivered) = (Some("agent_9".to_owned()), Some(false));
        }
        let (links, _) = super::data(&many).unwrap();
        assert_eq!((links.series.len(), links.series[0].as_str()), (8, "agent_0 → agent_9 lost"));
        assert!(links.subtitle.ends_with("the first 8 of 9 lines"), "{}", links.subtitle);
        assert!(super::data(&rows[3..4]).is_none());
    }
}
