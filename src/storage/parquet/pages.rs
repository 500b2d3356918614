//! What the pages of a Parquet file ask for, checked before a decoder believes them: a header of twenty bytes can ask
//! for two gigabytes.

use std::fs::File;
use std::io::{BufReader, Read, Seek as _, SeekFrom};

use parquet::file::metadata::ParquetMetaData;

/// Longest page header that is read, statistics included, bytes.
const HEADER_LIMIT: u64 = 1 << 20;
/// Deepest nesting of structures in a page header.
const DEPTH_LIMIT: u32 = 8;

/// What is wrong with a page.
pub(super) enum PageFault {
    /// Its header cannot be found or read.
    Unreadable(String),
    /// It asks for more than the limit.
    Greedy(String),
}

/// Refuses a page that asks for more than `limit` bytes or values once decompressed.
pub(super) fn check_pages(file: &File, metadata: &ParquetMetaData, limit: u64) -> Result<(), PageFault> {
    use PageFault::{Greedy, Unreadable};
    let mut input = BufReader::with_capacity(1 << 12, file);
    for (group, row_group) in metadata.row_groups().iter().enumerate() {
        for column in row_group.columns() {
            let place = || format!("row group {group}, column {}", column.column_path().string());
            let first = column.dictionary_page_offset().unwrap_or_else(|| column.data_page_offset());
            let (Ok(start), Ok(length)) = (u64::try_from(first), u64::try_from(column.compressed_size())) else {
                return Err(Unreadable(format!("{}: impossible place in the file", place())));
            };
            let mut at = 0;
            while at < length {
                let Some(position) = start.checked_add(at) else { break };
                input.seek(SeekFrom::Start(position)).map_err(|e| Unreadable(e.to_string()))?;
                let mut thrift = Thrift { input: &mut input, read: 0 };
                let page = thrift.page_header();
                let page = page.ok_or_else(|| Unreadable(format!("{}: no page header at byte {at}", place())))?;
                let asked = page.uncompressed.max(page.values);
                if asked > limit {
                    let message =
                        format!("{}: a page asks for {asked} bytes or values, over the limit {limit}", place());
                    return Err(Greedy(message));
                }
                at = at.saturating_add(thrift.read).saturating_add(page.compressed);
            }
        }
    }
    Ok(())
}

/// What a page header says.
#[derive(Debug, Default, PartialEq)]
struct Page {
    uncompressed: u64,
    compressed: u64,
    values: u64,
}

/// The compact protocol of Apache Thrift, as far as a page header needs it; `None` where it breaks.
struct Thrift<R> {
    input: R,
    read: u64,
}

impl<R: Read> Thrift<R> {
    fn byte(&mut self) -> Option<u8> {
        let mut byte = [0];
        self.read += 1;
        (self.read <= HEADER_LIMIT && self.input.read_exact(&mut byte).is_ok()).then_some(byte[0])
    }

    fn varint(&mut self) -> Option<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            value |= u64::from(byte & 127) << shift;
            if byte < 128 {
                return Some(value);
            }
        }
        None
    }

    /// A number that must not be negative.
    fn size(&mut self) -> Option<u64> {
        let zigzag = self.varint()?;
        (zigzag & 1 == 0).then_some(zigzag / 2)
    }

    /// Calls `field` with the number and type of each field of a structure, until it ends.
    fn fields(&mut self, mut field: impl FnMut(&mut Self, i64, u8) -> Option<()>) -> Option<()> {
        let mut id = 0;
        loop {
            let head = self.byte()?;
            if head == 0 {
                return Some(());
            }
            id = if head >> 4 == 0 {
                let zigzag = self.varint()?;
                (zigzag >> 1) as i64 ^ -((zigzag & 1) as i64)
            } else {
                id + i64::from(head >> 4)
            };
            field(self, id, head & 15)?;
        }
    }

    fn page_header(&mut self) -> Option<Page> {
        let mut page = Page::default();
        self.fields(|thrift, id, kind| {
            match (id, kind) {
                (2, 5) => page.uncompressed = thrift.size()?,
                (3, 5) => page.compressed = thrift.size()?,
                // the headers of data pages, dictionaries and data pages of version 2 begin with the number of values
                (5 | 7 | 8, 12) => thrift.fields(|thrift, id, kind| {
                    if (id, kind) == (1, 5) {
                        page.values = thrift.size()?;
                        return Some(());
                    }
                    thrift.skip(kind, DEPTH_LIMIT)
                })?,
                _ => thrift.skip(kind, DEPTH_LIMIT)?,
            }
            Some(())
        })?;
        Some(page)
    }

    fn skip(&mut self, kind: u8, depth: u32) -> Option<()> {
        let deeper = depth.checked_sub(1)?;
        match kind {
            1 | 2 => {}
            3 => drop(self.byte()?),
            4..=6 => drop(self.varint()?),
            7 => (0..8).try_for_each(|_| self.byte().map(drop))?,
            8 => {
                let length = self.varint()?;
                (0..length).try_for_each(|_| self.byte().map(drop))?;
            }
            9 | 10 => {
                let head = self.byte()?;
                let count = if head >> 4 == 15 { self.varint()? } else { u64::from(head >> 4) };
                // an element takes a byte at least, also a truth value
                (0..count).try_for_each(|_| {
                    if head & 15 <= 2 { self.byte().map(drop) } else { self.skip(head & 15, deeper) }
                })?;
            }
            12 => self.fields(|thrift, _, kind| thrift.skip(kind, deeper))?,
            _ => return None,
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(bytes: &[u8]) -> Option<Page> {
        Thrift { input: bytes, read: 0 }.page_header()
    }

    #[test]
    fn a_page_header_is_read_field_by_field() {
        // type 0, uncompressed 300, compressed 20, data page header {values 7, encoding 0, true, statistics {binary}}
        let bytes =
            [0x15, 0, 0x15, 0xd8, 4, 0x15, 40, 0x2c, 0x15, 14, 0x15, 0, 0x11, 0x2c, 0x18, 2, b'a', b'b', 0, 0, 0];
        assert_eq!(header(&bytes), Some(Page { uncompressed: 300, compressed: 20, values: 7 }));
        for length in 0..bytes.len() {
            assert_eq!(header(&bytes[..length]), None, "cut at {length}");
        }
    }

    #[test]
    fn hostile_headers_end() {
        assert_eq!(header(&[0x15, 1]), None, "a negative size");
        assert_eq!(header(&[0x2c; 64]), None, "too deep");
        assert_eq!(header(&[0x18, 0xff, 0xff, 0xff, 0xff, 0x7f]), None, "a text without end");
        assert_eq!(header(&[0x15, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff]), None);
    }
}
