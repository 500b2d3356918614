//! The journal of a part: an Arrow IPC stream of the episodes appended so far, which survives a kill.
//!
//! Beside the store's columns it has one of its own: on each episode's last row the content hash, which `recover` compares.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{BinaryArray, RecordBatch};
use arrow::datatypes::{DataType, Field, Metadata, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc::writer::StreamWriter;

use super::MANIFEST_KEY;
use super::columns::Block;
use crate::io::IoError;
use crate::schema::{Episode, Layout};
use crate::storage::StorageError;

/// The journal's own column: the content hash on the last row of an episode, null on the others.
pub(super) const HASH_COLUMN: &str = "content_hash";

/// A journal that is being written.
pub(super) struct Journal {
    /// Where it is.
    pub(super) path: PathBuf,
    /// Of the store's columns.
    schema: SchemaRef,
    /// With the hashes.
    own: SchemaRef,
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
        let hashes = Arc::new(Field::new(HASH_COLUMN, DataType::Binary, true));
        let fields: Vec<_> = schema.fields().iter().cloned().chain([hashes]).collect();
        let entries = Metadata::from([(MANIFEST_KEY, manifest)]);
        let own = Arc::new(Schema::new_with_metadata(fields, entries));
        let writer = StreamWriter::try_new(BufWriter::with_capacity(1 << 18, file), &own);
        let writer = writer.map_err(|e| refused(e, &path))?;
        let mut journal = Self { path, schema: SchemaRef::clone(schema), own, writer };
        journal.flush()?; // its manifest has the digest of the part before, whose journal goes
        Ok(journal)
    }

    /// Appends episodes, with their content hashes, as one batch; they are safe after the next [`Journal::flush`].
    pub(super) fn write(
        &mut self,
        layout: &Layout,
        episodes: &[Episode],
        hashes: &[[u8; 32]],
    ) -> Result<(), StorageError> {
        if episodes.is_empty() {
            return Ok(()); // a batch of no rows has no lists
        }
        let mut block = Block::new(layout, episodes.iter().map(Episode::rows).sum());
        for episode in episodes {
            block.push(layout, episode);
        }
        let written = block.into_batch(&self.schema).and_then(|batch| {
            let hashes: BinaryArray = episodes
                .iter()
                .zip(hashes)
                .flat_map(|(episode, hash)| std::iter::repeat_n(None, episode.steps).chain([Some(&hash[..])]))
                .collect();
            let mut columns = batch.columns().to_vec();
            columns.push(Arc::new(hashes));
            self.writer.write(&RecordBatch::try_new(SchemaRef::clone(&self.own), columns)?)
        });
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
