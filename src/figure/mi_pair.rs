//! # What it is
//! One pair of samples: the points themselves, all estimates with their intervals, the value by the number of samples,
//! and the training of networks.
//!
//! # Definition
//! Panels in reading order, two beside each other, those without data left out. Estimates are filled dots, bounds rings
//! with ≥ or ≤; an upper bound far above all else is an arrow. The value over 1/n has a dot per part of the samples; its line is fitted to the means of the divisions
//! and drawn to 1/n = 0. Training: a line each for the training and the validation part, and the step that is used.
//!
//! # Shapes and units
//! Scatter: the columns' own units. Estimates and the value over 1/n: `Data::unit`. 1600 units wide, 640 per row of panels.
//!
//! # Parameters
//! None; it reads `pair` and `unit`.
//!
//! # When it fails
//! There is no point; a value is not finite. Of more than 12 estimates the rest is left out, of more than four trainings
//! also.
//!
//! # Reference
//! The extrapolation over 1/n: Strong, Koberle, de Ruyter van Steveninck, Bialek 1998, Phys. Rev. Lett. 80.
//!
//! # Differences from the reference implementation
//! A straight line is fitted, no parabola.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use crate::figure::pair::{Pair, Shrunk, Training, Whisker};
use crate::figure::style::{self, Area, Chart, Draw, Drawn};
use crate::figure::{Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: NAME,
    summary: "one pair: scatter, estimates with intervals, value by number of samples, training",
    reference: "Strong et al. 1998",
    value: None,
    build: render,
};

const NAME: &str = "mi-pair";
/// Height of a row of panels, units.
const ROW: u32 = 640;
/// Most estimates, and most trainings.
const ESTIMATES: usize = 12;
const TRAININGS: usize = 4;
/// What stands before an upper bound.
const UPPER: &str = "≤ ";
/// How many times farther than everything else an upper bound may lie.
const FAR: f64 = 2.5;

/// Most words along an axis, and characters of each.
const MOST_WORDS: usize = 8;
const WORD: usize = 8;

enum Panel<'a> {
    Scatter(&'a Pair),
    Estimates(&'a [Whisker]),
    Shrunk(&'a Shrunk),
    Training(&'a Training),
}

struct Figure<'a> {
    data: &'a Data,
    panels: Vec<Panel<'a>>,
}

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    let pair = &data.pair;
    if pair.points.is_empty() {
        return Err(FigureError::Empty { figure: NAME, needs: "point" });
    }
    for (what, value) in values(pair) {
        if !value.is_finite() {
            return Err(FigureError::NotFinite { figure: NAME, what, value });
        }
    }
    let mut panels = vec![Panel::Scatter(pair)];
    if !pair.estimates.is_empty() {
        panels.push(Panel::Estimates(&pair.estimates[..pair.estimates.len().min(ESTIMATES)]));
    }
    panels.extend(pair.shrunk.iter().filter(|s| !s.points.is_empty()).map(Panel::Shrunk));
    panels.extend(pair.trainings.iter().filter(|t| !t.looks.is_empty()).take(TRAININGS).map(Panel::Training));
    style::render(&Figure { data, panels }, target)
}

/// Every number that needs a place on an axis, with its name.
fn values(pair: &Pair) -> Vec<(String, f64)> {
    let mut out = Vec::new();
    let mut add = |what: &str, values: &[f64]| out.extend(values.iter().map(|&v| (what.to_owned(), v)));
    pair.points.iter().for_each(|&(x, y)| add("a point", &[x, y]));
    for w in &pair.estimates {
        let (low, high) = w.band.unwrap_or((w.value, w.value));
        add(&format!("the estimate {:?}", w.label), &[w.value, low, high]);
    }
    if let Some(s) = &pair.shrunk {
        add(&format!("the line of {:?}", s.label), &[s.line.0, s.line.1]);
        s.points.iter().for_each(|&(n, v)| add(&format!("a part of {:?}", s.label), &[1.0 / n, v]));
    }
    for t in &pair.trainings {
        t.looks.iter().for_each(|&(s, a, b)| add(&format!("the training of {:?}", t.label), &[s, a, b]));
    }
    out
}

/// Least and greatest.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        let header = if self.data.subtitle.is_empty() { 90 } else { 132 };
        (1600, header + ROW * self.panels.len().div_ceil(2) as u32)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let below = style::header(area, &self.data.title, &self.data.subtitle, &[], &[])?;
        let rows = self.panels.len().div_ceil(2);
        for (area, panel) in below.split_evenly((rows, 2)).iter().zip(&self.panels) {
            match panel {
                Panel::Scatter(pair) => scatter(area, pair)?,
                Panel::Estimates(whiskers) => estimates(area, whiskers, &self.data.unit)?,
                Panel::Shrunk(shrunk) => self::shrunk(area, shrunk, &self.data.unit)?,
                Panel::Training(training) => self::training(area, training)?,
            }
        }
        Ok(())
    }
}

