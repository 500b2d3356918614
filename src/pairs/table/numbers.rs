//! Named columns of a table as numbers: vectors flattened, dates and times in seconds, words ranked.

use polars::prelude::{Column, DataType, TimeUnit};

use super::several::Table;
use crate::pairs::PairsError;
use crate::schema::Columns;

/// Beyond this a square is no number any more, and a column would look constant.
const LARGEST: f64 = 1e150;

/// What a column holds, as far as this program can use it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Holds {
    /// Integers, floats, truth values.
    Numbers,
    /// Instants or days.
    Dates,
    /// Times of day, or spans of time.
    Times,
    /// Text and categories.
    Words,
    /// Anything else; vectors too.
    Other,
}

impl Holds {
    pub(super) fn of(kind: &DataType) -> Self {
        match kind {
            kind if kind.is_primitive_numeric() || kind.is_bool() => Self::Numbers,
            DataType::Date | DataType::Datetime(..) => Self::Dates,
            DataType::Time | DataType::Duration(_) => Self::Times,
            DataType::String | DataType::Categorical(..) | DataType::Enum(..) => Self::Words,
            _ => Self::Other,
        }
    }
}

/// Ticks per second of a type of dates or times, in whose ticks its values are stored; days for [`DataType::Date`].
pub(super) fn per_second(kind: &DataType) -> f64 {
    match kind {
        DataType::Date => 1.0 / 86_400.0,
        DataType::Datetime(unit, _) | DataType::Duration(unit) => match unit {
            TimeUnit::Milliseconds => 1e3,
            TimeUnit::Microseconds => 1e6,
            TimeUnit::Nanoseconds => 1e9,
        },
        _ => 1e9,
    }
}

/// What a reader of the result must know of columns that became numbers.
pub(super) fn notes(table: &Table, names: &[&str]) -> Result<Vec<String>, PairsError> {
    let mut out = Vec::new();
    for name in names {
        match Holds::of(table.column(name)?.dtype()) {
            Holds::Dates => out.push(format!("dates of {name} are seconds since the first of them")),
            Holds::Times => out.push(format!("times of {name} are seconds")),
            Holds::Numbers if shift(&table.values(name)?).is_some() => {
                out.push(format!("integers of {name} are counted from the least of them: they do not fit a float"));
            }
            _ => {}
        }
    }
    out.dedup();
    Ok(out)
}

pub(super) fn not_numeric(table: &Table, column: &Column) -> PairsError {
    let numeric: Vec<&str> = table
        .frame
        .columns()
        .iter()
        .filter(|c| Holds::of(c.dtype()) == Holds::Numbers)
        .map(|c| c.name().as_str())
        .collect();
    let hint = if numeric.is_empty() {
        "none of the columns asked for is numeric".to_owned()
    } else {
        format!("of the columns asked for, {} are numeric", numeric.join(", "))
    };
    let kind = if column.dtype() == &DataType::String { "text".to_owned() } else { column.dtype().to_string() };
    PairsError::NotNumeric { name: column.name().to_string(), kind, hint, path: table.path() }
}

/// Most words of a column that are kept beside their ranks: a picture has no place for more.
const LEVELS: usize = 20;

/// A column of words as the ranks of its words, a missing one NaN, and the words if they are few; `None` for any other
/// column.
fn ranks(column: &Column) -> Option<(Vec<f64>, Vec<String>)> {
    if Holds::of(column.dtype()) != Holds::Words {
        return None;
    }
    let column = column.cast(&DataType::String).ok()?;
    let words = column.str().ok()?;
    let mut levels: Vec<&str> = words.iter().flatten().collect();
    levels.sort_unstable();
    levels.dedup();
    let rank = |word: Option<&str>| word.map_or(f64::NAN, |word| levels.partition_point(|l| *l < word) as f64);
    let few = levels.iter().filter(|_| levels.len() <= LEVELS).map(|&word| word.to_owned()).collect();
    Some((words.iter().map(rank).collect(), few))
}

