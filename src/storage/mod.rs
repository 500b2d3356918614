//! Stores: recorded episodes on disk. One schema, several containers, lossless between them.
//!
//! Adding a format: write `storage/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

use std::path::{Path, PathBuf};

use crate::io::IoError;
use crate::registry::Entry;
use crate::schema::{Episode, Manifest, SchemaError};

/// All formats, in the order in which a path is offered to them.
pub const FORMATS: &[Entry<Format>] = &[];

/// How a format is recognised, written and read.
#[derive(Clone, Copy, Debug)]
pub struct Format {
    /// Whether an output path asks for this format (by its extension).
    pub claims: fn(&Path) -> bool,
    /// Starts a store; nothing appears under `path` before [`EpisodeSink::finish`].
    pub create: fn(&Path, &Manifest, bool) -> Result<Box<dyn EpisodeSink>, StorageError>,
    /// Opens a store for reading; checks its manifest and digests.
    pub open: fn(&Path) -> Result<Box<dyn EpisodeSource>, StorageError>,
}

/// Takes episodes in index order and seals them into a store.
pub trait EpisodeSink {
    /// Appends the next episode; once this returns, the episode survives the death of the process.
    ///
    /// # Errors
    /// [`StorageError`] when the episode breaks the schema or the disk refuses.
    fn append(&mut self, episode: &Episode) -> Result<(), StorageError>;

    /// Seals the store under its name and returns the final manifest.
    ///
    /// # Errors
    /// [`StorageError`] when the disk refuses.
    fn finish(self: Box<Self>) -> Result<Manifest, StorageError>;
}

/// Reads episodes in index order, holding a bounded number in memory.
pub trait EpisodeSource: Send {
    /// The store's manifest.
    fn manifest(&self) -> &Manifest;

    /// The next episode, or `None` at the end. Each is checked against the layout.
    ///
    /// # Errors
    /// [`StorageError`] when data is damaged, missing or against the schema.
    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError>;
}

/// What goes wrong with a store. The path comes last.
#[derive(Debug, thiserror::Error)]
pub enum StorageError {
    /// The file system.
    #[error(transparent)]
    Io(#[from] IoError),
    /// The data breaks the schema.
    #[error("{source}: {}", path.display())]
    Schema {
        /// Which rule.
        source: SchemaError,
        /// Where.
        path: PathBuf,
    },
    /// Not a store, or not one that can be read.
    #[error("not a rollout store: {message}: {}", path.display())]
    NotAStore {
        /// What was expected and found, and what to do.
        message: String,
        /// Where.
        path: PathBuf,
    },
    /// A digest or a structure does not match.
    #[error("damaged: {message}: {}", path.display())]
    Damaged {
        /// What was expected and found, and what to do.
        message: String,
        /// Where.
        path: PathBuf,
    },
}

/// Starts a store at `path`; its extension chooses the format (`.mcap`, `.parquet`, anything else a directory of
/// Parquet parts).
///
/// # Errors
/// [`IoError::Exists`] without `force`; [`StorageError`] when the disk refuses.
pub fn create(path: &Path, manifest: &Manifest, force: bool) -> Result<Box<dyn EpisodeSink>, StorageError> {
    crate::io::refuse_existing(path, force)?;
    (format_of(path).build.create)(path, manifest, force)
}

/// Opens the store at `path`.
///
/// # Errors
/// [`StorageError`] when it is missing, not a store, of a newer version, or damaged.
pub fn open(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    (format_of(path).build.open)(path)
}

/// The first format that claims the path; Parquet when none does.
fn format_of(path: &Path) -> &'static Entry<Format> {
    FORMATS.iter().find(|e| (e.build.claims)(path)).unwrap_or(&FORMATS[FORMATS.len() - 1])
}
