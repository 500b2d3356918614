//! # What it is
//! Observed against predicted share of lost messages: how far a link's probabilities can be trusted.
//!
//! # Definition
//! One point per bin of the predicted probability, with its interval; on the diagonal a prediction is calibrated.
//!
//! # Shapes and units
//! x: predicted loss probability; y: `Data::unit`, both 0 to 1. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `reliability`, `series`, `references`.
//!
//! # When it fails
//! No curve has a point; a value is not finite.
//!
//! # Reference
//! Guo et al. 2017; reliability diagrams are older (Murphy and Winkler 1977).
//!
//! # Differences from the reference implementation
//! None.

use crate::figure::lines::{self, Lines};
use crate::figure::{Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: LINES.name,
    summary: "observed against predicted loss, with the diagonal",
    reference: "Guo et al. 2017",
    value: None,
    build: render,
};

const LINES: Lines = Lines {
    name: "reliability",
    needs: "bin with messages",
    x_name: "predicted probability of loss",
    x_digits: Some(1),
    diagonal: true,
    marks: true,
    log: false,
};

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    lines::render(&LINES, data, &data.reliability, target)
}
