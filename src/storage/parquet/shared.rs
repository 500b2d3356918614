//! One file, read at many places at once: every column has a place of its own in it.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::sync::Arc;

use bytes::Bytes;
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::reader::{ChunkReader, Length};

/// A file that many columns read at once, each at its own place.
#[derive(Clone, Debug)]
pub(super) struct Shared(Arc<File>);

/// A place in such a file.
pub(super) struct At(Shared, u64);

impl Shared {
    pub(super) fn new(file: File) -> Self {
        Self(Arc::new(file))
    }

    fn read_at(&self, out: &mut [u8], place: u64) -> io::Result<usize> {
        #[cfg(unix)]
        return std::os::unix::fs::FileExt::read_at(&*self.0, out, place);
        #[cfg(windows)]
        return std::os::windows::fs::FileExt::seek_read(&*self.0, out, place);
    }

    fn reader(&self, start: u64) -> At {
        At(self.clone(), start)
    }

    /// Whether two ranges of a length hold the same bytes.
    pub(super) fn same(&self, a: u64, b: u64, length: u64) -> io::Result<bool> {
        let (mut a, mut b) = (self.reader(a), self.reader(b));
        let (mut left, mut blocks) = (length, (vec![0; 1 << 16], vec![0; 1 << 16]));
        while left > 0 {
            let n = left.min(1 << 16) as usize;
            let (x, y) = (&mut blocks.0[..n], &mut blocks.1[..n]);
            a.read_exact(x)?;
            b.read_exact(y)?;
            if x != y {
                return Ok(false);
            }
            left -= n as u64;
        }
        Ok(true)
    }
}

impl Read for At {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let n = self.0.read_at(out, self.1)?;
        self.1 += n as u64;
        Ok(n)
    }
}

impl Length for Shared {
    fn len(&self) -> u64 {
        self.0.metadata().map_or(0, |m| m.len())
    }
}

impl ChunkReader for Shared {
    type T = BufReader<At>;

    fn get_read(&self, start: u64) -> ParquetResult<Self::T> {
        Ok(BufReader::with_capacity(256, self.reader(start)))
    }

    fn get_bytes(&self, start: u64, length: usize) -> ParquetResult<Bytes> {
        if start.checked_add(length as u64).is_none_or(|end| end > self.len()) {
            return Err(ParquetError::EOF(format!("{length} bytes at {start} lie beyond the end of the file")));
        }
        let mut bytes = vec![0; length];
        self.reader(start).read_exact(&mut bytes)?;
        Ok(bytes.into())
    }
}
