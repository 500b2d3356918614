//! Reading a journal: its whole batches, the content hash of each episode, and what stands behind the last batch.
//!
//! A kill tears the end off: that ends the journal, and what was torn had not been committed. Anything else that is no
//! message is damage, and so is a torn message with whole ones behind it.

use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};

use arrow::array::{Array as _, BinaryArray, RecordBatch};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::root_as_message;

use super::decoder::guard;
use super::journal::HASH_COLUMN;
use crate::io::IoError;
use crate::storage::StorageError;

/// What a journal says beside its rows, in the order of the rows.
#[derive(Clone, Debug)]
pub(super) enum Note {
    /// The content hash of the next episode.
    Hash(Vec<u8>),
    /// The last message is torn.
    Torn,
    /// Something is no message, and no end that a kill leaves.
    Fault(String),
}

/// The whole batches of a journal.
pub(super) struct JournalReader {
    stream: StreamReader<Messages>,
    hashes: usize,
    notes: Sender<Note>,
}

impl JournalReader {
    /// Opens a journal; `None` when not even its first message is whole, so that nothing was committed.
    pub(super) fn open(path: &Path) -> Result<Option<(Self, Receiver<Note>)>, StorageError> {
        let damaged = |message: String| StorageError::Damaged { message, path: path.to_owned() };
        let file = File::open(path).map_err(IoError::os("open", path))?;
        let size = file.metadata().map_err(IoError::os("read", path))?.len();
        let input = BufReader::with_capacity(1 << 18, file);
        let mut messages = Messages { input, size, left: size, whole: Cursor::default(), end: None };
        match messages.message().map_err(IoError::os("read", path))? {
            Some(first) => messages.whole = Cursor::new(first),
            None => {
                return match messages.end {
                    Some(Note::Fault(message)) => Err(damaged(message)),
                    _ => Ok(None),
                };
            }
        }
        let stream = guard(path, || StreamReader::try_new(messages, None))?;
        match stream.schema().column_with_name(HASH_COLUMN) {
            Some((hashes, field)) if *field.data_type() == DataType::Binary => {
                let (notes, told) = channel();
                Ok(Some((Self { stream, hashes, notes }, told)))
            }
            _ => Err(damaged(format!("it has no column {HASH_COLUMN}, so that nothing vouches for its episodes"))),
        }
    }

    /// Its columns, and the manifest.
    pub(super) fn schema(&self) -> SchemaRef {
        self.stream.schema()
    }
}

impl Iterator for JournalReader {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.stream.next();
        match &batch {
            Some(Ok(batch)) => {
                let hashes = batch.columns().get(self.hashes);
                let hashes = hashes.and_then(|column| column.as_any().downcast_ref::<BinaryArray>());
                for hash in hashes.into_iter().flatten().flatten() {
                    self.notes.send(Note::Hash(hash.to_vec())).ok(); // nobody listens: nobody asks
                }
            }
            Some(Err(_)) => {}
            None => {
                if let Some(end) = &self.stream.get_ref().end {
                    self.notes.send(end.clone()).ok();
                }
            }
        }
        batch
    }
}

/// The messages of an Arrow IPC stream, each whole; what is torn is not read. Their sizes are compared with what the
/// file still has before memory is given to them, so that a journal cannot ask for more than it holds.
struct Messages {
    input: BufReader<File>,
    size: u64,
    left: u64,
    /// The message at hand.
    whole: Cursor<Vec<u8>>,
    /// Why there are no more, unless the file ends with a message.
    end: Option<Note>,
}

/// Bytes before the head of a message: the marker and the head's length.
const PREFIX: u64 = 8;

/// Longest head of a message that is looked for behind a torn one: a batch of a thousand agents has a shorter one.
const FOLLOWING_HEAD: u64 = 1 << 20;

/// Bytes that are read to find a message behind a torn one, for each byte of the file: whatever begins like a message has
/// its head read, and a hostile file has such a beginning at every eighth byte.
const SEARCHED: u64 = 16;

