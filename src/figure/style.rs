//! How all figures look: size, palette, text, legend; and how they reach SVG and PNG.
//!
//! A figure is laid out once, on a grid of units two to a screen pixel. SVG shows it at half size; PNG has all units.

use std::sync::OnceLock;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::figure::{Curve, FigureError, Reference, Target};
use crate::io::printable;

/// An area of units that figures draw on.
pub(super) type Area<DB> = DrawingArea<DB, Shift>;

/// Result of drawing on a backend.
pub(super) type Drawn<DB, T = ()> = Result<T, DrawingAreaErrorKind<<DB as DrawingBackend>::ErrorType>>;

/// Text height of titles, units.
pub(super) const TITLE: f64 = 40.0;
/// Text height of axis names and legends, units.
pub(super) const LABEL: f64 = 31.0;
/// Text height of ticks, units.
pub(super) const TICK: f64 = 27.0;

/// Near black, for text.
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
/// For second lines.
pub(super) const SOFT: RGBColor = RGBColor(0x5a, 0x5a, 0x5a);
/// For grid lines.
pub(super) const GRID: RGBColor = RGBColor(0xe2, 0xe2, 0xe2);

/// Okabe and Ito's colours, told apart with every common colour blindness; yellow last, it is pale on white.
const PALETTE: [RGBColor; 8] = [
    RGBColor(0x00, 0x72, 0xb2),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0xcc, 0x79, 0xa7),
    RGBColor(0x66, 0x66, 0x66),
    RGBColor(0xf0, 0xe4, 0x42),
];

static FONT: OnceLock<bool> = OnceLock::new();

/// Something laid out and ready to be drawn on any backend.
pub(super) trait Draw {
    /// Width and height, units.
    fn size(&self) -> (u32, u32);
    /// Draws on a white area of that size.
    fn draw<DB: DrawingBackend>(&self, area: &Area<DB>) -> Drawn<DB>;
}

/// Draws `figure` onto `target`.
pub(super) fn render(figure: &impl Draw, target: Target<'_>) -> Result<(), FigureError> {
    let font = include_bytes!("../../assets/fonts/DejaVuSans.ttf");
    if !FONT.get_or_init(|| plotters::style::register_font("sans-serif", FontStyle::Normal, font).is_ok()) {
        return Err(FigureError::Draw("the built-in font was not accepted".to_owned()));
    }
    let (width, height) = figure.size();
    match target {
        Target::Svg(out) => {
            let mut text = String::new();
            draw_on(figure, SVGBackend::with_string(&mut text, (width, height))).map_err(FigureError::Draw)?;
            let full = format!("width=\"{width}\" height=\"{height}\"");
            let half = format!("width=\"{}\" height=\"{}\" role=\"img\"", width / 2, height / 2);
            out.push_str(&text.replacen(&full, &half, 1));
            Ok(())
        }
        Target::Png(path) => draw_on(figure, BitMapBackend::new(path, (width, height)))
            .map_err(|message| FigureError::Write { message, path: path.to_owned() }),
    }
}

fn draw_on<DB: DrawingBackend>(figure: &impl Draw, backend: DB) -> Result<(), String> {
    let area = backend.into_drawing_area();
    area.fill(&WHITE).and_then(|()| figure.draw(&area)).and_then(|()| area.present()).map_err(|e| e.to_string())
}

/// The colour of the series at `index`.
pub(super) fn color(index: usize) -> RGBColor {
    PALETTE[index % PALETTE.len()]
}

/// Text of a height, a colour and an anchor.
pub(super) fn text(size: f64, color: RGBColor, h: HPos, v: VPos) -> TextStyle<'static> {
    TextStyle { color: color.to_backend_color(), ..TextStyle::from(("sans-serif", size).into_font()) }
        .pos(Pos::new(h, v))
}

/// A string from data, fit to be drawn: control characters escaped, cut after `limit` characters.
pub(super) fn label(text: &str, limit: usize) -> String {
    let clean = printable(text);
    if clean.chars().count() <= limit {
        return clean;
    }
    clean.chars().take(limit.saturating_sub(1)).chain(['…']).collect()
}

