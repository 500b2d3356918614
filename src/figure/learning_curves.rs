//! # What it is
//! Return over environment steps, one colour per algorithm.
//!
//! # Definition
//! One line per [`Curve`](crate::figure::Curve); a curve with bands is the mean over seeds with its interval, a curve
//! without is one run, drawn thin.
//!
//! # Shapes and units
//! x: environment steps; y: `Data::unit`. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `curves`, `series`, `references`.
//!
//! # When it fails
//! No curve has a point; a value is not finite.
//!
//! # Reference
//! Agarwal et al., *Deep RL at the Edge of the Statistical Precipice* (2021): curves with intervals over runs.
//!
//! # Differences from the reference implementation
//! The source paper shows no learning curves.

use plotters::prelude::*;

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: NAME,
    summary: "return over environment steps, mean and interval over seeds",
    reference: "Agarwal et al. 2021",
    value: None,
    build: render,
};

const NAME: &str = "learning-curves";

struct Figure<'a> {
    data: &'a Data,
    colors: Vec<(String, RGBColor)>,
    steps: f64,
    values: std::ops::Range<f64>,
}

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    let points = || data.curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p)));
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for (curve, point) in points() {
        let (bottom, top) = point.band.unwrap_or((point.value, point.value));
        for value in [point.step, point.value, bottom, top] {
            if !value.is_finite() {
                let what = format!("a point of {:?} at step {}", curve.series, point.step);
                return Err(FigureError::NotFinite { figure: NAME, what, value });
            }
        }
        (low, high) = (low.min(bottom).min(point.value), high.max(top).max(point.value));
    }
    if low > high {
        return Err(FigureError::Empty { figure: NAME, needs: "curve with points" });
    }
    for line in data.references.iter().filter(|l| l.value.is_finite()) {
        (low, high) = (low.min(line.value), high.max(line.value));
    }
    let shown = data.series.iter().enumerate().filter(|(_, s)| data.curves.iter().any(|c| c.series == **s));
    let colors = shown.map(|(i, s)| (s.clone(), style::color(i))).collect();
    let steps = points().map(|(_, p)| p.step).fold(1.0, f64::max);
    style::render(&Figure { data, colors, steps, values: style::axis(low, high) }, target)
}

/// Steps in the unit that keeps tick labels short.
fn steps_label(value: f64, longest: f64) -> String {
    match longest {
        l if l >= 2e6 => format!("{} M", style::number(value / 1e6, 1)),
        l if l >= 2e4 => format!("{} k", style::number(value / 1e3, 0)),
        _ => style::number(value, 0),
    }
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        (1600, 900)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let below = style::header(area, &self.data.title, &self.data.subtitle, &self.colors, &self.data.references)?;
        let mut chart = ChartBuilder::on(&below)
            .margin_left(26)
            .margin_right(50)
            .margin_bottom(16)
            .x_label_area_size(88)
            .y_label_area_size(140)
            .build_cartesian_2d(0.0..self.steps, self.values.clone())?;
        let x_label = |x: &f64| steps_label(*x, self.steps);
        style::mesh(&mut chart, &self.data.unit, Some("environment steps"), &x_label)?;
        style::draw_references(&mut chart, &self.data.references)?;
        for curve in &self.data.curves {
            let Some((_, color)) = self.colors.iter().find(|(s, _)| *s == curve.series) else {
                continue;
            };
            style::draw_curve(&mut chart, curve, *color, false)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_written_in_thousands_and_millions() {
        assert_eq!(steps_label(1e5, 4e5), "100 k");
        assert_eq!(steps_label(1.5e6, 4e6), "1.5 M");
        assert_eq!(steps_label(500.0, 1000.0), "500");
    }
}
