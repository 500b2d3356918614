//! # What it is
//! Share of lost messages at each step of the episode.
//!
//! # Definition
//! One line per directed link, and all together with their interval.
//!
//! # Shapes and units
//! x: steps from 0; y: `Data::unit`. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `loss_by_step`, `series`, `references`.
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
    summary: "share of lost messages per step of the episode",
    reference: "common practice",
    value: None,
    build: render,
};

const LINES: Lines = Lines {
    name: "loss-by-step",
    needs: "step with messages",
    x_name: "step of the episode",
    x_digits: Some(0),
    diagonal: false,
    marks: false,
    log: false,
};

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    lines::render(&LINES, data, &data.loss_by_step, target)
}
