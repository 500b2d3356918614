//! Arrow IPC: files (Feather 2) and streams.

use std::path::{Path, PathBuf};

use polars::prelude::{ArrowField, DataFrame, IpcReader, IpcStreamReader, SerReader as _};

use super::form::{TableFile, open, unreadable, unusable};
use crate::pairs::PairsError;
use crate::storage::TableForm;

/// An Arrow IPC file whose lengths were checked.
pub(super) struct Ipc {
    path: PathBuf,
    form: TableForm,
}

impl Ipc {
    pub(super) fn new(path: &Path, form: TableForm) -> Result<Self, PairsError> {
        crate::storage::check_table(path, form)?;
        Ok(Self { path: path.to_owned(), form })
    }

    fn fields(&self) -> Result<Vec<ArrowField>, PairsError> {
        let file = open(&self.path)?;
        let fields = if self.is_stream() {
            IpcStreamReader::new(file).arrow_schema().map(|schema| schema.iter_values().cloned().collect())
        } else {
            IpcReader::new(file).schema().map(|schema| schema.iter_values().cloned().collect())
        };
        fields.map_err(unreadable(self.form.name(), &self.path))
    }

    fn is_stream(&self) -> bool {
        self.form == TableForm::IpcStream
    }
}

impl TableFile for Ipc {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        Ok(self.fields()?.into_iter().map(|field| field.name.to_string()).collect())
    }

    fn unusable(&self) -> Result<Vec<(String, String)>, PairsError> {
        Ok(unusable(self.fields()?.iter()))
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        let columns = Some(columns.iter().map(|c| (*c).to_owned()).collect());
        let file = open(&self.path)?;
        let frame = if self.is_stream() {
            IpcStreamReader::new(file).with_columns(columns).finish()
        } else {
            IpcReader::new(file).with_columns(columns).finish()
        };
        frame.map_err(unreadable(self.form.name(), &self.path))
    }
}
