//! Arrow IPC: files (Feather 2) and streams.

use std::path::{Path, PathBuf};

use polars::prelude::{DataFrame, IpcReader, IpcStreamReader, SerReader as _};

use super::form::{TableFile, open, unreadable};
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

    fn is_stream(&self) -> bool {
        self.form == TableForm::IpcStream
    }
}

impl TableFile for Ipc {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let (file, unreadable) = (open(&self.path)?, unreadable(self.form.name(), &self.path));
        let names = if self.is_stream() {
            IpcStreamReader::new(file).schema().map(|s| s.iter_names().map(ToString::to_string).collect())
        } else {
            IpcReader::new(file).schema().map(|s| s.iter_names().map(ToString::to_string).collect())
        };
        names.map_err(unreadable)
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
