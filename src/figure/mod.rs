//! Figures: tidy data in, SVG text or a PNG file out; the only room that knows plotters.
//!
//! A figure takes from [`Data`] what it needs and leaves the rest; equal data give equal bytes. Adding one: write
//! `figure/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod bars;
mod burst_lengths;
mod calibration;
mod channel_returns;
mod learning_curves;
mod lines;
mod loss_by_distance;
mod loss_by_step;
mod mi_by_lag;
mod mi_heatmap;
mod mi_pair;
mod pair;
mod reliability;
mod scaling;
mod style;

use std::path::{Path, PathBuf};

pub use self::pair::{Pair, Shrunk, Training, Whisker};
use crate::registry::Entry;

/// All figures.
pub const FIGURES: &[Entry<Render>] = &[
    learning_curves::ENTRY,
    channel_returns::ENTRY,
    mi_heatmap::ENTRY,
    scaling::ENTRY,
    reliability::ENTRY,
    loss_by_step::ENTRY,
    burst_lengths::ENTRY,
    loss_by_distance::ENTRY,
    calibration::ENTRY,
    mi_pair::ENTRY,
    mi_by_lag::ENTRY,
];

/// Draws a figure from `data` onto a target.
pub type Render = fn(&Data, Target<'_>) -> Result<(), FigureError>;

/// Where a figure is drawn.
#[derive(Debug)]
pub enum Target<'a> {
    /// SVG text, appended.
    Svg(&'a mut String),
    /// A PNG file, written at once (not atomically: give a path in a directory that is published whole).
    Png(&'a Path),
}

/// What a report knows, tidy: every figure reads the parts it draws.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Data {
    /// First line above the figure.
    pub title: String,
    /// Second line: what the marks and whiskers stand for.
    pub subtitle: String,
    /// What the value axis shows, with its unit.
    pub unit: String,
    /// Series names in legend order; a name's place is its colour, in every figure of a report.
    pub series: Vec<String>,
    /// Curves over training.
    pub curves: Vec<Curve>,
    /// Costs by size, each the `step` of its point.
    pub costs: Vec<Curve>,
    /// Observed by predicted loss probability, each the `step` of its point.
    pub reliability: Vec<Curve>,
    /// Loss by step of the episode.
    pub loss_by_step: Vec<Curve>,
    /// Share of bursts by their length, each the `step` of its point.
    pub bursts: Vec<Curve>,
    /// Loss by distance, world units, each the `step` of its point.
    pub loss_by_distance: Vec<Curve>,
    /// Mutual information by lag in rows, each the `step` of its point.
    pub mi_by_lag: Vec<Curve>,
    /// One pair of samples.
    pub pair: Pair,
    /// Bars by group and series.
    pub bars: Vec<Bar>,
    /// Horizontal lines of constant value (random policy, oracle).
    pub references: Vec<Reference>,
    /// Values by sender and receiver.
    pub cells: Vec<Cell>,
    /// What rows and columns of cells are; `sender` and `receiver` when empty.
    pub axes: [String; 2],
}

/// One line of a curve figure; several curves may belong to one series (runs, when there are few seeds).
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// The series it belongs to.
    pub series: String,
    /// Its points, in order of steps.
    pub points: Vec<Point>,
}

/// A point of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Environment steps.
    pub step: f64,
    /// Value.
    pub value: f64,
    /// Band around it, low and high.
    pub band: Option<(f64, f64)>,
}

/// One bar with a whisker.
#[derive(Clone, Debug, PartialEq)]
pub struct Bar {
    /// The group (test channel); a second line after `\n` is printed smaller below it.
    pub group: String,
    /// The series (algorithm).
    pub series: String,
    /// Height.
    pub value: f64,
    /// Lower end of the whisker.
    pub low: f64,
    /// Upper end of the whisker.
    pub high: f64,
}

/// A horizontal line.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// Its name in the legend.
    pub label: String,
    /// Where it lies on the value axis.
    pub value: f64,
}

/// One cell of a heat map.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// The panel it belongs to (`delivered`, `lost`).
    pub panel: String,
    /// Who sends (row).
    pub sender: String,
    /// Who receives (column).
    pub receiver: String,
    /// Value; NaN is drawn as an empty cell.
    pub value: f64,
}

/// What can go wrong with a figure.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// Nothing to draw.
    #[error("figure {figure}: expected at least one {needs}, found none")]
    Empty {
        /// The figure.
        figure: &'static str,
        /// What it draws.
        needs: &'static str,
    },
    /// A value that has no place on an axis.
    #[error("figure {figure}: {what} is {value}: only finite numbers can be drawn")]
    NotFinite {
        /// The figure.
        figure: &'static str,
        /// Which value.
        what: String,
        /// NaN or an infinity.
        value: f64,
    },
    /// The drawing library refused.
    #[error("could not draw the figure: {0}")]
    Draw(String),
    /// The PNG could not be written.
    #[error("could not write the figure: {message}: {}", path.display())]
    Write {
        /// The reason given.
        message: String,
        /// Where.
        path: PathBuf,
    },
}

/// The figure as SVG text: one `<svg>` element, generic sans-serif, every string escaped.
///
/// # Errors
/// [`FigureError`].
pub fn svg(figure: &Entry<Render>, data: &Data) -> Result<String, FigureError> {
    let mut text = String::new();
    (figure.build)(data, Target::Svg(&mut text))?;
    Ok(text)
}