/// A number for axes and cells, with a true minus sign.
pub(super) fn number(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let zero = text.trim_start_matches('-').chars().all(|c| c == '0' || c == '.');
    if zero { text.trim_start_matches('-').to_owned() } else { text.replace('-', "−") }
}

/// A power of ten for a tick.
pub(super) fn power(exponent: f64) -> String {
    let value = 10.0_f64.powf(exponent);
    number(value, (1.0 - exponent.floor()).clamp(0.0, 6.0) as usize)
}

/// Decimals that tell the ticks of an axis of this length apart.
pub(super) fn decimals(range: f64) -> usize {
    match range {
        r if r >= 8.0 => 0,
        r if r >= 0.8 => 1,
        r if r >= 0.08 => 2,
        _ => 3,
    }
}

/// A tick as short as it can be: the decimals that the axis needs, or a power of ten where numbers are long.
pub(super) fn short(value: f64, range: f64) -> String {
    let largest = value.abs();
    if largest >= 1e5 || range < 1e-3 && largest > 0.0 {
        let text = format!("{value:.2e}");
        let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
        let digits = digits.trim_end_matches('0').trim_end_matches('.');
        return format!("{}e{}", digits.replace('-', "−"), exponent.replace('-', "−"));
    }
    number(value, decimals(range))
}

/// An axis that holds `low..high` with a little air, never of zero length.
pub(super) fn axis(low: f64, high: f64) -> std::ops::Range<f64> {
    let air = 0.05 * (high - low).max(high.abs().max(low.abs()) * 1e-3).max(1e-6);
    low - air..high + air
}

/// Title, subtitle and legend above a figure, wrapped; gives back the area below them. The legend is never over data.
pub(super) fn header<DB: DrawingBackend>(
    area: &Area<DB>,
    title: &str,
    subtitle: &str,
    series: &[(String, RGBColor)],
    references: &[Reference],
) -> Drawn<DB, Area<DB>> {
    let width = area.dim_in_pixel().0 as i32;
    let mut y = 22;
    area.draw_text(&label(title, 74), &text(TITLE, INK, HPos::Left, VPos::Top), (40, y))?;
    y += 56;
    if !subtitle.is_empty() {
        area.draw_text(&label(subtitle, 108), &text(TICK, SOFT, HPos::Left, VPos::Top), (40, y))?;
        y += 42;
    }
    let style = text(LABEL, INK, HPos::Left, VPos::Top);
    let mut x = 40;
    let mut entry = |name: &str, color: RGBColor, dash: bool| -> Drawn<DB> {
        let name = label(name, 60);
        let long = area.estimate_text_size(&name, &style)?.0 as i32;
        if x > 40 && x + 60 + long > width - 30 {
            x = 40;
            y += 44;
        }
        if dash {
            for k in 0..3 {
                let from = x + 18 * k;
                area.draw(&Rectangle::new([(from, y + 9), (from + 11, y + 12)], color.filled()))?;
            }
        } else {
            area.draw(&Rectangle::new([(x, y - 2), (x + 44, y + 22)], color.filled()))?;
        }
        area.draw_text(&name, &style, (x + 58, y))?;
        x += 58 + long + 44;
        Ok(())
    };
    for (name, color) in series {
        entry(name, *color, false)?;
    }
    for (index, line) in references.iter().enumerate() {
        entry(&line.label, reference_color(index), true)?;
    }
    let below = if series.is_empty() && references.is_empty() { y } else { y + 50 };
    Ok(area.split_vertically(below).1)
}

/// The colour of the reference line at `index`: greys, so that lines never look like data.
pub(super) fn reference_color(index: usize) -> RGBColor {
    [RGBColor(0x88, 0x88, 0x88), RGBColor(0x33, 0x33, 0x33)][index % 2]
}

