//! A table in any form: what every form's file implements, and which form a file has.
//!
//! Adding a form: write `<form>.rs` with a [`TableFile`], name it in [`crate::storage::TableForm`], and open it below.

use std::fs::File;
use std::path::Path;

use polars::prelude::{DataFrame, PolarsError};

use super::parquet::Parquet;
use super::text::Text;
use crate::io::IoError;
use crate::pairs::PairsError;
use crate::registry::did_you_mean;
use crate::storage::{TableForm, table_form};

/// One foreign file of named columns.
pub(super) trait TableFile {
    /// The names of its columns, in its order.
    fn names(&self) -> Result<Vec<String>, PairsError>;

    /// Columns that it has, each name once.
    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError>;

    /// Bytes that these columns take in memory, about; `None` where only reading tells.
    fn size(&self, _columns: &[&str]) -> Result<Option<u64>, PairsError> {
        Ok(None)
    }

    /// Rows, where the file says it.
    fn rows(&self) -> Result<Option<u64>, PairsError> {
        Ok(None)
    }

    /// The same file as several smaller ones, whose rows follow each other; `None` for a form that cannot be cut.
    fn pieces(&self, _size: PieceSize) -> Result<Option<Pieces<'_>>, PairsError> {
        Ok(None)
    }
}

/// Pieces of a file, one after the other.
pub(super) type Pieces<'a> = Box<dyn Iterator<Item = Result<Box<dyn TableFile + 'a>, PairsError>> + 'a>;

/// How large pieces may be, which changes no result.
#[derive(Clone, Copy, Debug)]
pub struct PieceSize {
    /// Rows, where they are known before they are read.
    pub rows: usize,
    /// Bytes of text.
    pub bytes: usize,
}

impl Default for PieceSize {
    fn default() -> Self {
        Self { rows: 1 << 19, bytes: 32 << 20 }
    }
}

/// Opens a file and runs what touches its data.
pub(super) fn caught<T>(
    path: &Path,
    read: impl FnOnce(&dyn TableFile) -> Result<T, PairsError>,
) -> Result<T, PairsError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
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
        TableForm::Csv => Box::new(Text::new(path, form, b',')),
        TableForm::Tsv => Box::new(Text::new(path, form, b'\t')),
        TableForm::Parquet => Box::new(Parquet::new(path)?),
    })
}

/// The wanted columns of a file, which must have them.
pub(super) fn wanted(file: &dyn TableFile, path: &Path, wanted: &[&str]) -> Result<DataFrame, PairsError> {
    let names = file.names()?;
    if let Some(&name) = wanted.iter().find(|w| !names.iter().any(|n| n == *w)) {
        let hint = did_you_mean(name, names.iter().map(String::as_str));
        return Err(PairsError::UnknownColumn { name: name.to_owned(), hint, path: path.to_owned() });
    }
    let mut columns: Vec<&str> = wanted.to_vec();
    columns.sort_unstable();
    columns.dedup();
    file.read(&columns)
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
