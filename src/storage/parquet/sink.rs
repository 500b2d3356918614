//! Writing: blocks of episodes go to the journal and to the encoder; files are cut at fixed counts.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use arrow::array::RecordBatch;
use arrow::datatypes::{Metadata, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc::writer::StreamWriter;
use parquet::file::metadata::KeyValue;

use super::columns::{Block, row_bytes, schema};
use super::encoder::{Encoder, Job, file_digest_entry};
use super::{MANIFEST_FILE, MANIFEST_KEY, PART_KEY, is_single};
use crate::io::{self, IoError};
use crate::schema::{Episode, Layout, Manifest, Part};
use crate::storage::{EpisodeSink, StorageError, Tally, start_partial};

/// Rows of a block: what goes to the journal and to the encoder at once.
const BLOCK_ROWS: usize = 8192;
/// Rows of a row group at most, unless one episode is longer.
const GROUP_ROWS: usize = 1 << 17;
/// Episodes of a part at most.
const PART_EPISODES: u64 = 4000;
/// Bytes of a part's rows in memory at most, unless one episode is larger.
const PART_BYTES: u64 = 128 << 20;

/// A store under construction. Where blocks, groups and files are cut depends on the episodes alone, so that the same
/// episodes give the same bytes whenever the caller commits.
pub(super) struct ParquetSink {
    path: PathBuf,
    /// The directory `.<name>.partial` in which it is built.
    partial: PathBuf,
    force: bool,
    single: bool,
    manifest: Manifest,
    layout: Layout,
    schema: SchemaRef,
    block: Block,
    /// Rows of the block that the journal already holds.
    journaled: usize,
    journal: Option<StreamWriter<BufWriter<File>>>,
    group_rows: usize,
    part: Tally,
    part_bytes: u64,
    part_start: u64,
    parts: Vec<Part>,
    total: Tally,
    encoder: Encoder,
    finished: bool,
}

impl ParquetSink {
    /// Starts a store at `path`: one file when its extension says so, else a directory of parts.
    pub(super) fn create(path: &Path, manifest: &Manifest, force: bool) -> Result<Self, StorageError> {
        let single = is_single(path);
        let layout = manifest.layout();
        layout.check().map_err(|source| StorageError::Schema { source, path: path.to_owned() })?;
        let partial = start_partial(path, force)?;
        std::fs::create_dir(&partial).map_err(IoError::os("create the directory", &partial))?;
        let schema = schema(&layout);
        let directory = partial.clone();
        let encoder = Encoder::start(SchemaRef::clone(&schema), move |k| directory.join(part_name(k)));
        let mut sink = Self {
            path: path.to_owned(),
            partial,
            force,
            single,
            manifest: manifest.clone(),
            schema,
            block: Block::new(&layout, 0),
            layout,
            journaled: 0,
            journal: None,
            group_rows: 0,
            part: Tally::default(),
            part_bytes: 0,
            part_start: 0,
            parts: Vec::new(),
            total: Tally::default(),
            encoder,
            finished: false,
        };
        sink.start_journal()?;
        Ok(sink)
    }

    fn journal_path(&self) -> PathBuf {
        self.partial.join(format!("journal-{:05}.arrows", self.parts.len()))
    }

    /// The journal of the next part. Its Arrow schema carries the unsealed manifest, so that it can be read alone.
    fn start_journal(&mut self) -> Result<(), StorageError> {
        let path = self.journal_path();
        let file = File::create_new(&path).map_err(IoError::os("create", &path))?;
        let fields = self.schema.fields().clone();
        let entries = Metadata::from([(MANIFEST_KEY, self.unsealed()?)]);
        let schema = Schema::new_with_metadata(fields, entries);
        let writer = StreamWriter::try_new(BufWriter::with_capacity(1 << 18, file), &schema);
        self.journal = Some(writer.map_err(|e| refused(e, &path))?);
        Ok(())
    }

    fn unsealed(&self) -> Result<String, StorageError> {
        let unsealed = Manifest { parts: Vec::new(), ..self.manifest.clone() };
        unsealed.sealed_json().map_err(|source| StorageError::Schema { source, path: self.path.clone() })
    }

    fn write_journal(&mut self, batch: &RecordBatch, flush: bool) -> Result<(), StorageError> {
        let path = self.journal_path();
        if let Some(journal) = &mut self.journal {
            journal.write(batch).map_err(|e| refused(e, &path))?;
            if flush {
                journal.flush().map_err(|e| refused(e, &path))?;
            }
        }
        Ok(())
    }

    /// Sends the block to the journal (what it does not hold yet) and to the encoder.
    fn flush_block(&mut self) -> Result<(), StorageError> {
        if self.block.rows == 0 {
            return Ok(());
        }
        let next = Block::new(&self.layout, self.block.rows + self.block.rows / 64);
        let block = std::mem::replace(&mut self.block, next);
        let from = std::mem::take(&mut self.journaled);
        let tail = (from > 0 && from < block.rows).then(|| block.tail(from));
        let whole = from == 0;
        let batch = block.into_batch(&self.schema).map_err(|e| refused(e, &self.path))?;
        if let Some(tail) = tail {
            let tail = tail.into_batch(&self.schema).map_err(|e| refused(e, &self.path))?;
            self.write_journal(&tail, false)?;
        } else if whole {
            self.write_journal(&batch, false)?;
        }
        self.encoder.send(Job::Rows(batch))
    }

    /// Ends the file that is being written.
    fn end_part(&mut self, metadata: Vec<KeyValue>) -> Result<(), StorageError> {
        self.flush_block()?;
        self.commit()?;
        let journal = self.journal_path();
        self.journal = None;
        self.encoder.send(Job::EndFile(metadata, vec![journal]))?;
        let part = std::mem::take(&mut self.part);
        let end = self.part_start + part.episodes;
        let content = part.content();
        let file = part_name(self.parts.len());
        self.parts.push(Part { file, episodes: [self.part_start, end], bytes: 0, sha256: String::new(), content });
        (self.part_start, self.part_bytes, self.group_rows) = (end, 0, 0);
        Ok(())
    }

    /// Metadata of a part: where it comes from.
    fn part_metadata(&self) -> Result<Vec<KeyValue>, StorageError> {
        Ok(vec![KeyValue::new(PART_KEY.to_owned(), self.unsealed()?)])
    }
}

impl EpisodeSink for ParquetSink {
    fn append(&mut self, episode: &Episode) -> Result<(), StorageError> {
        let hash = self
            .total
            .check(&self.layout, episode)
            .map_err(|source| StorageError::Schema { source, path: self.path.clone() })?;
        let rows = episode.rows();
        let bytes = rows as u64 * row_bytes(&self.layout);
        let full = self.part.episodes >= PART_EPISODES || self.part_bytes + bytes > PART_BYTES;
        if !self.single && self.part.episodes > 0 && full {
            let metadata = self.part_metadata()?;
            self.end_part(metadata)?;
            self.start_journal()?;
        }
        if self.group_rows > 0 && self.group_rows + rows > GROUP_ROWS {
            self.flush_block()?;
            self.encoder.send(Job::EndGroup)?;
            self.group_rows = 0;
        }
        self.block.push(&self.layout, episode);
        self.group_rows += rows;
        self.part_bytes += bytes;
        self.part.add(episode, &hash);
        self.total.add(episode, &hash);
        if self.block.rows >= BLOCK_ROWS { self.flush_block() } else { Ok(()) }
    }

    fn commit(&mut self) -> Result<u64, StorageError> {
        if self.journaled < self.block.rows {
            let tail = self.block.tail(self.journaled);
            self.journaled = self.block.rows;
            let batch = tail.into_batch(&self.schema).map_err(|e| refused(e, &self.path))?;
            self.write_journal(&batch, false)?;
        }
        let path = self.journal_path();
        if let Some(journal) = &mut self.journal {
            journal.flush().map_err(|e| refused(e, &path))?;
        }
        Ok(self.total.episodes)
    }

    fn finish(mut self: Box<Self>) -> Result<Manifest, StorageError> {
        self.total.seal(&mut self.manifest, &self.path)?;
        let path = self.path.clone();
        let schema = |source| StorageError::Schema { source, path: path.clone() };
        if self.single {
            let text = self.manifest.sealed_json().map_err(schema)?;
            self.end_part(vec![KeyValue::new(MANIFEST_KEY.to_owned(), text.clone()), file_digest_entry()])?;
            self.encoder.join()?;
            let file = self.partial.join(part_name(0));
            io::publish(&file, &self.path, self.force, MANIFEST_FILE)?;
            self.finished = true;
            std::fs::remove_dir_all(&self.partial).map_err(IoError::os("remove", &self.partial))?;
            return Manifest::parse(&text).map_err(schema);
        }
        let metadata = self.part_metadata()?;
        self.end_part(metadata)?;
        let mut parts = std::mem::take(&mut self.parts);
        for (part, sealed) in parts.iter_mut().zip(self.encoder.join()?) {
            (part.bytes, part.sha256) = (sealed.bytes, sealed.sha256);
        }
        self.manifest.parts = parts;
        let text = self.manifest.sealed_json().map_err(schema)?;
        io::write_atomic(&self.partial.join(MANIFEST_FILE), text.as_bytes())?;
        io::sync_dir(&self.partial)?;
        io::publish(&self.partial, &self.path, self.force, MANIFEST_FILE)?;
        self.finished = true;
        Manifest::parse(&text).map_err(schema)
    }
}

impl Drop for ParquetSink {
    /// An unfinished store keeps its journal for recovery, unless it holds nothing.
    fn drop(&mut self) {
        if !self.finished {
            let stopped = if self.total.episodes > 0 { self.commit().map(drop) } else { Ok(()) };
            let stopped = stopped.and(self.encoder.join().map(drop));
            if self.total.episodes == 0 || stopped.is_err() && !self.partial.exists() {
                std::fs::remove_dir_all(&self.partial).ok();
            }
        }
    }
}

fn part_name(index: usize) -> String {
    format!("part-{index:05}.parquet")
}

fn refused(error: ArrowError, path: &Path) -> StorageError {
    let source = match error {
        ArrowError::IoError(_, source) => source,
        other => std::io::Error::other(other.to_string()),
    };
    IoError::os("write", path)(source).into()
}