/// Writes the figure as a PNG file.
///
/// # Errors
/// [`FigureError`].
pub fn png(figure: &Entry<Render>, data: &Data, path: &Path) -> Result<(), FigureError> {
    (figure.build)(data, Target::Png(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data that every figure can draw, with hostile names.
    fn sample() -> Data {
        let point = |step: f64| Point { step, value: step / 1e3 - 90.0, band: Some((step / 1e3 - 95.0, -20.0)) };
        let bar = |group: &str, value| Bar {
            group: group.to_owned(),
            series: "<b>&\u{1}".to_owned(),
            value,
            low: value - 2.0,
            high: value + 3.0,
        };
        let cell = |panel: &str, value| Cell {
            panel: panel.to_owned(),
            sender: "agent_0".to_owned(),
            receiver: "agent_1".to_owned(),
            value,
        };
        let shares = || {
            let point = |x: f64| Point { step: x, value: 0.5 * x, band: Some((0.4 * x, 0.6 * x)) };
            vec![Curve { series: "<b>&\u{1}".to_owned(), points: vec![point(0.1), point(0.6), point(0.9)] }]
        };
        Data {
            title: "a < b".to_owned(),
            subtitle: "± over seeds".to_owned(),
            unit: "return per episode".to_owned(),
            series: vec!["<b>&\u{1}".to_owned()],
            curves: vec![Curve { series: "<b>&\u{1}".to_owned(), points: vec![point(0.0), point(1e4), point(2e4)] }],
            costs: vec![Curve {
                series: "<b>&\u{1}".to_owned(),
                points: vec![
                    Point { step: 3.0, value: 0.1, band: None },
                    Point { step: 100.0, value: 9.0, band: None },
                ],
            }],
            reliability: shares(),
            loss_by_step: shares(),
            bursts: shares(),
            loss_by_distance: shares(),
            mi_by_lag: shares(),
            pair: Pair {
                names: ["<b>x".to_owned(), "\u{1}".to_owned()],
                levels: [vec!["<b>".to_owned(), "\u{1}".to_owned()], Vec::new()],
                points: (0..50).map(|i| (f64::from(i), f64::from(i * i % 17))).collect(),
                estimates: vec![
                    Whisker { label: "<b>\u{1}".to_owned(), sign: "", value: 0.4, band: Some((0.3, 0.5)) },
                    Whisker { label: "club".to_owned(), sign: "≤ ", value: 1.4, band: None },
                ],
                shrunk: Some(Shrunk {
                    label: "<b>".to_owned(),
                    points: vec![(50.0, 0.4), (25.0, 0.5), (25.0, 0.45)],
                    line: (0.35, 3.0),
                }),
                trainings: vec![Training {
                    label: "<b>".to_owned(),
                    score: "<b>".to_owned(),
                    looks: vec![(0.0, 0.0, 0.0), (25.0, 0.3, 0.2)],
                    chosen: 25.0,
                }],
            },
            bars: vec![bar("unrestricted", -80.0), bar("none", -120.0)],
            references: vec![Reference { label: "random".to_owned(), value: -200.0 }],
            cells: vec![cell("delivered", 0.4133), cell("lost", f64::NAN)],
            axes: ["<b>".to_owned(), "\u{1}".to_owned()],
        }
    }

    #[test]
    fn every_figure_draws_svg_and_png_the_same_twice() {
        let dir = tempfile::tempdir().unwrap();
        for entry in FIGURES {
            let text = svg(entry, &sample()).unwrap();
            assert_eq!(text, svg(entry, &sample()).unwrap(), "{}", entry.name);
            assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"), "{}", entry.name);
            assert!(text.contains("a &lt; b"), "{}: the title is there, escaped", entry.name);
            assert!(!text.contains("<b>") && !text.contains('\u{1}'), "{}: data cannot become markup", entry.name);
            let path = dir.path().join(format!("{}.png", entry.name));
            png(entry, &sample(), &path).unwrap();
            let first = std::fs::read(&path).unwrap();
            assert!(first.starts_with(b"\x89PNG") && first.len() > 5_000, "{}", entry.name);
            png(entry, &sample(), &path).unwrap();
            assert_eq!(first, std::fs::read(&path).unwrap(), "{}", entry.name);
        }
    }

    #[test]
    fn no_data_is_a_typed_error() {
        let messages: Vec<String> = FIGURES.iter().map(|e| svg(e, &Data::default()).unwrap_err().to_string()).collect();
        assert_eq!(
            messages,
            [
                "figure learning-curves: expected at least one curve with points, found none",
                "figure channel-returns: expected at least one bar, found none",
                "figure mi-heatmap: expected at least one cell with a value, found none",
                "figure scaling: expected at least one cost with points, found none",
                "figure reliability: expected at least one bin with messages, found none",
                "figure loss-by-step: expected at least one step with messages, found none",
                "figure burst-lengths: expected at least one burst, found none",
                "figure loss-by-distance: expected at least one bin of distance with messages, found none",
                "figure calibration: expected at least one bar, found none",
                "figure mi-pair: expected at least one point, found none",
                "figure mi-by-lag: expected at least one lag with a value, found none",
            ]
        );
    }

    #[test]
    fn a_bar_that_is_not_a_number_is_named() {
        let mut data = sample();
        data.bars[1].value = f64::NAN;
        let error = svg(&FIGURES[1], &data).unwrap_err().to_string();
        assert!(error.starts_with("figure channel-returns: the bar of \"<b>&\\u{1}\" at \"none\" is NaN"), "{error}");
    }

    #[test]
    fn a_png_into_a_missing_directory_names_the_path() {
        let error = png(&FIGURES[1], &sample(), Path::new("/nowhere/x.png")).unwrap_err().to_string();
        assert!(error.starts_with("could not write the figure: ") && error.ends_with(": /nowhere/x.png"), "{error}");
    }
}
