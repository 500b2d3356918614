//! The crate's error: one enum per room, wrapped here, and the exit code each deserves.

use crate::channel::ChannelError;
use crate::io::IoError;
use crate::mi::MiError;
use crate::pairs::PairsError;
use crate::record::RecordError;
use crate::registry::RegistryError;
use crate::report::ReportError;
use crate::schema::SchemaError;
use crate::storage::StorageError;
use crate::train::TrainError;

/// Any error of the crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Files and directories.
    #[error(transparent)]
    Io(#[from] IoError),
    /// Arguments that do not go together, or that nothing can be done with.
    #[error("{0}")]
    Usage(String),
    /// A plugin's name or parameters.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// Samples from a store or a table.
    #[error(transparent)]
    Pairs(#[from] PairsError),
    /// Samples that cannot carry an estimate.
    #[error(transparent)]
    Mi(#[from] MiError),
    /// Recording.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// Data against the schema.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// A store.
    #[error(transparent)]
    Storage(#[from] StorageError),
    /// Fitting a link.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// Training and evaluation.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A report.
    #[error(transparent)]
    Report(#[from] ReportError),
}

impl Error {
    /// Lines of a file that show the fault, for below the message.
    pub fn excerpt(&self) -> Option<&str> {
        match self {
            Self::Train(TrainError::Config { excerpt, .. }) => Some(excerpt),
            _ => None,
        }
    }

    /// Whether the user's words are at fault (exit code 2), not the data or the machine (exit code 1).
    pub fn is_usage(&self) -> bool {
        let exists = |e: &IoError| matches!(e, IoError::Exists(_));
        match self {
            Self::Pairs(error) => error.is_usage(),
            Self::Registry(e) | Self::Train(TrainError::Registry(e)) | Self::Channel(ChannelError::Registry(e)) => {
                !matches!(e, RegistryError::Data(_))
            }
            Self::Usage(_)
            | Self::Mi(MiError::Words { .. } | MiError::Given)
            | Self::Record(RecordError::NoEpisodes | RecordError::LinkEnds { .. })
            | Self::Report(ReportError::NoInput)
            | Self::Train(
                TrainError::Config { .. } | TrainError::Value { .. } | TrainError::Record(RecordError::LinkEnds { .. }),
            ) => true,
            Self::Storage(error) | Self::Train(TrainError::Storage(error)) => error.is_usage(),
            Self::Io(e) | Self::Report(ReportError::Io(e)) | Self::Train(TrainError::Io(e)) => exists(e),
            _ => false,
        }
    }
}
