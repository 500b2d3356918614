//! Writing: episodes go to the journal and to the encoder; blocks, row groups and files are cut at fixed counts.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::datatypes::SchemaRef;
use parquet::file::metadata::KeyValue;

use super::columns::{Block, batch_rows, row_bytes, schema};
use super::encoder::{Encoder, file_digest_entry};
use super::journal::{Journal, journal_name, refused};
use super::{MANIFEST_FILE, MANIFEST_KEY, PART_KEY, is_single};
use crate::io::{self, IoError};
use crate::schema::{Episode, Layout, Manifest, Part};
use crate::storage::{EpisodeSink, StorageError, Tally, lock, publish, start_partial};

/// Rows of a row group at most, unless one episode is longer.
const GROUP_ROWS: usize = 1 << 17;
/// Bytes of a row group's rows in memory at most, unless one episode is larger: until it ends it is kept, encoded.
const GROUP_BYTES: u64 = 128 << 20;
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
    rows: Rows,
    journal: Option<Journal>,
    part: Tally,
    part_bytes: u64,
    part_start: u64,
    parts: Vec<Part>,
    total: Tally,
    /// Held until the store has its name.
    _lock: File,
    finished: bool,
}

/// Rows on their way into the file.
struct Rows {
    schema: SchemaRef,
    block: Block,
    /// Rows of the row group, those of the block included.
    group: usize,
    /// Rows of a block at least, and of a row group at most; what they take in memory is bounded.
    cuts: [usize; 2],
    encoder: Encoder,
}

/// Rows that are encoded at once, and rows of a row group.
fn cuts(layout: &Layout) -> [usize; 2] {
    [batch_rows(layout), GROUP_ROWS.min((GROUP_BYTES / row_bytes(layout)) as usize)]
}

impl Rows {
    /// Adds whole episodes.
    fn push(&mut self, layout: &Layout, episodes: &[Episode]) -> Result<(), StorageError> {
        let [block_rows, group_rows] = self.cuts;
        for episode in episodes {
            let rows = episode.rows();
            if self.group > 0 && self.group + rows > group_rows {
                self.end_block(layout)?;
                self.encoder.end_group()?;
                self.group = 0;
            }
            self.block.push(layout, episode);
            self.group += rows;
            if self.block.rows >= block_rows {
                self.end_block(layout)?;
            }
        }
        Ok(())
    }

    /// Encodes what there is.
    fn end_block(&mut self, layout: &Layout) -> Result<(), StorageError> {
        if self.block.rows == 0 {
            return Ok(());
        }
        let next = Block::new(layout, self.block.rows + self.block.rows / 64);
        let block = std::mem::replace(&mut self.block, next);
        let batch = block.into_batch(&self.schema).map_err(|e| refused(e, &self.encoder.directory))?;
        self.encoder.write(&batch)
    }

    /// Ends the file.
    fn end_file(
        &mut self,
        layout: &Layout,
        metadata: Vec<KeyValue>,
        journal: Option<PathBuf>,
    ) -> Result<(), StorageError> {
        self.end_block(layout)?;
        self.group = 0;
        self.encoder.end_file(metadata, journal)
    }
}

impl ParquetSink {
    /// Starts a store at `path`: one file when its extension says so, else a directory of parts.
    pub(super) fn create(path: &Path, manifest: &Manifest, force: bool) -> Result<Self, StorageError> {
        let single = is_single(path);
        let layout = manifest.layout();
        layout.check().map_err(|source| StorageError::Schema { source, path: path.to_owned() })?;
        let partial = start_partial(path, force)?;
        std::fs::create_dir(&partial).map_err(IoError::os("create the directory", &partial))?;
        let lock = lock::hold_directory(&partial)?;
        let schema = schema(&layout);
        let encoder = Encoder::start(SchemaRef::clone(&schema), &partial, part_name)?;
        let (block, cuts) = (Block::new(&layout, 0), cuts(&layout));
        let rows = Rows { schema: SchemaRef::clone(&schema), block, group: 0, cuts, encoder };
        let mut sink = Self {
            path: path.to_owned(),
            partial,
            force,
            single,
            manifest: manifest.clone(),
            layout,
            schema,
            rows,
            journal: None,
            part: Tally::default(),
            part_bytes: 0,
            part_start: 0,
            parts: Vec::new(),
            total: Tally::default(),
            _lock: lock,
            finished: false,
        };
        sink.start_journal()?;
        Ok(sink)
    }

    /// Starts the journal of the next part; its manifest holds the content digests of the parts before.
    fn start_journal(&mut self) -> Result<(), StorageError> {
        let manifest = self.sealed(&Manifest { parts: self.parts.clone(), ..self.manifest.clone() })?;
        self.journal = Some(Journal::create(&self.partial, self.parts.len(), &self.schema, manifest)?);
        Ok(())
    }

    /// How many of these episodes the open part still takes.
    fn room(&self, episodes: &[Episode]) -> usize {
        if self.single {
            return episodes.len();
        }
        let (mut count, mut bytes, row) = (self.part.episodes, self.part_bytes, row_bytes(&self.layout));
        let fits = |episode: &&Episode| {
            let more = bytes + episode.rows() as u64 * row;
            let fits = count == 0 || (count < PART_EPISODES && more <= PART_BYTES);
            (count, bytes) = (count + 1, more);
            fits
        };
        episodes.iter().take_while(fits).count()
    }

