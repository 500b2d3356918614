//! # What it is
//! Mutual information per directed link: a heat map of sender × receiver, one panel per class of messages.
//!
//! # Definition
//! A cell shows the value of its directed link, printed in it; all panels share one colour scale that holds 0.
//!
//! # Shapes and units
//! Rows are senders, columns receivers; the scale is named by `Data::unit`. 1600 units wide, height by agents.
//!
//! # Parameters
//! None; it reads `cells` and `axes`. Panels and agents stand in order of first appearance.
//!
//! # When it fails
//! No cell has a finite value. Single cells without one are drawn empty.
//!
//! # Reference
//! Lowe et al., *On the Pitfalls of Measuring Emergent Communication* (2019): measures per sender and receiver.
//!
//! # Differences from the reference implementation
//! The source paper shows no estimate of mutual information.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, VPos};

use crate::figure::style::{self, Area, Draw, Drawn};
use crate::figure::{Cell, Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: NAME,
    summary: "mutual information by sender and receiver, delivered and lost apart",
    reference: "Lowe et al. 2019",
    value: None,
    build: render,
};

const NAME: &str = "mi-heatmap";

/// Room left of a panel's cells for sender names, and above and below them, units.
const LEFT: i32 = 190;
const ABOVE: i32 = 66;
const BELOW: i32 = 96;

struct Figure<'a> {
    data: &'a Data,
    panels: Vec<&'a str>,
    senders: Vec<&'a str>,
    receivers: Vec<&'a str>,
    low: f64,
    high: f64,
    /// Width of a cell, units.
    wide: i32,
    /// Height of a cell, units.
    tall: i32,
}

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    let values = || data.cells.iter().map(|c| c.value).filter(|v| v.is_finite());
    if values().next().is_none() {
        return Err(FigureError::Empty { figure: NAME, needs: "cell with a value" });
    }
    let (panels, senders, receivers) =
        (distinct(data, |c| &c.panel), distinct(data, |c| &c.sender), distinct(data, |c| &c.receiver));
    let (low, high) = values().fold((0.0_f64, 0.0_f64), |(l, h), v| (l.min(v), h.max(v)));
    let wide = ((1600 - 240) / panels.len() as i32 - LEFT - 30) / receivers.len() as i32;
    let wide = wide.clamp(12, 210);
    let tall = wide.min(130).min(900 / senders.len() as i32).max(12);
    style::render(&Figure { data, panels, senders, receivers, low, high, wide, tall }, target)
}

fn distinct(data: &Data, of: fn(&Cell) -> &String) -> Vec<&str> {
    let mut names: Vec<&str> = Vec::new();
    for cell in &data.cells {
        if !names.contains(&of(cell).as_str()) {
            names.push(of(cell));
        }
    }
    names
}

/// White to dark blue through the middle of the scale; lightness falls all the way, so grey prints stay in order.
fn shade(part: f64) -> RGBColor {
    const STOPS: [(f64, f64, f64); 4] =
        [(247.0, 251.0, 255.0), (158.0, 202.0, 225.0), (49.0, 130.0, 189.0), (8.0, 48.0, 107.0)];
    let at = part.clamp(0.0, 1.0) * 3.0;
    let index = (at as usize).min(2);
    let (from, to, t) = (STOPS[index], STOPS[index + 1], at - index as f64);
    let mix = |a: f64, b: f64| (a + (b - a) * t).round() as u8;
    RGBColor(mix(from.0, to.0), mix(from.1, to.1), mix(from.2, to.2))
}

