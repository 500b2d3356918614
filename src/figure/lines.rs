//! What figures of curves share: bands or whiskers over an x axis of their own, from 0 up, or from the least value below.

use plotters::prelude::*;

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Curve, Data, FigureError, Point, Target};

/// How a figure of curves looks.
pub(super) struct Lines {
    /// The figure.
    pub(super) name: &'static str,
    /// What it needs, for an error.
    pub(super) needs: &'static str,
    /// Name of the x axis, with its unit.
    pub(super) x_name: &'static str,
    /// Decimals of the ticks of x, or what tells them apart.
    pub(super) x_digits: Option<usize>,
    /// Whether both axes are probabilities, with the diagonal drawn.
    pub(super) diagonal: bool,
    /// Whether points are marked.
    pub(super) marks: bool,
    /// Whether the value axis is logarithmic; values of 0 have no place on it then.
    pub(super) log: bool,
}

struct Figure<'a> {
    how: &'a Lines,
    data: &'a Data,
    curves: Vec<Curve>,
    colors: Vec<(String, RGBColor)>,
    x: std::ops::Range<f64>,
    y: std::ops::Range<f64>,
}

/// Draws curves: a band where points have one, else a line alone.
pub(super) fn render(how: &Lines, data: &Data, curves: &[Curve], target: Target<'_>) -> Result<(), FigureError> {
    let figure = how.name;
    let (mut left, mut right, mut bottom, mut top) = (f64::INFINITY, f64::NEG_INFINITY, 0.0_f64, 0.0_f64);
    for (curve, point) in curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p))) {
        let (low, high) = point.band.unwrap_or((point.value, point.value));
        for value in [point.step, point.value, low, high] {
            if !value.is_finite() {
                let what = format!("a point of {:?} at {}", curve.series, point.step);
                return Err(FigureError::NotFinite { figure, what, value });
            }
        }
        (left, right) = (left.min(point.step), right.max(point.step));
        (bottom, top) = (bottom.min(low).min(point.value), top.max(high).max(point.value));
    }
    if left > right {
        return Err(FigureError::Empty { figure, needs: how.needs });
    }
    let shown = data.series.iter().enumerate().filter(|(_, s)| curves.iter().any(|c| c.series == **s));
    let colors = shown.map(|(i, s)| (s.clone(), style::color(i))).collect();
    let (x, y) = if how.diagonal {
        (0.0..1.0, 0.0..1.0)
    } else {
        (style::axis(left, right), 1.06 * bottom..(1.06 * top).max(1e-3))
    };
    let (curves, y) = if how.log { logarithms(curves, y.end) } else { (curves.to_vec(), y) };
    style::render(&Figure { how, data, curves, colors, x, y }, target)
}

/// The curves by the decimal logarithms of their values, and the axis: from the decade of the smallest value up.
fn logarithms(curves: &[Curve], top: f64) -> (Vec<Curve>, std::ops::Range<f64>) {
    let values = curves.iter().flat_map(|c| c.points.iter().map(|p| p.value)).filter(|&v| v > 0.0);
    let bottom = values.fold(top, f64::min).log10().floor();
    let log = |value: f64| value.log10().max(bottom);
    let point = |p: &Point| Point { value: log(p.value), band: p.band.map(|(a, b)| (log(a), log(b))), ..*p };
    let curve = |curve: &Curve| Curve {
        series: curve.series.clone(),
        points: curve.points.iter().filter(|p| p.value > 0.0).map(point).collect(),
    };
    (curves.iter().map(curve).collect(), bottom..top.log10().max(bottom + 0.1))
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        (1600, 900)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let data = self.data;
        let below = style::header(area, &data.title, &data.subtitle, &self.colors, &data.references)?;
        let mut chart = ChartBuilder::on(&below)
            .margin_left(26)
            .margin_right(50)
            .margin_bottom(16)
            .x_label_area_size(88)
            .y_label_area_size(140)
            .build_cartesian_2d(self.x.clone(), self.y.clone())?;
        let digits = self.how.x_digits.unwrap_or_else(|| style::decimals(self.x.end - self.x.start));
        let x_label = |x: &f64| style::number(*x, digits);
        if self.how.log {
            let y_label = |exponent: &f64| style::power(*exponent);
            style::mesh_with(&mut chart, (&data.unit, &y_label), (Some(self.how.x_name), &x_label))?;
        } else {
            style::mesh(&mut chart, &data.unit, Some(self.how.x_name), &x_label)?;
        }
        style::draw_references(&mut chart, &data.references)?;
        if self.how.diagonal {
            let line = DashedLineSeries::new([(0.0, 0.0), (1.0, 1.0)], 14, 10, style::SOFT.stroke_width(3));
            chart.draw_series(line)?;
        }
        // the first curve, all together, lies on top
        for curve in self.curves.iter().rev() {
            let Some((_, color)) = self.colors.iter().find(|(s, _)| *s == curve.series) else {
                continue;
            };
            style::draw_curve(&mut chart, curve, *color, self.how.marks)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn on_a_logarithmic_axis_nothing_lies_below_the_smallest_values_decade() {
        let point = |value, band| Point { step: 1.0, value, band };
        let points = vec![point(0.5, Some((0.0, 1.0))), point(0.0, None), point(0.02, None)];
        let (curves, axis) = logarithms(&[Curve { series: "a".to_owned(), points }], 1.0);
        assert_eq!(axis, -2.0..0.0);
        let values: Vec<f64> = curves[0].points.iter().map(|p| p.value).collect();
        assert_eq!((values.len(), curves[0].points[0].band), (2, Some((-2.0, 0.0))));
        assert!((values[1] - 0.02_f64.log10()).abs() < 1e-12);
    }
}
