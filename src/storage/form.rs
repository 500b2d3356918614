//! Which form anybody's table has.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use crate::io::IoError;

/// The form of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TableForm {
    /// Text, separated by commas.
    Csv,
    /// Text, separated by tabs.
    Tsv,
    /// Parquet.
    Parquet,
}

impl TableForm {
    /// As messages call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Csv => "CSV",
            Self::Tsv => "TSV",
            Self::Parquet => "Parquet",
        }
    }
}

/// The form of a file: by its first bytes, else by the ending of its name.
///
/// # Errors
/// [`IoError::Os`].
pub fn table_form(path: &Path) -> Result<TableForm, IoError> {
    let mut magic = Vec::new();
    let file = File::open(path).map_err(IoError::os("open", path))?;
    file.take(8).read_to_end(&mut magic).map_err(IoError::os("read", path))?;
    let named = |extension: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension));
    Ok(if magic.starts_with(b"PAR1") || named("parquet") {
        TableForm::Parquet
    } else if named("tsv") || named("tab") {
        TableForm::Tsv
    } else {
        TableForm::Csv
    })
}
