//! # What it is
//! Cost against size on two logarithmic axes, one line per series, its exponent in the legend.
//!
//! # Definition
//! One line per [`Curve`]: the size is `Point::step`, the cost `Point::value`. A straight line of
//! slope k is cost ∝ size^k; the legend gives the slope of the least-squares line through the logarithms.
//!
//! # Shapes and units
//! x: size, `agents`; y: `Data::unit`. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `costs`, `series`.
//!
//! # When it fails
//! No curve has a point; a size or a cost is not positive and finite.
//!
//! # Reference
//! Common practice.
//!
//! # Differences from the reference implementation
//! None.

use plotters::prelude::*;

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Curve, Data, FigureError, Render, Target};
use crate::registry::Entry;
use crate::stats::slope;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: NAME,
    summary: "cost against number of agents, with its exponent",
    reference: "common practice",
    value: None,
    build: render,
};

const NAME: &str = "scaling";

/// A curve's legend, colour and the logarithms of its points.
type Line = (String, RGBColor, Vec<(f64, f64)>);

struct Figure<'a> {
    data: &'a Data,
    lines: Vec<Line>,
    sizes: std::ops::Range<f64>,
    costs: std::ops::Range<f64>,
}

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    let mut lines = Vec::new();
    let (mut sizes, mut costs) = ((f64::INFINITY, f64::NEG_INFINITY), (f64::INFINITY, f64::NEG_INFINITY));
    for curve in &data.costs {
        let points = logarithms(curve)?;
        for &(size, cost) in &points {
            sizes = (sizes.0.min(size), sizes.1.max(size));
            costs = (costs.0.min(cost), costs.1.max(cost));
        }
        let color = data.series.iter().position(|s| *s == curve.series).unwrap_or(0);
        let legend = format!("{}: exponent {}", curve.series, style::number(slope(&points), 2));
        lines.push((legend, style::color(color), points));
    }
    if sizes.0 > sizes.1 {
        return Err(FigureError::Empty { figure: NAME, needs: "cost with points" });
    }
    let (sizes, costs) = (style::axis(sizes.0, sizes.1), style::axis(costs.0, costs.1));
    style::render(&Figure { data, lines, sizes, costs }, target)
}

/// The decimal logarithms of a curve's points of positive size; a size of 0 has no place on the axis and is left out.
fn logarithms(curve: &Curve) -> Result<Vec<(f64, f64)>, FigureError> {
    let mut points = Vec::new();
    for point in curve.points.iter().filter(|p| p.step > 0.0) {
        let (size, cost) = (point.step.log10(), point.value.log10());
        if !size.is_finite() || !cost.is_finite() {
            let what = format!("the logarithm of a point of {:?} at {}", curve.series, point.step);
            return Err(FigureError::NotFinite {
                figure: NAME,
                what,
                value: if size.is_finite() { cost } else { size },
            });
        }
        points.push((size, cost));
    }
    Ok(points)
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        (1600, 900)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let legend: Vec<_> = self.lines.iter().map(|(name, color, _)| (name.clone(), *color)).collect();
        let below = style::header(area, &self.data.title, &self.data.subtitle, &legend, &[])?;
        let mut chart = ChartBuilder::on(&below)
            .margin_left(26)
            .margin_right(50)
            .margin_bottom(16)
            .x_label_area_size(88)
            .y_label_area_size(160)
            .build_cartesian_2d(self.sizes.clone(), self.costs.clone())?;
        let label = |exponent: &f64| style::power(*exponent);
        style::mesh_with(&mut chart, (&self.data.unit, &label), (Some("agents"), &label))?;
        for (_, color, points) in &self.lines {
            chart.draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(5)))?;
            chart.draw_series(points.iter().map(|&at| Circle::new(at, 9, color.filled())))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figure::{Point, svg};

    #[test]
    fn the_legend_has_the_exponent_and_ticks_are_powers() {
        let points = [1.0, 10.0, 100.0].map(|n| Point { step: n, value: 0.02 * n * n, band: None });
        let curve = Curve { series: "spread".to_owned(), points: points.to_vec() };
        let data = Data { series: vec!["spread".to_owned()], costs: vec![curve], ..Data::default() };
        assert!(svg(&ENTRY, &data).unwrap().contains("spread: exponent 2.00"));
        assert_eq!([-2.0, 0.0, 1.0, 2.5].map(style::power), ["0.010", "1.0", "10", "316"]);
    }
}
