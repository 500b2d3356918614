//! A table in any form: what every form's file implements, and which form a file has.
//!
//! Adding a form: write `<form>.rs` with a [`TableFile`], name it in [`crate::storage::TableForm`], and open it below.

use std::fs::File;
use std::path::Path;

use polars::prelude::{ArrowDataType, ArrowField, DataFrame, PolarsError};

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

    /// The columns among them of a type that no reader here takes, each with that type.
    fn unusable(&self) -> Result<Vec<(String, String)>, PairsError> {
        Ok(Vec::new())
    }

    /// Columns that it has, each name once; the cells of text as they stand there.
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

/// The columns of a schema whose type makes polars panic: decimals, half floats, structures and the like.
pub(super) fn unusable<'a>(fields: impl Iterator<Item = &'a ArrowField>) -> Vec<(String, String)> {
    let of = |field: &ArrowField| (field.name.to_string(), format!("{:?}", field.dtype));
    fields.filter(|field| !is_usable(&field.dtype)).map(of).collect()
}

fn is_usable(kind: &ArrowDataType) -> bool {
    use ArrowDataType as Type;
    match kind {
        Type::List(inner) | Type::LargeList(inner) | Type::FixedSizeList(inner, _) => is_usable(&inner.dtype),
        Type::Dictionary(_, inner, _) => is_usable(inner),
        other => matches!(
            other,
            Type::Null
                | Type::Boolean
                | Type::Float32
                | Type::Float64
                | Type::Int8
                | Type::Int16
                | Type::Int32
                | Type::Int64
                | Type::UInt8
                | Type::UInt16
                | Type::UInt32
                | Type::UInt64
                | Type::Timestamp(..)
                | Type::Date32
                | Type::Date64
                | Type::Time32(_)
                | Type::Time64(_)
                | Type::Duration(_)
                | Type::Binary
                | Type::LargeBinary
                | Type::BinaryView
                | Type::Utf8
                | Type::LargeUtf8
                | Type::Utf8View
        ),
    }
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