    /// Ends the file that is being written. Its journal goes when it is sealed; before that the next one has its digest.
    /// The last journal of a directory goes when the manifest is there.
    fn end_part(&mut self, metadata: Vec<KeyValue>, last: bool) -> Result<(), StorageError> {
        self.commit()?;
        let journal = self.journal.take().map(|journal| journal.path);
        let part = std::mem::take(&mut self.part);
        let end = self.part_start + part.episodes;
        let content = part.content();
        let file = part_name(self.parts.len());
        self.parts.push(Part { file, episodes: [self.part_start, end], bytes: 0, sha256: String::new(), content });
        (self.part_start, self.part_bytes) = (end, 0);
        if !last {
            self.start_journal()?;
        }
        self.rows.end_file(&self.layout, metadata, journal.filter(|_| !last || self.single))
    }

    /// Metadata of a part: where it comes from, whoever wrote it.
    fn part_metadata(&self) -> Result<Vec<KeyValue>, StorageError> {
        let manifest = Manifest { parts: Vec::new(), task: String::new(), ..self.manifest.clone() };
        Ok(vec![KeyValue::new(PART_KEY.to_owned(), self.sealed(&manifest)?)])
    }

    fn sealed(&self, manifest: &Manifest) -> Result<String, StorageError> {
        manifest.sealed_json().map_err(|source| StorageError::Schema { source, path: self.path.clone() })
    }
}

impl EpisodeSink for ParquetSink {
    fn append(&mut self, episode: &Episode) -> Result<(), StorageError> {
        self.append_all(std::slice::from_ref(episode))
    }

    fn append_all(&mut self, episodes: &[Episode]) -> Result<(), StorageError> {
        let schema = |source| StorageError::Schema { source, path: self.path.clone() };
        let hashes = self.total.check_all(&self.layout, episodes).map_err(schema)?;
        let (mut episodes, mut hashes) = (episodes, &hashes[..]);
        loop {
            let (now, later) = episodes.split_at(self.room(episodes));
            let (rows, journal, layout) = (&mut self.rows, &mut self.journal, &self.layout);
            // the journal takes a copy and a system call, the columns processor time
            let journal = || journal.as_mut().map_or(Ok(()), |journal| journal.write(layout, now, hashes));
            let (journaled, encoded) = rayon::join(journal, || rows.push(layout, now));
            journaled.and(encoded)?;
            for (episode, hash) in now.iter().zip(hashes) {
                self.part.add(episode, hash);
                self.total.add(episode, hash);
                self.part_bytes += episode.rows() as u64 * row_bytes(&self.layout);
            }
            if later.is_empty() {
                return Ok(());
            }
            (episodes, hashes) = (later, &hashes[now.len()..]);
            let metadata = self.part_metadata()?;
            self.end_part(metadata, false)?;
        }
    }

    fn commit(&mut self) -> Result<u64, StorageError> {
        if let Some(journal) = &mut self.journal {
            journal.flush()?;
        }
        Ok(self.total.episodes)
    }

    fn finish(mut self: Box<Self>) -> Result<Manifest, StorageError> {
        self.total.seal(&mut self.manifest, &self.path)?;
        let path = self.path.clone();
        let schema = |source| StorageError::Schema { source, path: path.clone() };
        if self.single {
            let text = self.manifest.sealed_json().map_err(schema)?;
            self.end_part(vec![KeyValue::new(MANIFEST_KEY.to_owned(), text.clone()), file_digest_entry()], true)?;
            self.rows.encoder.join()?;
            let file = self.partial.join(part_name(0));
            publish(&file, &self.path, self.force)?;
            self.finished = true;
            std::fs::remove_dir_all(&self.partial).map_err(IoError::os("remove", &self.partial))?;
            return Manifest::parse(&text).map_err(schema);
        }
        let metadata = self.part_metadata()?;
        self.end_part(metadata, true)?;
        let mut parts = std::mem::take(&mut self.parts);
        for (part, sealed) in parts.iter_mut().zip(self.rows.encoder.join()?) {
            (part.bytes, part.sha256) = (sealed.bytes, sealed.sha256);
        }
        self.manifest.parts = parts;
        let text = self.manifest.sealed_json().map_err(schema)?;
        io::write_atomic(&self.partial.join(MANIFEST_FILE), text.as_bytes())?;
        io::remove(&self.partial.join(journal_name(self.manifest.parts.len() - 1)))?;
        io::sync_dir(&self.partial)?;
        publish(&self.partial, &self.path, self.force)?;
        self.finished = true;
        lock::release(&self.path)?; // only now: nobody takes the partial for what a kill left
        Manifest::parse(&text).map_err(schema)
    }
}

impl Drop for ParquetSink {
    /// An unfinished store keeps its journal for recovery, unless it holds nothing.
    fn drop(&mut self) {
        if !self.finished {
            self.commit().ok();
            self.rows.encoder.join().ok();
            if self.total.episodes == 0 {
                std::fs::remove_dir_all(&self.partial).ok();
            }
        }
    }
}

pub(super) fn part_name(index: usize) -> String {
    format!("part-{index:05}.parquet")
}
