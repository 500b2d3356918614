//! A check of anybody's Arrow IPC file or stream, before another reader takes columns from it: that it asks for no more
//! memory than its own bytes can fill. That reader believes the lengths.

use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::Path;

use arrow::ipc::{Block, RecordBatch, root_as_footer, root_as_message};

use super::StorageError;
use crate::io::IoError;

/// What stands at both ends of the file form.
const MAGIC: &[u8] = b"ARROW1";
/// Longest head of a message, and longest footer, bytes.
const HEAD_LIMIT: u64 = 64 << 20;
/// What a compressed buffer may become: this many bytes, or so many times its own length.
const BUFFER_LIMIT: u64 = 64 << 20;
const RATIO_LIMIT: u64 = 256;

/// Why it is refused: what was expected and found.
type Fault = String;

/// Checks the file form (`stream` false) or the streaming form.
pub(super) fn check(path: &Path, stream: bool) -> Result<(), StorageError> {
    let file = File::open(path).map_err(IoError::os("open", path))?;
    let size = file.metadata().map_err(IoError::os("read", path))?.len();
    let mut input = Input { file, size };
    let checked = if stream { check_stream(&mut input) } else { check_file(&mut input) };
    checked.map_err(|message| StorageError::Damaged { message, path: path.to_owned() })
}

struct Input {
    file: File,
    size: u64,
}

impl Input {
    fn at(&mut self, offset: u64, length: u64) -> Result<Vec<u8>, Fault> {
        let end = offset.checked_add(length).filter(|&end| end <= self.size);
        end.ok_or_else(|| format!("bytes {offset} and {length} more are expected, it has {}: cut short?", self.size))?;
        let mut bytes = Vec::new();
        self.file.seek(SeekFrom::Start(offset)).map_err(|e| e.to_string())?;
        (&self.file).take(length).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        if bytes.len() as u64 == length { Ok(bytes) } else { Err("it became shorter while it was read".to_owned()) }
    }

    fn head(&mut self, offset: u64, length: u64) -> Result<Vec<u8>, Fault> {
        if length > HEAD_LIMIT {
            return Err(format!("a head of {length} bytes at byte {offset}, expected at most {HEAD_LIMIT}"));
        }
        self.at(offset, length)
    }

    /// Length of the prefix and of the head of the message at `offset`; a head of 0 bytes ends a stream.
    fn lengths(&mut self, offset: u64) -> Result<(u64, u64), Fault> {
        let first = number(&self.at(offset, 4)?);
        if first == u64::from(u32::MAX) { Ok((8, number(&self.at(offset + 4, 4)?))) } else { Ok((4, first)) }
    }

    /// Checks the message at `offset`, whose body begins at `body` and has `length` bytes, if those are known; returns
    /// where it ends, or nothing at the end of a stream.
    fn message(&mut self, offset: u64, block: Option<&Block>) -> Result<Option<u64>, Fault> {
        let (prefix, length) = self.lengths(offset)?;
        if length == 0 {
            return if block.is_none() { Ok(None) } else { Err(format!("no message at byte {offset}")) };
        }
        let head = self.head(offset + prefix, length)?;
        let message = root_as_message(&head).map_err(|_e| format!("no message at byte {offset}"))?;
        let found = unsigned(message.bodyLength())?;
        let (body, length) = match block {
            None => (offset + prefix + length, found),
            Some(block) => (offset + unsigned(i64::from(block.metaDataLength()))?, unsigned(block.bodyLength())?),
        };
        let end = body.checked_add(length).filter(|&end| end <= self.size && found <= length);
        let end = end.ok_or_else(|| format!("the message at byte {offset} has no whole body: cut short?"))?;
        let batch = message.header_as_record_batch();
        let batch = batch.or_else(|| message.header_as_dictionary_batch().and_then(|dictionary| dictionary.data()));
        if let Some(batch) = batch {
            self.buffers(&batch, body, length)?;
        }
        Ok(Some(end))
    }

    fn buffers(&mut self, batch: &RecordBatch<'_>, body: u64, length: u64) -> Result<(), Fault> {
        for buffer in batch.buffers().into_iter().flatten() {
            let (offset, bytes) = (unsigned(buffer.offset())?, unsigned(buffer.length())?);
            if offset.checked_add(bytes).is_none_or(|end| end > length) {
                return Err(format!("a buffer at byte {body} reaches beyond its message"));
            }
            if batch.compression().is_none() || bytes == 0 {
                continue;
            }
            let Ok(plain) = <[u8; 8]>::try_from(self.at(body + offset, 8)?) else { continue };
            let plain = i64::from_le_bytes(plain); // −1: not compressed after all
            if bytes < 8 || plain < -1 || plain > (BUFFER_LIMIT.max(RATIO_LIMIT * bytes)) as i64 {
                return Err(format!("a buffer of {bytes} bytes at byte {} claims {plain}", body + offset));
            }
        }
        Ok(())
    }
}

fn check_stream(input: &mut Input) -> Result<(), Fault> {
    let mut at = 0;
    while at < input.size {
        match input.message(at, None)? {
            Some(end) => at = end,
            None => break,
        }
    }
    Ok(())
}

fn check_file(input: &mut Input) -> Result<(), Fault> {
    let tail = input.size.checked_sub(10).ok_or("it is too short for an Arrow file")?;
    let tail_bytes = input.at(tail, 10)?;
    if input.at(0, 6)? != MAGIC || tail_bytes[4..] != *MAGIC {
        return Err("it does not begin and end as an Arrow file (Feather 1 is another form): cut short?".to_owned());
    }
    let length = number(&tail_bytes[..4]);
    let start = tail.checked_sub(length).ok_or_else(|| format!("a footer of {length} bytes"))?;
    let footer = input.head(start, length)?;
    let footer = root_as_footer(&footer).map_err(|_e| "its footer is none".to_owned())?;
    for block in footer.dictionaries().into_iter().chain(footer.recordBatches()).flatten() {
        input.message(unsigned(block.offset())?, Some(block))?;
    }
    Ok(())
}

fn unsigned(length: i64) -> Result<u64, Fault> {
    u64::try_from(length).map_err(|_e| format!("a length of {length}"))
}

/// Four bytes as a number.
fn number(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte))
}
