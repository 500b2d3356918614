//! What stands behind the last whole record of what a kill left: a torn one, or damage with whole ones behind it.

use std::fs::File;
use std::io::{BufReader, Read as _, Seek as _, SeekFrom};
use std::path::Path;

use mcap::MAGIC;
use mcap::sans_io::linear_reader::LinearReaderOptions;

use super::source::{Stop, scan};
use crate::io::IoError;
use crate::storage::StorageError;

/// Bytes of a record's opcode and length.
const RECORD_HEAD: u64 = 9;
/// How every chunk says how it is compressed, within its head.
const CHUNK_MARK: &[u8] = b"\x04\0\0\0zstd";

/// Refuses a file whose last whole record is not followed by what a kill leaves: nothing, a piece of one record, or the
/// closing magic. A bare head of a record counts as no piece for the reader.
pub(super) fn check_tail(path: &Path) -> Result<(), StorageError> {
    let mut end = MAGIC.len() as u64;
    let options = LinearReaderOptions::default().with_skip_end_magic(true);
    let torn = match scan(path, options, &mut |at, _, body| end = at + 9 + body.len() as u64) {
        Ok(_) => false,
        Err(Stop::Short) => true,
        Err(Stop::Error(error)) => return Err(error),
    };
    let mut file = File::open(path).map_err(IoError::os("open", path))?;
    let left = file.metadata().map_err(IoError::os("read", path))?.len().saturating_sub(end);
    file.seek(SeekFrom::Start(end)).map_err(IoError::os("read", path))?;
    // a torn chunk has its own mark
    let fits = if torn { chunks(file).map_err(IoError::os("read", path))? < 2 } else { left <= RECORD_HEAD };
    if fits {
        return Ok(());
    }
    let message = format!("what stands at byte {end} is no record of it, though others follow");
    Err(StorageError::Damaged { message, path: path.to_owned() })
}

/// Chunks that begin in the rest of a file.
fn chunks(file: File) -> std::io::Result<usize> {
    let (mut input, mut window, mut found) = (BufReader::new(file), Vec::new(), 0);
    loop {
        let old = window.len() - window.len().min(CHUNK_MARK.len() - 1);
        window.drain(..old);
        if input.by_ref().take(1 << 20).read_to_end(&mut window)? == 0 {
            return Ok(found);
        }
        found += window.windows(CHUNK_MARK.len()).filter(|bytes| *bytes == CHUNK_MARK).count();
    }
}
