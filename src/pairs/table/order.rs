//! Which rows are one episode, and in which order they stand.

use std::path::Path;

use polars::prelude::{DataFrame, DataType};

use super::TableOptions;
use super::numbers::{column, flat, not_numeric};
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
pub(super) fn texts(frame: &DataFrame, name: &str, path: &Path) -> Result<Vec<Option<String>>, PairsError> {
    let column = column(frame, name, path)?;
    let cast = column.cast(&DataType::String).ok().ok_or_else(|| not_numeric(frame, column, path))?;
    let values = cast.str().ok().ok_or_else(|| not_numeric(frame, column, path))?;
    Ok(values.iter().map(|v| v.map(str::to_owned)).collect())
}

/// A column that orders rows: numbers by size, text by its bytes (ISO dates sort rightly).
pub(super) enum Order {
    Numbers(Vec<f64>),
    Texts(Vec<Option<String>>),
}

impl Order {
    pub(super) fn of(frame: &DataFrame, name: &str, path: &Path) -> Result<Self, PairsError> {
        let column = column(frame, name, path)?;
        if column.dtype() == &DataType::String {
            return texts(frame, name, path).map(Self::Texts);
        }
        let (width, values) = flat(frame, column, path)?;
        if width == 1 { Ok(Self::Numbers(values)) } else { Err(not_numeric(frame, column, path)) }
    }

    pub(super) fn has(&self, row: usize) -> bool {
        match self {
            Self::Numbers(values) => !values[row].is_nan(),
            Self::Texts(values) => values[row].is_some(),
        }
    }

    pub(super) fn compare(&self, a: usize, b: usize) -> std::cmp::Ordering {
        match self {
            Self::Numbers(values) => values[a].total_cmp(&values[b]),
            Self::Texts(values) => values[a].cmp(&values[b]),
        }
    }
}
