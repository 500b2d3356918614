//! The crate's error: one enum per room, wrapped here, and the exit code each deserves.

use crate::io::IoError;
use crate::record::RecordError;
use crate::registry::RegistryError;
use crate::schema::SchemaError;
use crate::storage::StorageError;

/// Any error of the crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Files and directories.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A plugin's name or parameters.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// Recording.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// Data against the schema.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// A store.
    #[error(transparent)]
    Storage(#[from] StorageError),
}

impl Error {
    /// Whether the user's words are at fault (exit code 2), not the data or the machine (exit code 1).
    pub fn is_usage(&self) -> bool {
        match self {
            Self::Registry(_) | Self::Io(IoError::Exists(_)) | Self::Record(RecordError::NoEpisodes) => true,
            Self::Storage(StorageError::Io(IoError::Exists(_))) => true,
            _ => false,
        }
    }
}
