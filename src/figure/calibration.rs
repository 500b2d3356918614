//! # What it is
//! How far estimators are off where the answer is known: error per task, estimators side by side.
//!
//! # Definition
//! One line per task, one mark per estimator at its mean less the truth; the whisker is one standard deviation over draws.
//! Marks beyond 1.5 are drawn hollow at the edge.
//!
//! # Shapes and units
//! x: `Data::unit` (nats), always with 0. 1700 units wide, as high as there are tasks.
//!
//! # Parameters
//! None; it reads `bars` (group: task), `series`. Tasks stand in order of first appearance, from the top.
//!
//! # When it fails
//! There is no bar; a value is not finite.
//!
//! # Reference
//! The tasks: Czyż et al. 2023, arXiv 2306.11078.
//!
//! # Differences from the reference implementation
//! The paper prints a table of rounded values.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Data, FigureError, Render, Target, bars};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: NAME,
    summary: "error of estimators per task of known information",
    reference: "Czyz et al. 2023, arXiv 2306.11078",
    value: None,
    build: render,
};

const NAME: &str = "calibration";
/// Largest error with a place of its own, nats.
const FARTHEST: f64 = 1.5;
/// Height of a task, units.
const LINE: u32 = 38;
/// Width of the tasks' names, units.
const NAMES: u32 = 640;

struct Figure<'a> {
    data: &'a Data,
    groups: Vec<&'a str>,
    colors: Vec<(String, RGBColor)>,
    errors: std::ops::Range<f64>,
}

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    let (groups, (low, high)) = bars::extent(data, NAME)?;
    let shown = data.series.iter().enumerate().filter(|(_, s)| data.bars.iter().any(|b| b.series == **s));
    let colors = shown.map(|(i, s)| (s.clone(), style::color(i))).collect();
    let errors = style::axis(low.max(-FARTHEST), high.min(FARTHEST));
    style::render(&Figure { data, groups, colors, errors }, target)
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        (1700, 360 + 44 * (self.colors.len() as u32 / 4) + LINE * self.groups.len() as u32)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let below = style::header(area, &self.data.title, &self.data.subtitle, &self.colors, &[])?;
        let (count, across) = (self.groups.len() as f64, &self.errors);
        let mut chart = ChartBuilder::on(&below)
            .margin_left(26)
            .margin_right(40)
            .margin_bottom(16)
            .x_label_area_size(88)
            .y_label_area_size(NAMES)
            .build_cartesian_2d(across.clone(), 0.0..count)?;
        let digits = style::decimals(across.end - across.start);
        chart
            .configure_mesh()
            .disable_y_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(style::GRID.stroke_width(2))
            .axis_style(style::SOFT.stroke_width(2))
            .label_style(style::text(style::TICK, style::INK, HPos::Left, VPos::Top))
            .axis_desc_style(style::text(style::LABEL, style::INK, HPos::Left, VPos::Top))
            .x_labels(8)
            .x_desc(style::label(&self.data.unit, 60))
            .x_label_formatter(&|x: &f64| style::number(*x, digits))
            .y_labels(0)
            .draw()?;
        let right = style::reference_color(1).stroke_width(3);
        chart.draw_series(std::iter::once(PathElement::new([(0.0, 0.0), (0.0, count)], right)))?;
        let step = 0.7 / self.colors.len() as f64;
        for bar in &self.data.bars {
            let place = self.groups.iter().position(|g| *g == bar.group).unwrap_or(0) as f64;
            let Some(index) = self.colors.iter().position(|(s, _)| *s == bar.series) else {
                continue;
            };
            let (y, color) = (count - place - 0.15 - step * (index as f64 + 0.5), self.colors[index].1);
            let on = |x: f64| x.clamp(across.start, across.end);
            let whisker = [(on(bar.low), y), (on(bar.high), y)];
            chart.draw_series(std::iter::once(PathElement::new(whisker, color.stroke_width(3))))?;
            let inside = across.contains(&bar.value);
            let style = if inside { color.filled() } else { color.stroke_width(3) };
            chart.draw_series(std::iter::once(Circle::new((on(bar.value), y), 7, style)))?;
        }
        let origin = below.get_pixel_range();
        for (place, group) in self.groups.iter().enumerate() {
            let (x, y) = chart.plotting_area().map_coordinate(&(across.start, count - place as f64 - 0.5));
            let at = (x - origin.0.start - 14, y - origin.1.start);
            let name = style::label(group, 52);
            below.draw_text(&name, &style::text(22.0, style::INK, HPos::Right, VPos::Center), at)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figure::{Bar, svg};

    #[test]
    fn every_task_has_a_name_and_every_estimator_a_mark_also_beyond_the_edge() {
        let bar = |group: &str, series: &str, value: f64| Bar {
            group: group.to_owned(),
            series: series.to_owned(),
            value,
            low: value - 0.01,
            high: value + 0.01,
        };
        let data = Data {
            series: vec!["ksg1:3".to_owned(), "gcmi".to_owned()],
            bars: vec![bar("first", "ksg1:3", -0.1), bar("first", "gcmi", 0.02), bar("second", "gcmi", -400.0)],
            ..Data::default()
        };
        let text = svg(&ENTRY, &data).unwrap();
        assert_eq!(text.matches("<circle").count(), 3);
        let hollow = text.split("<circle").skip(1).filter(|c| c.split("/>").next().unwrap().contains("fill=\"none\""));
        assert_eq!(hollow.count(), 1);
        assert!(["first", "second", "ksg1:3", "gcmi"].iter().all(|name| text.contains(name)), "{text}");
    }
}
