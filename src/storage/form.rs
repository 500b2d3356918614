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
    /// Arrow IPC with a footer (Feather 2).
    IpcFile,
    /// Arrow IPC as a stream of messages.
    IpcStream,
    /// One `NumPy` array.
    Npy,
    /// MCAP.
    Mcap,
}

impl TableForm {
    /// As messages call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Csv => "CSV",
            Self::Tsv => "TSV",
            Self::Parquet => "Parquet",
            Self::IpcFile => "Arrow IPC",
            Self::IpcStream => "Arrow IPC stream",
            Self::Npy => "NPY",
            Self::Mcap => "MCAP",
        }
    }
}

/// How a form begins.
const FIRST_BYTES: [(&[u8], TableForm); 5] = [
    (b"PAR1", TableForm::Parquet),
    (b"ARROW1", TableForm::IpcFile),
    (&[0xff; 4], TableForm::IpcStream),
    (b"\x93NUMPY", TableForm::Npy),
    (b"\x89MCAP0\r\n", TableForm::Mcap),
];

/// How the names of a form end.
const ENDINGS: [(&str, TableForm); 8] = [
    ("parquet", TableForm::Parquet),
    ("tsv", TableForm::Tsv),
    ("tab", TableForm::Tsv),
    ("arrow", TableForm::IpcFile),
    ("ipc", TableForm::IpcFile),
    ("feather", TableForm::IpcFile),
    ("npy", TableForm::Npy),
    ("mcap", TableForm::Mcap),
];

/// The form of a file: by its first bytes, else by the ending of its name.
///
/// # Errors
/// [`IoError::Os`].
pub fn table_form(path: &Path) -> Result<TableForm, IoError> {
    let mut magic = Vec::new();
    let file = File::open(path).map_err(IoError::os("open", path))?;
    file.take(8).read_to_end(&mut magic).map_err(IoError::os("read", path))?;
    let begins = FIRST_BYTES.iter().find(|(first, _)| magic.starts_with(first)).map(|(_, form)| *form);
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let ends = ENDINGS.iter().find(|(name, _)| *name == ending).map(|(_, form)| *form);
    Ok(begins.or(ends).unwrap_or(TableForm::Csv))
}