/// A chart with f64 axes.
pub(super) type Chart<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Grid, ticks and axis names; without `x_name` the x axis has no ticks.
pub(super) fn mesh<DB: DrawingBackend>(
    chart: &mut Chart<'_, DB>,
    y_name: &str,
    x_name: Option<&str>,
    x_label: &dyn Fn(&f64) -> String,
) -> Drawn<DB> {
    let range = chart.y_range();
    let digits = decimals(range.end - range.start);
    mesh_with(chart, (y_name, &|y: &f64| number(*y, digits)), (x_name, x_label))
}

/// How the ticks of an axis are written.
type Ticks<'a> = &'a dyn Fn(&f64) -> String;

/// Grid, ticks as the closures write them, and axis names.
pub(super) fn mesh_with<DB: DrawingBackend>(
    chart: &mut Chart<'_, DB>,
    y: (&str, Ticks<'_>),
    x: (Option<&str>, Ticks<'_>),
) -> Drawn<DB> {
    mesh_of(chart, [8, 8], y, x)
}

/// The same with at most so many ticks on x and on y.
pub(super) fn mesh_of<DB: DrawingBackend>(
    chart: &mut Chart<'_, DB>,
    [across, up]: [usize; 2],
    (y_name, y_label): (&str, Ticks<'_>),
    (x_name, x_label): (Option<&str>, Ticks<'_>),
) -> Drawn<DB> {
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GRID.stroke_width(2))
        .axis_style(SOFT.stroke_width(2))
        .label_style(text(TICK, INK, HPos::Left, VPos::Top))
        .axis_desc_style(text(LABEL, INK, HPos::Left, VPos::Top))
        .x_labels(if x_name.is_some() { across } else { 0 })
        .x_desc(x_name.unwrap_or(""))
        .x_label_formatter(x_label)
        .y_labels(up)
        .y_desc(label(y_name, 60))
        .y_label_formatter(&y_label)
        .draw()
}

/// A curve: a line, thin where its points have no band; with `marks`, points with whiskers instead of a band.
pub(super) fn draw_curve<DB: DrawingBackend>(
    chart: &mut Chart<'_, DB>,
    curve: &Curve,
    color: RGBColor,
    marks: bool,
) -> Drawn<DB> {
    let band: Vec<_> = curve.points.iter().filter_map(|p| p.band.map(|b| (p.step, b))).collect();
    if marks {
        let whisker =
            |&(x, (low, high)): &(f64, (f64, f64))| PathElement::new(vec![(x, low), (x, high)], color.stroke_width(4));
        chart.draw_series(band.iter().map(whisker))?;
        chart.draw_series(curve.points.iter().map(|p| Circle::new((p.step, p.value), 8, color.filled())))?;
    } else if !band.is_empty() {
        let edge = band.iter().map(|&(x, (low, _))| (x, low));
        let outline: Vec<_> = edge.chain(band.iter().rev().map(|&(x, (_, high))| (x, high))).collect();
        chart.draw_series(std::iter::once(Polygon::new(outline, color.mix(0.18))))?;
    }
    let line = curve.points.iter().map(|p| (p.step, p.value));
    chart.draw_series(LineSeries::new(line, color.stroke_width(if band.is_empty() { 4 } else { 6 })))?;
    Ok(())
}

/// Horizontal dashed lines over the whole width of a chart.
pub(super) fn draw_references<DB: DrawingBackend>(chart: &mut Chart<'_, DB>, references: &[Reference]) -> Drawn<DB> {
    let across = chart.x_range();
    for (index, line) in references.iter().enumerate() {
        let ends = [(across.start, line.value), (across.end, line.value)];
        let style = reference_color(index).stroke_width(3);
        chart.draw_series(DashedLineSeries::new(ends, 14, 10, style))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_short_and_have_a_true_minus_sign() {
        assert_eq!([short(-0.25, 1.0), short(250_000.0, 1e6)], ["−0.2", "2.5e5"]);
        assert_eq!([short(-3.0e-5, 1e-4), short(0.0, 1e-4), short(12.0, 100.0)], ["−3e−5", "0.000", "12"]);
    }
}
