//! Parquet columns as checked vectors.

use std::fs::File;
use std::path::{Path, PathBuf};

use polars::prelude::{Column, DataFrame, DataType, ParquetReader, SerReader as _};

use crate::io::{IoError, printable};
use crate::report::ReportError;

/// A table and where it came from.
pub(super) struct Columns {
    frame: DataFrame,
    path: PathBuf,
}

/// Runs what touches a foreign table; a panic of the Parquet reader on a damaged file becomes an error of ours.
pub(super) fn guarded<T>(path: &Path, read: impl FnOnce() -> Result<T, ReportError>) -> Result<T, ReportError> {
    crate::io::caught(read).unwrap_or_else(|| {
        Err(ReportError::Parquet { message: "the file is damaged".to_owned(), path: path.to_owned() })
    })
}

impl Columns {
    /// Reads a whole Parquet file.
    pub(super) fn open(path: &Path) -> Result<Self, ReportError> {
        if !path.exists() {
            return Err(IoError::Missing(path.to_owned()).into());
        }
        let file = File::open(path).map_err(IoError::os("open", path))?;
        let unreadable = |message: String| ReportError::Parquet {
            message: message.lines().next().unwrap_or_default().to_owned(),
            path: path.to_owned(),
        };
        let frame = ParquetReader::new(file).finish().map_err(|e| unreadable(e.to_string()))?;
        Ok(Self { frame, path: path.to_owned() })
    }

    /// The same, of at least one row.
    pub(super) fn open_filled(path: &Path) -> Result<Self, ReportError> {
        let table = Self::open(path)?;
        if table.frame.height() == 0 { Err(ReportError::NoRows(path.to_owned())) } else { Ok(table) }
    }

    fn column(
        &self,
        name: &'static str,
        kind: &'static str,
        fits: fn(&DataType) -> bool,
    ) -> Result<Column, ReportError> {
        let Ok(column) = self.frame.column(name) else {
            let names: Vec<&str> = self.frame.columns().iter().map(|c| c.name().as_str()).take(24).collect();
            let found = if names.is_empty() { "no columns".to_owned() } else { names.join(", ") };
            return Err(ReportError::MissingColumn { column: name, kind, found, path: self.path.clone() });
        };
        if fits(column.dtype()) || *column.dtype() == DataType::Null {
            return Ok(column.clone());
        }
        let found = column.dtype().to_string();
        Err(ReportError::ColumnType { column: name, kind, found, path: self.path.clone() })
    }

    fn cast(
        &self,
        name: &'static str,
        kind: &'static str,
        fits: fn(&DataType) -> bool,
        to: &DataType,
    ) -> Result<Column, ReportError> {
        let column = self.column(name, kind, fits)?;
        let found = column.dtype().to_string();
        let path = self.path.clone();
        let wrong = |_| ReportError::ColumnType { column: name, kind, found, path };
        column.cast(to).map_err(wrong)
    }

    fn internal<T>(&self, what: polars::prelude::PolarsResult<T>) -> Result<T, ReportError> {
        what.map_err(|e| ReportError::Parquet { message: e.to_string(), path: self.path.clone() })
    }

    /// Nulls where `values` must have none.
    fn filled<T>(&self, name: &'static str, kind: &'static str, values: Vec<Option<T>>) -> Result<Vec<T>, ReportError> {
        let null =
            |row| ReportError::Value { column: name, row, kind, found: "null".to_owned(), path: self.path.clone() };
        values.into_iter().enumerate().map(|(row, v)| v.ok_or_else(|| null(row))).collect()
    }

    /// Numbers, null where null.
    pub(super) fn numbers_or_null(&self, name: &'static str) -> Result<Vec<Option<f64>>, ReportError> {
        let column = self.cast(name, "numbers", DataType::is_primitive_numeric, &DataType::Float64)?;
        Ok(self.internal(column.f64())?.iter().collect())
    }

    /// Finite numbers.
    pub(super) fn finite(&self, name: &'static str) -> Result<Vec<f64>, ReportError> {
        let values = self.filled(name, "a finite number", self.numbers_or_null(name)?)?;
        match values.iter().position(|v| !v.is_finite()) {
            None => Ok(values),
            Some(row) => {
                let found = values[row].to_string();
                Err(ReportError::Value { column: name, row, kind: "a finite number", found, path: self.path.clone() })
            }
        }
    }

    /// Whole numbers.
    pub(super) fn whole(&self, name: &'static str) -> Result<Vec<i64>, ReportError> {
        let column = self.cast(name, "whole numbers", DataType::is_integer, &DataType::Int64)?;
        let values = self.internal(column.i64())?.iter().collect();
        self.filled(name, "a whole number", values)
    }

    /// Text, null where null; control characters escaped, so that nothing downstream can be steered by them.
    pub(super) fn text_or_null(&self, name: &'static str) -> Result<Vec<Option<String>>, ReportError> {
        let column = self.cast(name, "text", |t| *t == DataType::String, &DataType::String)?;
        Ok(self.internal(column.str())?.iter().map(|v| v.map(printable)).collect())
    }

    /// Text.
    pub(super) fn text(&self, name: &'static str) -> Result<Vec<String>, ReportError> {
        let values = self.text_or_null(name)?;
        self.filled(name, "text", values)
    }

    /// Booleans, null where null.
    pub(super) fn bits_or_null(&self, name: &'static str) -> Result<Vec<Option<bool>>, ReportError> {
        let column = self.cast(name, "booleans", |t| *t == DataType::Boolean, &DataType::Boolean)?;
        Ok(self.internal(column.bool())?.iter().collect())
    }
}
