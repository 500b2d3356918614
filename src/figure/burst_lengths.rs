//! # What it is
//! How long losses in a row last: the share of bursts by length.
//!
//! # Definition
//! One line per directed link, and all together with their interval; a burst that the episode's end cuts is as long as it was.
//!
//! # Shapes and units
//! x: losses in a row; y: `Data::unit`, logarithmic. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `bursts`, `series`, `references`.
//!
//! # When it fails
//! No curve has a point; a value is not finite.
//!
//! # Reference
//! Gilbert 1960.
//!
//! # Differences from the reference implementation
//! None.

use crate::figure::lines::{self, Lines};
use crate::figure::{Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: LINES.name,
    summary: "share of bursts by their length",
    reference: "Gilbert 1960",
    value: None,
    build: render,
};

const LINES: Lines = Lines {
    name: "burst-lengths",
    needs: "burst",
    x_name: "losses in a row",
    x_digits: Some(0),
    diagonal: false,
    marks: true,
    log: true,
};

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    lines::render(&LINES, data, &data.bursts, target)
}