impl Figure<'_> {
    fn part(&self, value: f64) -> f64 {
        if self.high > self.low { (value - self.low) / (self.high - self.low) } else { 0.0 }
    }

    fn panel<DB: DrawingBackend>(&self, area: &Area<DB>, name: &str, left: i32) -> Drawn<DB> {
        let (wide, tall) = (self.wide, self.tall);
        let across = wide * self.receivers.len() as i32;
        let down = tall * self.senders.len() as i32;
        let title = style::text(style::LABEL, style::INK, HPos::Center, VPos::Top);
        area.draw_text(&style::label(name, 34), &title, (left + across / 2, 10))?;
        let tick = f64::from(wide.min(180) * 2 / 11).clamp(14.0, style::TICK);
        for (r, receiver) in self.receivers.iter().enumerate() {
            let at = (left + wide * r as i32 + wide / 2, ABOVE + down + 10);
            let style = style::text(tick, style::INK, HPos::Center, VPos::Top);
            area.draw_text(&style::label(receiver, 13), &style, at)?;
        }
        let axis = style::text(style::TICK, style::SOFT, HPos::Center, VPos::Top);
        let [rows, columns] = &self.data.axes;
        let named = |usual: &str, given: &str| style::label(if given.is_empty() { usual } else { given }, 30);
        area.draw_text(&named("receiver", columns), &axis, (left + across / 2, ABOVE + down + 50))?;
        let upright =
            style::text(style::TICK, style::SOFT, HPos::Center, VPos::Top).transform(FontTransform::Rotate270);
        area.draw_text(&named("sender", rows), &upright, (left - LEFT + 12, ABOVE + down / 2))?;
        for (s, sender) in self.senders.iter().enumerate() {
            let top = ABOVE + tall * s as i32;
            let style = style::text(tick, style::INK, HPos::Right, VPos::Center);
            area.draw_text(&style::label(sender, 13), &style, (left - 14, top + tall / 2))?;
            for (r, receiver) in self.receivers.iter().enumerate() {
                let corner = (left + wide * r as i32, top);
                let found =
                    self.data.cells.iter().find(|c| c.panel == name && c.sender == *sender && c.receiver == *receiver);
                self.cell(area, corner, found.map(|c| c.value).filter(|v| v.is_finite()))?;
            }
        }
        Ok(())
    }

    fn cell<DB: DrawingBackend>(&self, area: &Area<DB>, (x, y): (i32, i32), value: Option<f64>) -> Drawn<DB> {
        let fill = value.map_or(RGBColor(0xee, 0xee, 0xee), |v| shade(self.part(v)));
        let corners = [(x + 2, y + 2), (x + self.wide - 2, y + self.tall - 2)];
        area.draw(&Rectangle::new(corners, fill.filled()))?;
        if self.wide < 44 {
            return Ok(());
        }
        let (words, ink) = match value {
            None => ("–".to_owned(), style::SOFT),
            Some(v) => (style::number(v, 3), if self.part(v) > 0.55 { WHITE } else { style::INK }),
        };
        let size = f64::from(self.wide * 2 / 7).clamp(12.0, 34.0);
        let style = style::text(size, ink, HPos::Center, VPos::Center);
        area.draw_text(&words, &style, (x + self.wide / 2, y + self.tall / 2))
    }

    fn scale<DB: DrawingBackend>(&self, area: &Area<DB>, left: i32, down: i32) -> Drawn<DB> {
        for y in 0..down {
            let color = shade(1.0 - f64::from(y) / f64::from(down));
            area.draw(&Rectangle::new([(left, ABOVE + y), (left + 36, ABOVE + y + 1)], color.filled()))?;
        }
        let style = style::text(style::TICK, style::INK, HPos::Left, VPos::Center);
        for (value, y) in
            [(self.high, ABOVE), (self.high.midpoint(self.low), ABOVE + down / 2), (self.low, ABOVE + down)]
        {
            area.draw_text(&style::number(value, 2), &style, (left + 48, y))?;
        }
        let unit = style::text(style::TICK, style::SOFT, HPos::Right, VPos::Top);
        area.draw_text(&style::label(&self.data.unit, 60), &unit, (1600 - 24, 14))
    }
}

impl Draw for Figure<'_> {
    fn size(&self) -> (u32, u32) {
        let header = if self.data.subtitle.is_empty() { 78 } else { 120 };
        (1600, (header + ABOVE + self.tall * self.senders.len() as i32 + BELOW) as u32)
    }

    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB> {
        let below = style::header(area, &self.data.title, &self.data.subtitle, &[], &[])?;
        let mut left = LEFT;
        let across = self.wide * self.receivers.len() as i32;
        for panel in &self.panels {
            self.panel(&below, panel, left)?;
            left += across + LEFT + 30;
        }
        self.scale(&below, left - LEFT + 20, self.tall * self.senders.len() as i32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_darkens_all_the_way() {
        let light = |c: RGBColor| 0.2126 * f64::from(c.0) + 0.7152 * f64::from(c.1) + 0.0722 * f64::from(c.2);
        let steps: Vec<f64> = (0..=30).map(|i| light(shade(f64::from(i) / 30.0))).collect();
        assert!(steps.windows(2).all(|w| w[1] < w[0]), "{steps:?}");
        assert_eq!((shade(-1.0).0, shade(2.0).0), (247, 8), "out of the scale is held at its ends");
    }
}
