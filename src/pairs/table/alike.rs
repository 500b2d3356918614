//! What columns are, the same in all pieces of a table: their types, the numbers of their words, from where their dates and
//! large integers are counted.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use polars::prelude::{Column, DataFrame, DataType, NamedFrom as _, Series};

use super::TableOptions;
use super::form::unreadable;
use super::numbers::{Holds, per_second};
use super::several::Table;
use crate::pairs::PairsError;
use crate::schema::Samples;

/// Most different words of a column: estimators of categories take fewer.
const WORDS: usize = 1 << 22;
/// Nanoseconds in a second.
const SECOND: f64 = 1e9;

/// What is known of the columns of the pieces so far.
#[derive(Default)]
pub(super) struct Alike {
    columns: BTreeMap<String, Seen>,
}

/// What is known of a column.
struct Seen {
    kind: DataType,
    /// The file that had the first value.
    path: PathBuf,
    /// Length of its vectors.
    width: Option<usize>,
    /// What is taken from every integer, or from the nanoseconds of every date.
    origin: Option<i128>,
    words: BTreeMap<String, u32>,
}

impl Alike {
    /// Refuses a piece one of whose columns holds something else than before. A column without a value in it is nothing.
    /// Rows are counted from the start of the piece.
    pub(super) fn check(&mut self, frame: &DataFrame, options: &TableOptions, path: &Path) -> Result<(), PairsError> {
        for name in options.values() {
            let column = frame.column(name).map_err(unreadable("data", path))?;
            if column.null_count() == column.len() {
                continue;
            }
            let kind = column.dtype();
            let Some(seen) = self.columns.get(name) else {
                let (kind, path) = (kind.clone(), path.to_owned());
                let seen = Seen { kind, path, width: None, origin: None, words: BTreeMap::new() };
                self.columns.insert(name.to_owned(), seen);
                continue;
            };
            let (first, second) = (what(&seen.kind), what(kind));
            if first == second && (first != OTHER || seen.kind == *kind) {
                continue;
            }
            let (name, path) = (name.to_owned(), path.to_owned());
            return Err(if seen.path == path {
                PairsError::Mixed { name, first, second, row: 1, path }
            } else {
                let found = format!("{kind}, and {} in {}", seen.kind, seen.path.display());
                PairsError::Types { name, found, path }
            });
        }
        Ok(())
    }

    /// Puts numbers in place of words, dates and integers of a piece that was checked.
    pub(super) fn number(&mut self, table: &mut Table, options: &TableOptions, path: &Path) -> Result<(), PairsError> {
        for name in options.x.iter().chain(&options.y).chain(&options.given) {
            let column = table.column(name)?.clone();
            let kind = column.dtype().clone();
            let own = column.name().clone();
            let numbers = match self.columns.get_mut(name) {
                // nothing in it: not even a kind
                _ if column.null_count() == column.len() => Series::full_null(own, column.len(), &DataType::Float64),
                None => continue,
                Some(seen) => match Holds::of(&kind) {
                    Holds::Words => Series::new(own, seen.numbered(&column, path)?),
                    Holds::Dates => Series::new(own, seen.seconds(&column, path)?),
                    Holds::Numbers if kind.is_integer() => Series::new(own, seen.counted(&column, path)?),
                    Holds::Numbers if kind.is_float() && seen.origin.is_some_and(|origin| origin != 0) => {
                        let origin = seen.origin.unwrap_or(0) as f64;
                        let floats = column.cast(&DataType::Float64).map_err(unreadable("data", path))?;
                        let floats = floats.f64().map_err(unreadable("data", path))?;
                        Series::new(own, floats.iter().map(|v| v.map(|v| v - origin)).collect::<Vec<_>>())
                    }
                    Holds::Other => {
                        seen.measure(table, &column)?;
                        continue;
                    }
                    _ => continue,
                },
            };
            table.frame.with_column(numbers.into()).map_err(unreadable("data", path))?;
        }
        Ok(())
    }

    /// Says which columns of the samples stand for words.
    pub(super) fn mark(&self, samples: &mut Samples) {
        let is_words = |name: &String| self.columns.get(name).is_some_and(|seen| Holds::of(&seen.kind) == Holds::Words);
        for columns in [Some(&mut samples.x), Some(&mut samples.y), samples.z.as_mut()].into_iter().flatten() {
            let columns = Arc::make_mut(columns);
            columns.words = columns.names.iter().map(is_words).collect();
        }
    }

