//! # What it is
//! Return per test channel and algorithm: grouped bars with whiskers.
//!
//! # Definition
//! One group per channel, one bar per algorithm from 0 to its mean return; what a whisker spans is said in the
//! subtitle (an interval over seeds, or one standard deviation over episodes).
//!
//! # Shapes and units
//! y: `Data::unit`, always with 0. 1800 × 950 units.
//!
//! # Parameters
//! None; it reads `bars`, `series`, `references`. Groups stand in order of first appearance.
//!
//! # When it fails
//! There is no bar; a value is not finite.
//!
//! # Reference
//! The source paper's performance table, columns as channels.
//!
//! # Differences from the reference implementation
//! The paper prints deviations over episodes of one seed without saying so in the table.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Data, FigureError, Render, Target, bars};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: NAME,
    summary: "return per test channel and algorithm, bars with whiskers",
    reference: "the source paper's performance table",
    value: None,
    build: render,
};

const NAME: &str = "channel-returns";

struct Figure<'a> {
    data: &'a Data,
    groups: Vec<&'a str>,
    colors: Vec<(String, RGBColor)>,
    values: std::ops::Range<f64>,
}

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    let (groups, (mut low, mut high)) = bars::extent(data, NAME)?;
    for line in data.references.iter().filter(|l| l.value.is_finite()) {
        (low, high) = (low.min(line.value), high.max(line.value));
    }
    let shown = data.series.iter().enumerate().filter(|(_, s)| data.bars.iter().any(|b| b.series == **s));
    let colors = shown.map(|(i, s)| (s.clone(), style::color(i))).collect();
    let air = style::axis(low, high);
    // bars stand on 0: no air beyond it on the side where nothing is
    let values = (if low < 0.0 { air.start } else { 0.0 })..(if high > 0.0 { air.end } else { 0.0 });
    let values = if values.is_empty() { 0.0..1.0 } else { values };
    style::render(&Figure { data, groups, colors, values }, target)
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        (1800, 950)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let below = style::header(area, &self.data.title, &self.data.subtitle, &self.colors, &self.data.references)?;
        let mut chart = ChartBuilder::on(&below)
            .margin_left(26)
            .margin_right(30)
            .margin_bottom(10)
            .x_label_area_size(88)
            .y_label_area_size(140)
            .build_cartesian_2d(0.0..self.groups.len() as f64, self.values.clone())?;
        style::mesh(&mut chart, &self.data.unit, None, &|_| String::new())?;
        let width = 0.82 / self.colors.len() as f64;
        let mut whiskers = Vec::new();
        for bar in &self.data.bars {
            let place = self.groups.iter().position(|g| *g == bar.group).unwrap_or(0) as f64;
            let Some(index) = self.colors.iter().position(|(s, _)| *s == bar.series) else {
                continue;
            };
            let left = place + 0.09 + width * index as f64;
            let rectangle =
                Rectangle::new([(left, 0.0), (left + 0.94 * width, bar.value)], self.colors[index].1.filled());
            chart.draw_series(std::iter::once(rectangle))?;
            whiskers.push((left + 0.47 * width, bar.low, bar.high));
        }
        style::draw_references(&mut chart, &self.data.references)?;
        let half = (0.18 * width).min(0.05);
        for (x, low, high) in whiskers {
            for ends in
                [[(x, low), (x, high)], [(x - half, low), (x + half, low)], [(x - half, high), (x + half, high)]]
            {
                chart.draw_series(std::iter::once(PathElement::new(ends, style::INK.stroke_width(3))))?;
            }
        }
        let base = chart.plotting_area().map_coordinate(&(0.0, self.values.start)).1;
        for (place, group) in self.groups.iter().enumerate() {
            let x = chart.plotting_area().map_coordinate(&(place as f64 + 0.5, 0.0)).0;
            let origin = below.get_pixel_range();
            let at = |dy: i32| (x - origin.0.start, base - origin.1.start + dy);
            let (name, note) = group.split_once('\n').unwrap_or((group, ""));
            below.draw_text(
                &style::label(name, 14),
                &style::text(28.0, style::INK, HPos::Center, VPos::Top),
                at(14),
            )?;
            below.draw_text(
                &style::label(note, 18),
                &style::text(23.0, style::SOFT, HPos::Center, VPos::Top),
                at(50),
            )?;
        }
        Ok(())
    }
}