impl Messages {
    fn take(&mut self, count: u64) -> std::io::Result<Option<Vec<u8>>> {
        if count > self.left {
            return Ok(None);
        }
        let mut bytes = Vec::new();
        self.input.by_ref().take(count).read_to_end(&mut bytes)?;
        self.left -= count;
        Ok((bytes.len() as u64 == count).then_some(bytes))
    }

    /// The next message, or `None` at the end of what is whole.
    fn message(&mut self) -> std::io::Result<Option<Vec<u8>>> {
        let begin = self.size - self.left;
        if self.left == 0 {
            return Ok(None);
        }
        let Some(mut message) = self.take(PREFIX)? else { return self.torn(begin) };
        let Some(length) = head_length(&message) else { return Ok(self.fault(begin)) };
        let Some(head) = self.take(length)? else { return self.torn(begin) };
        let body = root_as_message(&head).ok().and_then(|message| u64::try_from(message.bodyLength()).ok());
        let Some(body) = body else { return Ok(self.fault(begin)) };
        let Some(body) = self.take(body)? else { return self.torn(begin) };
        message.extend(head);
        message.extend(body);
        Ok(Some(message))
    }

    fn fault(&mut self, begin: u64) -> Option<Vec<u8>> {
        self.end = Some(Note::Fault(format!("what stands at byte {begin} of the journal is no message of it")));
        self.left = 0;
        None
    }

    /// The file ends within the message that begins at `begin`, or that message claims to be longer than it is.
    fn torn(&mut self, begin: u64) -> std::io::Result<Option<Vec<u8>>> {
        self.end = Some(if self.batch_follows()? {
            Note::Fault(format!("the message at byte {begin} of the journal is damaged: whole ones follow it"))
        } else {
            Note::Torn
        });
        self.left = 0;
        Ok(None)
    }

    /// Whether the rest of the file holds a whole message; they begin at multiples of eight bytes.
    fn batch_follows(&mut self) -> std::io::Result<bool> {
        let mut budget = SEARCHED * self.size + FOLLOWING_HEAD;
        while let Some(prefix) = self.take(PREFIX)? {
            let Some(length) = head_length(&prefix).filter(|length| *length < FOLLOWING_HEAD) else { continue };
            // no end that a kill tears looks so often like a message: that is damage
            let Some(rest) = budget.checked_sub(length) else { return Ok(true) };
            budget = rest;
            let Some(head) = self.take(length)? else { continue };
            let body = root_as_message(&head).ok().and_then(|message| u64::try_from(message.bodyLength()).ok());
            if body.is_some_and(|body| body > 0 && body <= self.left) {
                return Ok(true);
            }
            self.input.seek_relative(-(length as i64))?;
            self.left += length;
        }
        Ok(false)
    }
}

/// The length of a message's head, if a message begins with these bytes; ours does not end with an empty one.
fn head_length(prefix: &[u8]) -> Option<u64> {
    let (marker, length) = prefix.split_at_checked(4)?;
    let length = u64::from(u32::from_le_bytes(length.try_into().ok()?));
    (marker == [0xff; 4] && length > 0 && length % 8 == 0).then_some(length)
}

impl Read for Messages {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.whole.position() == self.whole.get_ref().len() as u64 {
            self.whole = Cursor::new(self.message()?.unwrap_or_default());
        }
        self.whole.read(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_begins_like_a_message_everywhere_is_read_a_few_times_only() {
        let begin = |length: u32| [[0xff; 4], length.to_le_bytes()].concat();
        // a torn message, and heads of half a mebibyte at every eighth byte: 32 GiB, if each were read
        let bytes = [begin(1 << 30), begin(1 << 19).repeat(1 << 17)].concat();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("journal");
        crate::io::write_atomic(&path, &bytes).unwrap();
        let error = JournalReader::open(&path).map(drop).unwrap_err().to_string();
        assert!(error.contains("the message at byte 0 of the journal is damaged"), "{error}");
        crate::io::write_atomic(&path, &begin(1 << 30)).unwrap();
        assert!(JournalReader::open(&path).unwrap().is_none(), "torn, and nothing else");
    }
}
