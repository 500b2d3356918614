//! Rows as a file: JSON, CSV or Parquet; and whether a file holds such rows.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;

use polars::prelude::{
    Column, CsvWriter, DataFrame, ParquetReader, ParquetWriter, PlSmallStr, SerReader as _, SerWriter as _,
};
use serde::Serialize;

use crate::io;

/// Largest file that is recognised, bytes.
const FILE_LIMIT: u64 = 64 << 20;

/// A kind of row that is written to files.
pub trait Row: Serialize + Sized {
    /// The columns of these rows, named and ordered as the keys of JSON.
    fn columns(rows: &[Self]) -> Vec<Column>;
}

/// A column of text.
pub(super) fn text<R>(name: &str, rows: &[R], of: impl Fn(&R) -> Option<String>) -> Column {
    Column::new(name.into(), rows.iter().map(of).collect::<Vec<Option<String>>>())
}

/// A column of numbers.
pub(super) fn number<R>(name: &str, rows: &[R], of: impl Fn(&R) -> Option<f64>) -> Column {
    Column::new(name.into(), rows.iter().map(of).collect::<Vec<Option<f64>>>())
}

/// The rows as indented JSON.
///
/// # Errors
/// A message, should serde refuse.
pub fn to_json<R: Row>(rows: &[R]) -> Result<Vec<u8>, String> {
    let mut text = serde_json::to_vec_pretty(rows).map_err(|e| e.to_string())?;
    text.push(b'\n');
    Ok(text)
}

/// The rows as a Parquet file.
///
/// # Errors
/// A message, should polars refuse.
pub fn to_parquet<R: Row>(rows: &[R]) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    ParquetWriter::new(&mut bytes).finish(&mut frame(rows)?).map_err(|e| e.to_string())?;
    Ok(bytes)
}

/// The rows as CSV with a header.
///
/// # Errors
/// A message, should polars refuse.
pub fn to_csv<R: Row>(rows: &[R]) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    CsvWriter::new(&mut bytes).finish(&mut frame(rows)?).map_err(|e| e.to_string())?;
    Ok(bytes)
}

/// Whether a file holds such rows and nothing else, by its ending and its columns; an empty file is nobody's, and a list
/// without a row may be anybody's.
pub fn holds<R: Row>(path: &Path) -> bool {
    let keys: Vec<String> = R::columns(&[]).iter().map(|c| c.name().to_string()).collect();
    let Ok(file) = File::open(path) else { return false };
    if file.metadata().is_ok_and(|file| file.is_file() && file.len() == 0) {
        return true;
    }
    match path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).as_deref() {
        Some("json") => {
            let text = io::read_text(path, FILE_LIMIT).unwrap_or_default();
            let rows = serde_json::from_str::<Vec<serde_json::Map<String, serde_json::Value>>>(&text);
            rows.is_ok_and(|rows| !rows.is_empty() && rows.iter().all(|row| row.keys().eq(&keys)))
        }
        Some("csv") => {
            let mut header = String::new();
            let read = BufReader::new(file.take(4096)).read_line(&mut header);
            read.is_ok() && header.trim_end() == keys.join(",")
        }
        Some("parquet") => {
            let schema = io::caught(|| ParquetReader::new(file).schema());
            schema.is_some_and(|schema| schema.is_ok_and(|s| s.iter_names().map(PlSmallStr::as_str).eq(keys.iter())))
        }
        _ => false,
    }
}

fn frame<R: Row>(rows: &[R]) -> Result<DataFrame, String> {
    DataFrame::new(rows.len(), R::columns(rows)).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::{Estimate, Kind, Unit};
    use crate::schema::SampleLabels;

    #[test]
    fn a_list_without_a_row_is_not_ours() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("rows.json");
        let row = Estimate::new("gaussian", &SampleLabels::default(), 1.0, Unit::Nats, Kind::Estimate, 3);
        for (bytes, ours) in [(b"[]".to_vec(), false), (to_json(&[row]).unwrap(), true), (b"[{}]".to_vec(), false)] {
            io::write_atomic(&path, &bytes).unwrap();
            assert_eq!(holds::<Estimate>(&path), ours);
        }
    }
}