/// A panel's name, and the area below it.
fn titled<DB: DrawingBackend>(area: &Area<DB>, name: &str) -> Drawn<DB, Area<DB>> {
    let style = style::text(style::LABEL, style::INK, HPos::Left, VPos::Top);
    area.draw_text(&style::label(name, 46), &style, (40, 22))?;
    Ok(area.split_vertically(66).1)
}

/// A panel's chart, with room for the ticks and names of its axes.
fn chart<DB: DrawingBackend>(
    area: &Area<DB>,
    x: std::ops::Range<f64>,
    y: std::ops::Range<f64>,
) -> Drawn<DB, Chart<'_, DB>> {
    ChartBuilder::on(area)
        .margin_left(26)
        .margin_right(40)
        .margin_bottom(10)
        .x_label_area_size(86)
        .y_label_area_size(136)
        .build_cartesian_2d(x, y)
}

/// Grid, five ticks a side, and names.
fn mesh<DB: DrawingBackend>(chart: &mut Chart<'_, DB>, x_name: &str, y_name: &str) -> Drawn<DB> {
    let (across, up) = (chart.x_range(), chart.y_range());
    let (x_range, y_range) = (across.end - across.start, up.end - up.start);
    let (x_label, y_label) = (|v: &f64| style::short(*v, x_range), |v: &f64| style::short(*v, y_range));
    style::mesh_of(chart, [5, 6], (y_name, &y_label), (Some(x_name), &x_label))
}

fn scatter<DB: DrawingBackend>(area: &Area<DB>, pair: &Pair) -> Drawn<DB> {
    let below = titled(area, &format!("{} points", pair.points.len()))?;
    let (left, right) = range(pair.points.iter().map(|p| p.0));
    let (low, high) = range(pair.points.iter().map(|p| p.1));
    let mut chart = chart(&below, style::axis(left, right), style::axis(low, high))?;
    let names = [style::label(&pair.names[0], 38), style::label(&pair.names[1], 28)];
    let (across, up) = (chart.x_range(), chart.y_range());
    let ticks = |v: &f64, axis: usize, range: &std::ops::Range<f64>| {
        if pair.levels[axis].is_empty() { style::short(*v, range.end - range.start) } else { String::new() }
    };
    let (x_label, y_label) = (|v: &f64| ticks(v, 0, &across), |v: &f64| ticks(v, 1, &up));
    style::mesh_of(&mut chart, [5, 6], (&names[1], &y_label), (Some(&names[0]), &x_label))?;
    let origin = below.get_pixel_range();
    for (axis, levels) in pair.levels.iter().enumerate() {
        // as many as there is room for
        let every = levels.len().div_ceil(MOST_WORDS).max(1);
        for (place, word) in (0..).zip(levels).step_by(every) {
            let at = f64::from(place);
            let (point, to, anchor, (dx, dy)) = if axis == 0 {
                ((at, up.start), &across, (HPos::Center, VPos::Top), (0, 12))
            } else {
                ((across.start, at), &up, (HPos::Right, VPos::Center), (-12, 0))
            };
            if to.contains(&at) {
                let (px, py) = chart.backend_coord(&point);
                let tick = style::text(style::TICK, style::INK, anchor.0, anchor.1);
                let word = style::label(word, WORD);
                below.draw_text(&word, &tick, (px - origin.0.start + dx, py - origin.1.start + dy))?;
            }
        }
    }
    let (size, ink) = if pair.points.len() > 400 { (5, 0.3) } else { (7, 0.5) };
    let color = style::color(0).mix(ink);
    chart.draw_series(pair.points.iter().map(|&at| Circle::new(at, size, color.filled())))?;
    Ok(())
}

