//! What a kill leaves of a directory or file: sealed parts, and the journal of the one that was being written.

use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

use arrow::ipc::reader::StreamReader;
use arrow::ipc::root_as_message;

use super::decoder::{Decoder, guard};
use super::journal::journal_name;
use super::sink::part_name;
use super::{MANIFEST_FILE, MANIFEST_KEY, PART_KEY, entry, footer};
use crate::io::{self, IoError};
use crate::schema::{Episode, Layout, Manifest};
use crate::storage::{EpisodeSource, MANIFEST_LIMIT, StorageError, Tally};

/// An unfinished store: its whole episodes in order, then an error that says what is wrong.
pub(super) struct Leftover {
    directory: PathBuf,
    manifest: Manifest,
    layout: Layout,
    next_part: usize,
    current: Option<(Decoder, PathBuf)>,
    total: Tally,
}

impl Leftover {
    pub(super) fn open(directory: &Path) -> Result<Self, StorageError> {
        let text = manifest_text(directory)?.ok_or_else(|| {
            let message = "no part and no journal that can be read: nothing was committed; record again".to_owned();
            StorageError::NotAStore { message, path: directory.to_owned() }
        })?;
        let schema = |source| StorageError::Schema { source, path: directory.to_owned() };
        let manifest = Manifest::parse(&text).map_err(schema)?.unsealed();
        let layout = manifest.layout();
        let (directory, total) = (directory.to_owned(), Tally::default());
        Ok(Self { directory, manifest, layout, next_part: 0, current: None, total })
    }

    /// The next part, or its journal where it was not sealed; false when there is neither.
    fn open_next(&mut self) -> Result<bool, StorageError> {
        let k = self.next_part;
        self.next_part += 1;
        let (part, journal) = (self.directory.join(part_name(k)), self.directory.join(journal_name(k)));
        let (decoder, path) = if part.is_file() {
            (Decoder::open(&part, &self.layout)?, part)
        } else if journal.is_file() {
            let batches = read_journal(&journal)?;
            (Decoder::journal(&journal, &self.layout, &batches.schema(), Box::new(batches))?, journal)
        } else {
            return Ok(false);
        };
        self.current = Some((decoder, path));
        Ok(true)
    }
}

impl EpisodeSource for Leftover {
    fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        loop {
            let Some((decoder, path)) = &mut self.current else {
                if self.open_next()? {
                    continue;
                }
                return Ok(None);
            };
            if let Some(episode) = decoder.next_episode(self.total.episodes)? {
                let hash = self.total.check(&self.layout, &episode);
                let hash = hash.map_err(|source| StorageError::Schema { source, path: path.clone() })?;
                self.total.add(&episode, &hash);
                return Ok(Some(episode));
            }
            self.current = None;
        }
    }
}

/// The manifest: that of the directory, of the first part, or of the first journal.
fn manifest_text(directory: &Path) -> Result<Option<String>, StorageError> {
    let path = directory.join(MANIFEST_FILE);
    if path.is_file() {
        return Ok(Some(io::read_text(&path, MANIFEST_LIMIT)?));
    }
    let part = directory.join(part_name(0));
    if part.is_file() {
        let metadata = footer(&part)?;
        return Ok(entry(&metadata, PART_KEY).or_else(|| entry(&metadata, MANIFEST_KEY)).map(str::to_owned));
    }
    let journal = directory.join(journal_name(0));
    if !journal.is_file() {
        return Ok(None);
    }
    Ok(read_journal(&journal)?.schema().metadata().get(MANIFEST_KEY).cloned())
}

/// The whole batches of a journal. A torn last batch ends them: it was never committed.
fn read_journal(path: &Path) -> Result<StreamReader<Messages<BufReader<File>>>, StorageError> {
    let file = File::open(path).map_err(IoError::os("open", path))?;
    let left = file.metadata().map_err(IoError::os("read", path))?.len();
    let messages = Messages { input: BufReader::with_capacity(1 << 18, file), left, whole: Cursor::default() };
    guard(path, || StreamReader::try_new(messages, None))
}

/// The messages of an Arrow IPC stream, each whole; what is torn is not read. Their sizes are compared with what the
/// file still has before memory is given to them, so that a journal cannot ask for more than it holds.
struct Messages<R> {
    input: R,
    left: u64,
    /// The message at hand.
    whole: Cursor<Vec<u8>>,
}

impl<R: Read> Messages<R> {
    fn take(&mut self, count: u64) -> Option<Vec<u8>> {
        self.left = self.left.checked_sub(count)?;
        let mut bytes = Vec::new();
        (self.input.by_ref().take(count).read_to_end(&mut bytes).ok()? as u64 == count).then_some(bytes)
    }

    /// The next message, or `None` at the end of what is whole.
    fn message(&mut self) -> Option<Vec<u8>> {
        let mut message = self.take(8)?;
        let (marker, length) = message.split_at(4);
        let length = u32::from_le_bytes(length.try_into().ok()?);
        if marker != [0xff; 4] || length == 0 {
            return None; // the end of the stream, or none of ours
        }
        let head = self.take(u64::from(length))?;
        let body = u64::try_from(root_as_message(&head).ok()?.bodyLength()).ok()?;
        message.extend(head);
        message.extend(self.take(body)?);
        Some(message)
    }
}

impl<R: Read> Read for Messages<R> {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.whole.position() == self.whole.get_ref().len() as u64 {
            self.whole = Cursor::new(self.message().unwrap_or_default());
        }
        self.whole.read(out)
    }
}
