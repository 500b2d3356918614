//! Named columns of a table as numbers: vectors flattened, words ranked.

use std::path::Path;

use polars::prelude::{Column, DataFrame, DataType};

use super::form::unreadable;
use crate::pairs::PairsError;
use crate::schema::Columns;

pub(super) fn is_numeric(kind: &DataType) -> bool {
    kind.is_primitive_numeric() || kind.is_bool()
}

pub(super) fn column<'a>(frame: &'a DataFrame, name: &str, path: &Path) -> Result<&'a Column, PairsError> {
    frame.column(name).map_err(unreadable("table", path))
}

pub(super) fn not_numeric(frame: &DataFrame, column: &Column, path: &Path) -> PairsError {
    let numeric: Vec<&str> =
        frame.columns().iter().filter(|c| is_numeric(c.dtype())).map(|c| c.name().as_str()).collect();
    let hint = if numeric.is_empty() {
        "none of the columns asked for is numeric".to_owned()
    } else {
        format!("of the columns asked for, {} are numeric", numeric.join(", "))
    };
    let kind = if column.dtype() == &DataType::String { "text".to_owned() } else { column.dtype().to_string() };
    PairsError::NotNumeric { name: column.name().to_string(), kind, hint, path: path.to_owned() }
}

/// A column of words as the ranks of its words, a missing one NaN; `None` for any other column.
pub(super) fn ranks(column: &Column) -> Option<Vec<f64>> {
    let words = column.str().ok()?;
    let mut levels: Vec<&str> = words.iter().flatten().collect();
    levels.sort_unstable();
    levels.dedup();
    let rank = |word: Option<&str>| word.map_or(f64::NAN, |word| levels.partition_point(|l| *l < word) as f64);
    Some(words.iter().map(rank).collect())
}

/// Named columns side by side, vectors flattened, words ranked; a missing value is NaN.
pub(super) fn numbers(frame: &DataFrame, names: &[String], path: &Path) -> Result<Columns, PairsError> {
    let mut parts: Vec<(usize, Vec<f64>)> = Vec::new();
    let mut out = Columns::default();
    for name in names {
        let column = column(frame, name, path)?;
        let words = ranks(column);
        let is_words = words.is_some();
        let (width, values) = words.map_or_else(|| flat(frame, column, path), |words| Ok((1, words)))?;
        // beyond this a square is no number any more, and a column would look constant
        if let Some(at) = values.iter().position(|v| v.abs() > 1e150) {
            return Err(PairsError::Infinite { name: name.clone(), row: at / width + 1, path: path.to_owned() });
        }
        out.words.extend(std::iter::repeat_n(is_words, width));
        if width == 1 && (is_words || is_numeric(column.dtype())) {
            out.names.push(name.clone());
        } else {
            out.names.extend((0..width).map(|i| format!("{name}[{i}]")));
        }
        parts.push((width, values));
    }
    for row in 0..frame.height() {
        for (width, values) in &parts {
            out.data.extend_from_slice(&values[row * width..(row + 1) * width]);
        }
    }
    Ok(out)
}

/// Width and row-major values of one column.
pub(super) fn flat(frame: &DataFrame, column: &Column, path: &Path) -> Result<(usize, Vec<f64>), PairsError> {
    let unfit = || not_numeric(frame, column, path);
    let plain = |column: &Column| -> Result<Vec<f64>, PairsError> {
        let cast = column.cast(&DataType::Float64).ok().ok_or_else(unfit)?;
        Ok(cast.f64().ok().ok_or_else(unfit)?.iter().map(|v| v.unwrap_or(f64::NAN)).collect())
    };
    let vectors: Vec<Option<Vec<f64>>> = match column.dtype() {
        kind if is_numeric(kind) => return Ok((1, plain(column)?)),
        DataType::Array(inner, _) | DataType::List(inner) if is_numeric(inner) => {
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
    for (row, vector) in vectors.into_iter().enumerate() {
        let vector = vector.unwrap_or_else(|| vec![f64::NAN; width]);
        if vector.len() != width {
            let (name, path) = (column.name().to_string(), path.to_owned());
            return Err(PairsError::Ragged { name, row: row + 1, expected: width, found: vector.len(), path });
        }
        data.extend(vector);
    }
    Ok((width, data))
}