/// Named columns side by side, vectors flattened, words ranked; a missing value is NaN.
pub(super) fn numbers(table: &Table, names: &[String]) -> Result<Columns, PairsError> {
    let mut parts: Vec<(usize, Vec<f64>)> = Vec::new();
    let mut out = Columns::default();
    for name in names {
        let column = &table.values(name)?;
        let words = ranks(column);
        let is_words = words.is_some();
        let (width, values, levels) = match words {
            Some((ranks, levels)) => (1, ranks, levels),
            None => flat(table, column).map(|(width, values)| (width, values, Vec::new()))?,
        };
        if let Some(at) = values.iter().position(|v| v.abs() > LARGEST) {
            let (row, path) = table.place(at / width);
            return Err(PairsError::Infinite { name: name.clone(), row, value: values[at], path });
        }
        out.words.extend(std::iter::repeat_n(is_words, width));
        out.levels.extend(std::iter::repeat_n(levels, width));
        if width == 1 && Holds::of(column.dtype()) != Holds::Other {
            out.names.push(name.clone());
        } else {
            out.names.extend((0..width).map(|i| format!("{name}[{i}]")));
        }
        parts.push((width, values));
    }
    for row in 0..table.frame.height() {
        for (width, values) in &parts {
            out.data.extend_from_slice(&values[row * width..(row + 1) * width]);
        }
    }
    Ok(out)
}

/// What is taken from every integer or tick of a column before it becomes a float, so that it fits: the least of them.
/// Dates always, since their zero means nothing; integers only when one is too large.
fn shift(column: &Column) -> Option<i128> {
    let dates = Holds::of(column.dtype()) == Holds::Dates;
    if !(dates || column.dtype().is_integer()) {
        return None;
    }
    let integers = integers(column)?;
    let least = integers.iter().flatten().min()?;
    let large = integers.iter().flatten().any(|value| value.unsigned_abs() > 1 << f64::MANTISSA_DIGITS);
    (dates || large).then_some(*least)
}

/// The integers or ticks of a column, the unsigned ones beyond 2⁶³ too.
pub(super) fn integers(column: &Column) -> Option<Vec<Option<i128>>> {
    let ticks = column.to_physical_repr();
    if let Ok(unsigned) = ticks.u64() {
        return Some(unsigned.iter().map(|value| value.map(i128::from)).collect());
    }
    let signed = ticks.cast(&DataType::Int64).ok()?;
    Some(signed.i64().ok()?.iter().map(|value| value.map(i128::from)).collect())
}

/// Integers or ticks, less `least`; a missing one is NaN.
fn shifted(column: &Column, least: i128) -> Option<Vec<f64>> {
    let value = |value: Option<i128>| value.map_or(f64::NAN, |value| (value - least) as f64);
    Some(integers(column)?.into_iter().map(value).collect())
}

/// Width and row-major values of one column.
fn flat(table: &Table, column: &Column) -> Result<(usize, Vec<f64>), PairsError> {
    let unfit = || not_numeric(table, column);
    let plain = |column: &Column| -> Result<Vec<f64>, PairsError> {
        let cast = column.cast(&DataType::Float64).ok().ok_or_else(unfit)?;
        Ok(cast.f64().ok().ok_or_else(unfit)?.iter().map(|v| v.unwrap_or(f64::NAN)).collect())
    };
    let vectors: Vec<Option<Vec<f64>>> = match column.dtype() {
        kind if matches!(Holds::of(kind), Holds::Numbers | Holds::Dates | Holds::Times) => {
            let ticks = match shift(column) {
                Some(least) => shifted(column, least).ok_or_else(unfit)?,
                None => plain(&column.to_physical_repr())?,
            };
            let each = if Holds::of(kind) == Holds::Numbers { 1.0 } else { per_second(kind) };
            return Ok((1, ticks.into_iter().map(|v| v / each).collect()));
        }
        DataType::Array(inner, _) | DataType::List(inner) if Holds::of(inner) == Holds::Numbers => {
            let list = column.cast(&DataType::List(Box::new(DataType::Float64))).ok().ok_or_else(unfit)?;
            let list = list.list().ok().ok_or_else(unfit)?.clone();
            (0..list.len())
                .map(|i| list.get_as_series(i).map(|s| plain(&s.into())).transpose())
                .collect::<Result<_, _>>()?
        }
        _ => return Err(unfit()),
    };
    let width = vectors.iter().flatten().map(Vec::len).next().unwrap_or(1).max(1);
    let mut data = Vec::with_capacity(vectors.len() * width);
    for (at, vector) in vectors.into_iter().enumerate() {
        let vector = vector.unwrap_or_else(|| vec![f64::NAN; width]);
        if vector.len() != width {
            let (name, (row, path)) = (column.name().to_string(), table.place(at));
            return Err(PairsError::Ragged { name, row, expected: width, found: vector.len(), path });
        }
        data.extend(vector);
    }
    Ok((width, data))
}
