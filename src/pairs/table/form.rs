//! A table in any form: what every form's file implements, and which form a file has.
//!
//! Adding a form: write `<form>.rs` with a [`TableFile`], name it in [`crate::storage::TableForm`], and open it below.

use std::fs::File;
use std::path::Path;

use polars::prelude::{DataFrame, PolarsError};

use super::ipc::Ipc;
use super::npy::Npy;
use super::parquet::Parquet;
use super::text::Text;
use super::topics::Topics;
use crate::io::IoError;
use crate::pairs::PairsError;
use crate::storage::{TableForm, table_form};

/// One foreign file of named columns.
pub(super) trait TableFile {
    /// The names of its columns, in its order.
    fn names(&self) -> Result<Vec<String>, PairsError>;

    /// Columns that it has, each name once; the cells of text as they stand there.
    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError>;
}

/// Opens a file and runs what touches its data.
pub(super) fn caught<T>(
    path: &Path,
    read: impl FnOnce(&dyn TableFile) -> Result<T, PairsError>,
) -> Result<T, PairsError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    if path.is_dir() {
        return Err(PairsError::Directory(path.to_owned()));
    }
    let form = table_form(path)?;
    guarded(path, form, || read(opened(path, form)?.as_ref()))
}

/// Runs what touches a foreign file's data; a panic in there becomes an error of ours.
pub(super) fn guarded<T>(
    path: &Path,
    form: TableForm,
    read: impl FnOnce() -> Result<T, PairsError>,
) -> Result<T, PairsError> {
    crate::io::caught(read).unwrap_or_else(|| {
        let message = "the file is damaged".to_owned();
        Err(PairsError::Unreadable { form: form.name(), message, path: path.to_owned() })
    })
}

fn opened(path: &Path, form: TableForm) -> Result<Box<dyn TableFile>, PairsError> {
    Ok(match form {
        TableForm::Csv => Box::new(Text::new(path, form, b',')?),
        TableForm::Tsv => Box::new(Text::new(path, form, b'\t')?),
        TableForm::Parquet => Box::new(Parquet::new(path)?),
        TableForm::IpcFile | TableForm::IpcStream => Box::new(Ipc::new(path, form)?),
        TableForm::Npy => Box::new(Npy::new(path)?),
        TableForm::Mcap => Box::new(Topics::new(path)),
    })
}

/// The file, open.
pub(super) fn open(path: &Path) -> Result<File, PairsError> {
    Ok(File::open(path).map_err(IoError::os("open", path))?)
}

/// The first line of what polars has to say.
pub(super) fn unreadable(form: &'static str, path: &Path) -> impl Fn(PolarsError) -> PairsError {
    let path = path.to_owned();
    move |error| {
        let message = error.to_string().lines().next().unwrap_or_default().to_owned();
        PairsError::Unreadable { form, message, path: path.clone() }
    }
}
