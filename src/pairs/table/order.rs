//! Which rows are one episode, and in which order they stand.

use std::cmp::Ordering;

use polars::prelude::DataType;

use super::TableOptions;
use super::numbers::{Holds, integers, not_numeric};
use super::several::Table;
use crate::pairs::PairsError;

/// Blocks into which one series is cut.
const BLOCKS: usize = 50;

/// Puts the rows of an episode together (in order of first appearance) and says where episodes start.
pub(super) fn episodes(
    rows: &mut [usize],
    group: Option<&[Option<String>]>,
    options: &TableOptions,
) -> (Vec<usize>, String) {
    let n = rows.len();
    let Some(keys) = group else {
        return match &options.time {
            Some(time) => {
                let blocks = BLOCKS.min(n);
                ((0..=blocks).map(|b| b * n / blocks).collect(), format!("blocks of {time}"))
            }
            None => ((0..=n).collect(), "row".to_owned()),
        };
    };
    let mut first = std::collections::BTreeMap::new();
    for &r in rows.iter() {
        let next = first.len();
        first.entry(keys[r].as_deref()).or_insert(next);
    }
    rows.sort_by_key(|&r| first.get(&keys[r].as_deref()));
    let mut starts: Vec<usize> = (0..n).filter(|&i| i == 0 || keys[rows[i]] != keys[rows[i - 1]]).collect();
    starts.push(n);
    (starts, options.group.clone().unwrap_or_default())
}

/// A column as text, for grouping.
pub(super) fn texts(table: &Table, name: &str) -> Result<Vec<Option<String>>, PairsError> {
    let column = table.column(name)?;
    let cast = column.cast(&DataType::String).ok().ok_or_else(|| not_numeric(table, column))?;
    let values = cast.str().ok().ok_or_else(|| not_numeric(table, column))?;
    Ok(values.iter().map(|v| v.map(str::to_owned)).collect())
}

/// A column that orders rows. Integers and dates are compared as such: nanoseconds since 1970 do not fit a float.
pub(super) enum Order {
    Integers(Vec<Option<i128>>),
    Floats(Vec<f64>),
}

impl Order {
    pub(super) fn of(table: &Table, name: &str) -> Result<Self, PairsError> {
        let column = table.column(name)?;
        let held = Holds::of(column.dtype());
        if held == Holds::Words {
            return Err(PairsError::NoTime { name: name.to_owned(), path: table.path() });
        }
        let unfit = || not_numeric(table, column);
        if held == Holds::Other {
            return Err(unfit());
        }
        let ticks = column.to_physical_repr();
        if !ticks.dtype().is_float() {
            return Ok(Self::Integers(integers(column).ok_or_else(unfit)?));
        }
        let floats = ticks.cast(&DataType::Float64).ok().ok_or_else(unfit)?;
        Ok(Self::Floats(floats.f64().ok().ok_or_else(unfit)?.iter().map(|v| v.unwrap_or(f64::NAN)).collect()))
    }

    pub(super) fn has(&self, row: usize) -> bool {
        match self {
            Self::Integers(values) => values[row].is_some(),
            Self::Floats(values) => !values[row].is_nan(),
        }
    }

    pub(super) fn compare(&self, a: usize, b: usize) -> Ordering {
        match self {
            Self::Integers(values) => values[a].cmp(&values[b]),
            // −0 and 0 are one time
            Self::Floats(values) => values[a].partial_cmp(&values[b]).unwrap_or(Ordering::Equal),
        }
    }

    /// Whether all steps from row to row within the episodes are equal, but for rounding.
    pub(super) fn is_even(&self, rows: &[usize], starts: &[usize]) -> bool {
        let mut steps = (1..rows.len()).filter(|at| starts.binary_search(at).is_err());
        match self {
            Self::Integers(values) => {
                let step = |at: usize| Some(values[rows[at]]? - values[rows[at - 1]]?);
                let first = steps.next().and_then(step);
                steps.all(|at| step(at) == first)
            }
            Self::Floats(values) => {
                let step = |at: usize| values[rows[at]] - values[rows[at - 1]];
                let first = steps.next().map_or(0.0, step);
                steps.all(|at| (step(at) - first).abs() <= 1e-6 * first + 1e-15 * values[rows[at]].abs())
            }
        }
    }

    /// How many of the ordered rows stand at the same time as the row before them in their episode.
    pub(super) fn ties(&self, rows: &[usize], starts: &[usize], one_series: bool) -> usize {
        let same = |at: usize| self.compare(rows[at - 1], rows[at]) == Ordering::Equal;
        (1..rows.len()).filter(|&at| (one_series || starts.binary_search(&at).is_err()) && same(at)).count()
    }
}
