//! # What it is
//! Share of lost messages against the distance at the time of sending.
//!
//! # Definition
//! One line per directed link, and all together with their interval, over bins of distance.
//!
//! # Shapes and units
//! x: world units, the middle of a bin; y: `Data::unit`. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `loss_by_distance`, `series`, `references`.
//!
//! # When it fails
//! No curve has a point; a value is not finite.
//!
//! # Reference
//! Common practice.
//!
//! # Differences from the reference implementation
//! None.

use crate::figure::lines::{self, Lines};
use crate::figure::{Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: LINES.name,
    summary: "share of lost messages against distance",
    reference: "common practice",
    value: None,
    build: render,
};

const LINES: Lines = Lines {
    name: "loss-by-distance",
    needs: "bin of distance with messages",
    x_name: "distance, world units",
    x_digits: None,
    diagonal: false,
    marks: false,
    log: false,
};

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    lines::render(&LINES, data, &data.loss_by_distance, target)
}