    /// What a reader of the result must know of columns that became numbers.
    pub(super) fn notes(&self, options: &TableOptions) -> Vec<String> {
        let mut out = Vec::new();
        for name in options.x.iter().chain(&options.y).chain(&options.given) {
            let Some(seen) = self.columns.get(name) else { continue };
            match (Holds::of(&seen.kind), seen.origin) {
                (Holds::Dates, _) => out.push(format!("dates of {name} are seconds since one of the first of them")),
                (Holds::Times, _) => out.push(format!("times of {name} are seconds")),
                (Holds::Numbers, Some(origin)) if origin != 0 => {
                    out.push(format!("integers of {name} are counted from {origin}: they do not fit a float"));
                }
                _ => {}
            }
        }
        out.dedup();
        out
    }
}

impl Seen {
    fn numbered(&mut self, column: &Column, path: &Path) -> Result<Vec<Option<u32>>, PairsError> {
        let texts = column.cast(&DataType::String).map_err(unreadable("data", path))?;
        let texts = texts.str().map_err(unreadable("data", path))?;
        let mut out = Vec::with_capacity(texts.len());
        for text in texts.iter() {
            let next = self.words.len() as u32;
            let number = text.map(|text| {
                self.words.get(text).copied().unwrap_or_else(|| {
                    self.words.insert(text.to_owned(), next);
                    next
                })
            });
            out.push(number);
            if self.words.len() > WORDS {
                let (name, path) = (column.name().to_string(), path.to_owned());
                return Err(PairsError::TooManyWords { name, most: WORDS, path });
            }
        }
        Ok(out)
    }

    fn seconds(&mut self, column: &Column, path: &Path) -> Result<Vec<Option<f64>>, PairsError> {
        let each = (SECOND / per_second(column.dtype())) as i128;
        let nanos: Vec<Option<i128>> =
            integers(&column.to_physical_repr(), path)?.into_iter().map(|v| v.map(|v| v * each)).collect();
        let least = nanos.iter().flatten().min().copied().unwrap_or(0);
        let origin = *self.origin.get_or_insert(least);
        Ok(nanos.into_iter().map(|v| v.map(|v| (v - origin) as f64 / SECOND)).collect())
    }

    /// Integers, counted from the least of the first piece if there is one in it that is too large for a float.
    fn counted(&mut self, column: &Column, path: &Path) -> Result<Vec<Option<f64>>, PairsError> {
        let values = integers(column, path)?;
        let large = values.iter().flatten().any(|v| v.unsigned_abs() > 1 << f64::MANTISSA_DIGITS);
        let least = if large { values.iter().flatten().min().copied().unwrap_or(0) } else { 0 };
        let origin = *self.origin.get_or_insert(least);
        Ok(values.into_iter().map(|v| v.map(|v| (v - origin) as f64)).collect())
    }

    /// Refuses vectors that are longer or shorter than those of the pieces before.
    fn measure(&mut self, table: &Table, column: &Column) -> Result<(), PairsError> {
        let lists = match column.dtype() {
            DataType::Array(inner, _) => column.cast(&DataType::List(inner.clone())).ok(),
            DataType::List(_) => Some(column.clone()),
            _ => None,
        };
        let Some(Ok(lists)) = lists.as_ref().map(Column::list) else { return Ok(()) };
        let first = (0..lists.len()).find_map(|at| Some((at, lists.get_as_series(at)?.len())));
        let Some((at, found)) = first else { return Ok(()) };
        let expected = *self.width.get_or_insert(found);
        if found != expected {
            let (name, (row, path)) = (column.name().to_string(), table.place(at));
            return Err(PairsError::Ragged { name, row, expected, found, path });
        }
        Ok(())
    }
}

/// Integers or ticks, whatever their width.
fn integers(column: &Column, path: &Path) -> Result<Vec<Option<i128>>, PairsError> {
    if column.dtype() == &DataType::UInt64 {
        let values = column.u64().map_err(unreadable("data", path))?;
        return Ok(values.iter().map(|v| v.map(i128::from)).collect());
    }
    let values = column.cast(&DataType::Int64).map_err(unreadable("data", path))?;
    Ok(values.i64().map_err(unreadable("data", path))?.iter().map(|v| v.map(i128::from)).collect())
}

/// Kinds of columns that do not mix, by the word that errors have for them.
fn what(kind: &DataType) -> &'static str {
    match (Holds::of(kind), kind) {
        (_, DataType::Boolean) => "truth values",
        (_, DataType::Time) => "times of day",
        (Holds::Times, _) => "spans of time",
        (Holds::Numbers, _) => "numbers",
        (Holds::Dates, _) => "dates",
        (Holds::Words, _) => "words",
        (Holds::Other, _) => OTHER,
    }
}

/// Vectors, and what no estimator takes.
const OTHER: &str = "vectors";