fn estimates<DB: DrawingBackend>(area: &Area<DB>, whiskers: &[Whisker], unit: &str) -> Drawn<DB> {
    let below = titled(area, "estimates with 95 % intervals")?;
    let ends = |w: &Whisker| w.band.map_or([w.value; 3], |(low, high)| [low, w.value, high]);
    let (low, mut high) = range(whiskers.iter().flat_map(ends).chain([0.0]));
    // an upper bound may be many times the rest: then it is an arrow at the edge
    let (_, usual) = range(whiskers.iter().filter(|w| w.sign != UPPER).flat_map(ends));
    if usual > 0.0 {
        high = high.min(FAR * usual);
    }
    let count = whiskers.len() as f64;
    let mut chart = ChartBuilder::on(&below)
        .margin_left(26)
        .margin_right(40)
        .margin_bottom(10)
        .x_label_area_size(86)
        .y_label_area_size(310)
        .build_cartesian_2d(style::axis(low, high), count - 0.4..-0.6)?;
    let across = chart.x_range();
    let length = across.end - across.start;
    let x_label = |v: &f64| style::short(*v, length);
    style::mesh_of(&mut chart, [4, 0], ("", &|_| String::new()), (Some(unit), &x_label))?;
    let zero = DashedLineSeries::new([(0.0, count - 0.4), (0.0, -0.6)], 14, 10, style::SOFT.stroke_width(3));
    chart.draw_series(zero)?;
    for (whisker, place) in whiskers.iter().zip(0..) {
        let (at, color) = (f64::from(place), style::color(0));
        let (_, y) = chart.backend_coord(&(0.0, at));
        let y = y - below.get_pixel_range().1.start;
        let name = style::text(style::TICK, style::INK, HPos::Right, VPos::Bottom);
        below.draw_text(&style::label(&whisker.label, 20), &name, (320, y + 2))?;
        let value = style::text(22.0, style::SOFT, HPos::Right, VPos::Top);
        below.draw_text(&format!("{}{}", whisker.sign, style::number(whisker.value, 4)), &value, (320, y + 4))?;
        if whisker.value > high {
            let arrow = style::text(style::TITLE, color, HPos::Right, VPos::Center);
            below.draw_text("→", &arrow, (below.dim_in_pixel().0 as i32 - 40, y))?;
            continue;
        }
        if let Some((low, top)) = whisker.band {
            let top = top.min(across.end);
            let line = PathElement::new(vec![(low, at), (top, at)], color.stroke_width(5));
            chart.draw_series(std::iter::once(line))?;
        }
        let dot = (whisker.value, at);
        chart.draw_series(std::iter::once(Circle::new(dot, 11, color.filled())))?;
        if !whisker.sign.is_empty() {
            chart.draw_series(std::iter::once(Circle::new(dot, 6, WHITE.filled())))?;
        }
    }
    Ok(())
}

