//! # What it is
//! Mutual information between x and a y that stands some rows later.
//!
//! # Definition
//! One line per estimator, or per link; at every lag the value with its interval.
//!
//! # Shapes and units
//! x: lag in rows; y: `Data::unit`. 1600 × 900 units.
//!
//! # Parameters
//! None; it reads `mi_by_lag`, `series`, `references`.
//!
//! # When it fails
//! No curve has a point; a value is not finite.
//!
//! # Reference
//! Fraser, Swinney 1986, Phys. Rev. A 33: the information of delayed values.
//!
//! # Differences from the reference implementation
//! With intervals.

use crate::figure::lines::{self, Lines};
use crate::figure::{Data, FigureError, Render, Target};
use crate::registry::Entry;

pub(super) const ENTRY: Entry<Render> = Entry {
    name: LINES.name,
    summary: "mutual information over the lag, with intervals",
    reference: "Fraser, Swinney 1986",
    value: None,
    build: render,
};

const LINES: Lines = Lines {
    name: "mi-by-lag",
    needs: "lag with a value",
    x_name: "lag, rows",
    x_digits: Some(0),
    diagonal: false,
    marks: true,
    log: false,
};

fn render(data: &Data, target: Target<'_>) -> Result<(), FigureError> {
    lines::render(&LINES, data, &data.mi_by_lag, target)
}
