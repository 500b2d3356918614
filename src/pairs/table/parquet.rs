//! Parquet.

use std::path::{Path, PathBuf};

use polars::prelude::{DataFrame, ParquetReader, SerReader as _};

use super::form::{TableFile, open, unreadable, unusable};
use crate::pairs::PairsError;
use crate::storage::TableForm;

const FORM: &str = "Parquet";

/// A Parquet file whose digest and pages were checked.
pub(super) struct Parquet(PathBuf);

impl Parquet {
    pub(super) fn new(path: &Path) -> Result<Self, PairsError> {
        crate::storage::check_table(path, TableForm::Parquet)?;
        Ok(Self(path.to_owned()))
    }
}

impl TableFile for Parquet {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let schema = ParquetReader::new(open(&self.0)?).schema().map_err(unreadable(FORM, &self.0))?;
        Ok(schema.iter_names().map(ToString::to_string).collect())
    }

    fn unusable(&self) -> Result<Vec<(String, String)>, PairsError> {
        let schema = ParquetReader::new(open(&self.0)?).schema().map_err(unreadable(FORM, &self.0))?;
        Ok(unusable(schema.iter_values()))
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        let columns = columns.iter().map(|c| (*c).to_owned()).collect();
        let frame = ParquetReader::new(open(&self.0)?).with_columns(Some(columns)).finish();
        frame.map_err(unreadable(FORM, &self.0))
    }
}

/// Whether a Parquet file says that it is a rollout store.
pub(super) fn is_store(path: &Path) -> Result<bool, PairsError> {
    let mut reader = ParquetReader::new(open(path)?);
    let metadata = reader.get_metadata().map_err(unreadable(FORM, path))?;
    Ok(metadata.key_value_metadata().iter().flatten().any(|kv| kv.key == "ccmarl.manifest"))
}
