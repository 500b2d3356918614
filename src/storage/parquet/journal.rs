//! The journal of a part: an Arrow IPC stream of the episodes appended so far, which survives a kill.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use arrow::datatypes::{Metadata, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc::writer::StreamWriter;

use super::MANIFEST_KEY;
use super::columns::Block;
use crate::io::IoError;
use crate::schema::{Episode, Layout};
use crate::storage::StorageError;

/// A journal that is being written.
pub(super) struct Journal {
    /// Where it is.
    pub(super) path: PathBuf,
    schema: SchemaRef,
    writer: StreamWriter<BufWriter<File>>,
}

impl Journal {
    /// Starts the journal of part `part`. Its Arrow schema carries the unsealed manifest, so that it can be read alone.
    pub(super) fn create(
        directory: &Path,
        part: usize,
        schema: &SchemaRef,
        manifest: String,
    ) -> Result<Self, StorageError> {
        let path = directory.join(journal_name(part));
        let file = File::create_new(&path).map_err(IoError::os("create", &path))?;
        let entries = Metadata::from([(MANIFEST_KEY, manifest)]);
        let described = Schema::new_with_metadata(schema.fields().clone(), entries);
        let writer = StreamWriter::try_new(BufWriter::with_capacity(1 << 18, file), &described);
        let writer = writer.map_err(|e| refused(e, &path))?;
        Ok(Self { path, schema: SchemaRef::clone(schema), writer })
    }

    /// Appends episodes as one batch; they are safe after the next [`Journal::flush`].
    pub(super) fn write(&mut self, layout: &Layout, episodes: &[Episode]) -> Result<(), StorageError> {
        if episodes.is_empty() {
            return Ok(()); // a batch of no rows has no lists
        }
        let mut block = Block::new(layout, episodes.iter().map(Episode::rows).sum());
        for episode in episodes {
            block.push(layout, episode);
        }
        let written = block.into_batch(&self.schema).and_then(|batch| self.writer.write(&batch));
        written.map_err(|e| refused(e, &self.path))
    }

    /// Hands everything written to the operating system.
    pub(super) fn flush(&mut self) -> Result<(), StorageError> {
        self.writer.flush().map_err(|e| refused(e, &self.path))
    }
}

/// An Arrow error as one of the store; `path` is where it happened.
pub(super) fn refused(error: ArrowError, path: &Path) -> StorageError {
    let source = match error {
        ArrowError::IoError(_, source) => source,
        other => std::io::Error::other(other.to_string()),
    };
    IoError::os("write", path)(source).into()
}

/// Name of the journal of part `part`.
pub(super) fn journal_name(part: usize) -> String {
    format!("journal-{part:05}.arrows")
}