fn shrunk<DB: DrawingBackend>(area: &Area<DB>, shrunk: &Shrunk, unit: &str) -> Drawn<DB> {
    let below = titled(area, &format!("{} by number of samples", style::label(&shrunk.label, 22)))?;
    let right = shrunk.points.iter().map(|p| 1.0 / p.0).fold(0.0, f64::max);
    let (limit, slope) = shrunk.line;
    let (low, high) = range(shrunk.points.iter().map(|p| p.1).chain([limit, limit + slope * right]));
    let mut chart = chart(&below, -0.06 * right..1.1 * right, style::axis(low, high))?;
    let up = chart.y_range();
    let length = up.end - up.start;
    let y_label = |v: &f64| style::short(*v, length);
    style::mesh_of(&mut chart, [0, 6], (unit, &y_label), (None, &|_| String::new()))?;
    let line = [(0.0, limit), (right, limit + slope * right)];
    chart.draw_series(DashedLineSeries::new(line, 14, 10, style::SOFT.stroke_width(3)))?;
    let dots = shrunk.points.iter().map(|&(n, v)| Circle::new((1.0 / n, v), 9, style::color(0).mix(0.6).filled()));
    chart.draw_series(dots)?;
    let ring = [Circle::new((0.0, limit), 11, style::color(1).filled()), Circle::new((0.0, limit), 6, WHITE.filled())];
    chart.draw_series(ring)?;
    // ticks where the parts are: their sizes say more than round numbers of 1/n
    let mut sizes: Vec<f64> = shrunk.points.iter().map(|p| p.0.round()).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.dedup_by(|a, b| (*a - *b).abs() < 0.05 * *b);
    let tick = style::text(style::TICK, style::INK, HPos::Center, VPos::Top);
    let origin = below.get_pixel_range();
    for (x, text) in sizes.iter().map(|&n| (1.0 / n, format!("{n}"))).chain([(0.0, "∞".to_owned())]) {
        let (px, py) = chart.backend_coord(&(x, up.start));
        below.draw_text(&text, &tick, (px - origin.0.start, py - origin.1.start + 12))?;
    }
    let name = style::text(style::LABEL, style::INK, HPos::Center, VPos::Top);
    let (px, py) = chart.backend_coord(&(0.5 * right, up.start));
    below.draw_text("samples n, at 1/n", &name, (px - origin.0.start, py - origin.1.start + 50))
}

fn training<DB: DrawingBackend>(area: &Area<DB>, training: &Training) -> Drawn<DB> {
    let below = titled(area, &format!("training of {}", style::label(&training.label, 30)))?;
    let right = training.looks.iter().map(|l| l.0).fold(1.0, f64::max);
    let (low, high) = range(training.looks.iter().flat_map(|l| [l.1, l.2]));
    let mut chart = chart(&below, 0.0..right, style::axis(low, high))?;
    mesh(&mut chart, "training step; dashed: the one used", &training.score)?;
    let chosen = [(training.chosen, style::axis(low, high).start), (training.chosen, style::axis(low, high).end)];
    chart.draw_series(DashedLineSeries::new(chosen, 14, 10, style::SOFT.stroke_width(3)))?;
    let parts = ["training", "validation"];
    for at in 0..parts.len() {
        let line = training.looks.iter().map(|l| (l.0, [l.1, l.2][at]));
        chart.draw_series(LineSeries::new(line, style::color(at).stroke_width(5)))?;
    }
    // the legend stands in the panel's title line, right of the name: never over data
    let (width, _) = area.dim_in_pixel();
    let style = style::text(style::TICK, style::INK, HPos::Right, VPos::Top);
    let mut x = width as i32 - 40;
    for (at, name) in parts.iter().enumerate().rev() {
        let long = area.estimate_text_size(name, &style)?.0 as i32;
        area.draw_text(name, &style, (x, 26))?;
        area.draw(&Rectangle::new([(x - long - 42, 28), (x - long - 12, 48)], style::color(at).filled()))?;
        x -= long + 70;
    }
    Ok(())
}
