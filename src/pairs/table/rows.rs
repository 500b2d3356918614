//! Which rows of a table: those that `--where` keeps, and the parts that `--by` makes of them.

use std::collections::BTreeMap;

use polars::prelude::{BooleanChunked, Column, DataType, Float64Chunked, Int64Chunked, StringChunked};

use super::form::unreadable;
use super::numbers::{Holds, per_second};
use super::order::texts;
use super::several::{Table, WANTED};
use crate::pairs::predicate::{Kind, Predicate, Value};
use crate::pairs::{PairsError, dates};
use crate::schema::NOTE;

/// Most sets of samples that `--by` makes.
const PARTS: usize = 1000;

/// Some rows of a table.
#[derive(Debug)]
pub(super) struct Part {
    pub(super) rows: Vec<usize>,
    /// `species = setosa`; none: all rows.
    pub(super) within: Option<String>,
    pub(super) note: Option<String>,
}

/// The rows by the values of columns; all of them when there is no column. Rows without a value are in no part.
pub(super) fn parts(table: &Table, by: &[String]) -> Result<Vec<Part>, PairsError> {
    let height = table.frame.height();
    if by.is_empty() {
        return Ok(vec![Part { rows: (0..height).collect(), within: None, note: None }]);
    }
    let columns = by.iter().map(|name| texts(table, name)).collect::<Result<Vec<_>, _>>()?;
    let mut found: BTreeMap<Vec<&str>, Vec<usize>> = BTreeMap::new();
    let mut missing = 0;
    let values = |row: usize| columns.iter().map(|column| column[row].as_deref()).collect::<Option<Vec<_>>>();
    let is_wanted = |row: usize| table.wanted().is_none_or(|wanted| wanted[row]);
    for row in (0..height).filter(|&row| is_wanted(row)) {
        match values(row) {
            Some(values) => found.entry(values).or_default().push(row),
            None => missing += 1,
        }
        if found.len() > PARTS {
            return Err(PairsError::TooManyParts { by: by.join(","), most: PARTS, path: table.path() });
        }
    }
    if found.is_empty() {
        return Err(PairsError::NoRows { rows: height, columns: by.join(", "), path: table.path() });
    }
    // rows that are not wanted only have their places
    for row in (0..height).filter(|&row| !is_wanted(row)) {
        if let Some(rows) = values(row).and_then(|values| found.get_mut(&values)) {
            rows.push(row);
        }
    }
    for rows in found.values_mut() {
        rows.sort_unstable();
    }
    let height = (0..height).filter(|&row| is_wanted(row)).count();
    let note = (missing > 0)
        .then(|| format!("{NOTE}{missing} of {height} rows are in no part: a missing value in {}", by.join(", ")));
    let mut parts: Vec<(Vec<&str>, Vec<usize>)> = found.into_iter().collect();
    // numbers by size, in place of the order of their digits
    let number = |text: &str| text.parse::<f64>().ok().filter(|value| !value.is_nan());
    let numeric: Vec<bool> =
        (0..by.len()).map(|c| parts.iter().all(|(values, _)| number(values[c]).is_some())).collect();
    parts.sort_by(|(a, _), (b, _)| {
        let sizes = |c: usize| number(a[c]).zip(number(b[c])).and_then(|(a, b)| a.partial_cmp(&b));
        let one = |c: usize| sizes(c).filter(|_| numeric[c]).unwrap_or_else(|| a[c].cmp(b[c]));
        (0..by.len()).map(one).find(|order| order.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
    });
    let name = |values: Vec<&str>| {
        let equal = by.iter().zip(values).map(|(name, value)| format!("{name} = {value}"));
        equal.collect::<Vec<_>>().join(", ")
    };
    Ok(parts.into_iter().map(|(values, rows)| Part { rows, within: Some(name(values)), note: note.clone() }).collect())
}

/// Leaves out the rows that a predicate does not keep, and says how many are left.
pub(super) fn keep(table: &mut Table, predicate: &Predicate) -> Result<(), PairsError> {
    let (wanted, note) = found(table, predicate)?;
    table.keep(&wanted, note)
}

/// The same, but the rows stay in their places, for a lag to count them.
pub(super) fn mark(table: &mut Table, predicate: &Predicate) -> Result<(), PairsError> {
    let (wanted, note) = found(table, predicate)?;
    table.mark(wanted, note);
    Ok(())
}

/// Whether a predicate keeps each row.
pub(super) fn wanted(table: &Table, predicate: &Predicate) -> Result<Vec<bool>, PairsError> {
    let columns = predicate.columns().iter().map(|name| Cells::of(table, name)).collect::<Result<Vec<_>, _>>()?;
    let kinds: Vec<Kind> = columns.iter().map(Cells::kind).collect();
    let bound = predicate.bind(&kinds)?;
    let height = table.frame.height();
    Ok((0..height).map(|row| bound.keeps(&|column| columns[column].value(row))).collect())
}

/// The rows that were found to be kept when the table was read, and what is said of it.
fn found(table: &mut Table, predicate: &Predicate) -> Result<(Vec<bool>, String), PairsError> {
    let path = table.path();
    let fail = unreadable("table", &path);
    let column = table.frame.drop_in_place(WANTED).map_err(&fail)?;
    let wanted: Vec<bool> = column.bool().map_err(&fail)?.iter().map(|wanted| wanted == Some(true)).collect();
    let height = wanted.len();
    let left = wanted.iter().filter(|&&wanted| wanted).count();
    if left == 0 {
        let predicate = predicate.text().to_owned();
        return Err(PairsError::NothingKept { predicate, rows: height, path: table.path() });
    }
    Ok((wanted, format!("{left} of {height} rows kept by --where {}", predicate.text())))
}

/// The cells of a column, as a predicate sees them.
enum Cells {
    /// No cell has a value: they are of any kind.
    Nothing,
    Integers(Vec<Option<i128>>),
    Floats(Float64Chunked, f64),
    Truths(BooleanChunked),
    Words(StringChunked),
    /// Ticks, and nanoseconds in each.
    Instants(Int64Chunked, i128),
    /// No value at all: a piece of a column need not say what the others hold.
    Empty,
}

impl Cells {
    fn of(table: &Table, name: &str) -> Result<Self, PairsError> {
        let column = table.column(name)?.rechunk();
        let kind = column.dtype().clone();
        if column.null_count() == column.len() {
            return Ok(Self::Nothing);
        }
        let unfit = || super::numbers::not_numeric(table, &column);
        let cast = |kind: &DataType| -> Result<Column, PairsError> {
            column.to_physical_repr().cast(kind).ok().ok_or_else(unfit)
        };
        let integers = || Ok::<_, PairsError>(cast(&DataType::Int64)?.i64().ok().ok_or_else(unfit)?.clone());
        let floats = || Ok::<_, PairsError>(cast(&DataType::Float64)?.f64().ok().ok_or_else(unfit)?.clone());
        if column.null_count() == column.len() {
            return Ok(Self::Empty);
        }
        Ok(match Holds::of(&kind) {
            Holds::Numbers if kind.is_bool() => Self::Truths(column.bool().ok().ok_or_else(unfit)?.clone()),
            Holds::Numbers if kind.is_integer() => Self::Integers(super::numbers::integers(&column).ok_or_else(unfit)?),
            Holds::Numbers => Self::Floats(floats()?, 1.0),
            Holds::Times => Self::Floats(floats()?, per_second(&kind)),
            Holds::Dates => Self::Instants(integers()?, (dates::SECOND as f64 / per_second(&kind)) as i128),
            Holds::Words => {
                let words = column.cast(&DataType::String).ok().ok_or_else(unfit)?;
                Self::Words(words.str().ok().ok_or_else(unfit)?.clone())
            }
            Holds::Other => return Err(unfit()),
        })
    }

    fn kind(&self) -> Kind {
        match self {
            Self::Nothing | Self::Empty => Kind::Null,
            Self::Integers(_) | Self::Floats(..) => Kind::Number,
            Self::Truths(_) => Kind::Truth,
            Self::Words(_) => Kind::Text,
            Self::Instants(..) => Kind::Instant,
        }
    }

    fn value(&self, row: usize) -> Value<'_> {
        let value = match self {
            Self::Nothing | Self::Empty => None,
            Self::Integers(cells) => cells[row].map(Value::Integer),
            Self::Floats(cells, ticks) => cells.get(row).filter(|v| !v.is_nan()).map(|v| Value::Float(v / ticks)),
            Self::Truths(cells) => cells.get(row).map(Value::Truth),
            Self::Words(cells) => cells.get(row).map(Value::Text),
            Self::Instants(cells, each) => cells.get(row).map(|v| Value::Instant(i128::from(v) * each)),
        };
        value.unwrap_or(Value::Null)
    }
}
