//! What the figures of links share: curves with bands over an x axis of their own, from 0 up.

use plotters::prelude::*;

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Curve, Data, FigureError, Target};

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
}

struct Figure<'a> {
    how: &'a Lines,
    data: &'a Data,
    curves: &'a [Curve],
    colors: Vec<(String, RGBColor)>,
    x: std::ops::Range<f64>,
    y: std::ops::Range<f64>,
}

/// Draws curves: a band where points have one, else a line alone.
pub(super) fn render(how: &Lines, data: &Data, curves: &[Curve], target: Target<'_>) -> Result<(), FigureError> {
    let figure = how.name;
    let (mut left, mut right, mut top) = (f64::INFINITY, f64::NEG_INFINITY, 0.0_f64);
    for (curve, point) in curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p))) {
        let (low, high) = point.band.unwrap_or((point.value, point.value));
        for value in [point.step, point.value, low, high] {
            if !value.is_finite() {
                let what = format!("a point of {:?} at {}", curve.series, point.step);
                return Err(FigureError::NotFinite { figure, what, value });
            }
        }
        (left, right, top) = (left.min(point.step), right.max(point.step), top.max(high).max(point.value));
    }
    if left > right {
        return Err(FigureError::Empty { figure, needs: how.needs });
    }
    let shown = data.series.iter().enumerate().filter(|(_, s)| curves.iter().any(|c| c.series == **s));
    let colors = shown.map(|(i, s)| (s.clone(), style::color(i))).collect();
    let (x, y) =
        if how.diagonal { (0.0..1.0, 0.0..1.0) } else { (style::axis(left, right), 0.0..(1.06 * top).max(1e-3)) };
    style::render(&Figure { how, data, curves, colors, x, y }, target)
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
        style::mesh(&mut chart, &data.unit, Some(self.how.x_name), &|x| style::number(*x, digits))?;
        style::draw_references(&mut chart, &data.references)?;
        if self.how.diagonal {
            let line = DashedLineSeries::new([(0.0, 0.0), (1.0, 1.0)], 14, 10, style::SOFT.stroke_width(3));
            chart.draw_series(line)?;
        }
        for curve in self.curves {
            let Some((_, color)) = self.colors.iter().find(|(s, _)| *s == curve.series) else {
                continue;
            };
            let band: Vec<_> = curve.points.iter().filter_map(|p| p.band.map(|b| (p.step, b))).collect();
            if self.how.marks {
                let whisker = |&(x, (low, high)): &(f64, (f64, f64))| {
                    PathElement::new(vec![(x, low), (x, high)], color.stroke_width(4))
                };
                chart.draw_series(band.iter().map(whisker))?;
                chart.draw_series(curve.points.iter().map(|p| Circle::new((p.step, p.value), 8, color.filled())))?;
            } else if !band.is_empty() {
                let edge = band.iter().map(|&(x, (low, _))| (x, low));
                let outline: Vec<_> = edge.chain(band.iter().rev().map(|&(x, (_, high))| (x, high))).collect();
                chart.draw_series(std::iter::once(Polygon::new(outline, color.mix(0.18))))?;
            }
            let line = curve.points.iter().map(|p| (p.step, p.value));
            chart.draw_series(LineSeries::new(line, color.stroke_width(if band.is_empty() { 3 } else { 5 })))?;
        }
        Ok(())
    }
}
