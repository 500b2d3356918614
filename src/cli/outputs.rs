//! Files that commands write beside their results: what `--force` may replace of them, and pictures that say who drew them.

use std::path::Path;

use crate::Error;
use crate::io::{self, IoError};
use crate::storage;

/// What our SVG pictures end with.
const SVG_MARK: &str = "<!-- ccmarl -->\n";

/// The chunk that our PNG pictures carry behind their header: `Software`, `ccmarl`, with its length and CRC-32.
const PNG_MARK: &[u8] = b"\x00\x00\x00\x0ftEXtSoftware\x00ccmarlX\xba\x97<";

/// Bytes before that chunk: the signature and the header, which is always as long.
const PNG_HEADER: usize = 33;

/// Largest file that is looked at, bytes.
const LIMIT: u64 = 64 << 20;

/// Refuses an output inside a store, one that exists, or with `force` one that has content that is not ours.
pub(super) fn check(path: &Path, force: bool, is_ours: impl FnOnce(&[u8]) -> bool) -> Result<(), Error> {
    io::refuse_existing(path, force)?;
    storage::refuse_within_store(path)?;
    if path.symlink_metadata().is_err() {
        return Ok(());
    }
    let ours = path.is_file() && io::read_bytes(path, LIMIT).is_ok_and(|bytes| bytes.is_empty() || is_ours(&bytes));
    if ours { Ok(()) } else { Err(IoError::Foreign(path.to_owned()).into()) }
}

/// Whether a file is a picture that one of these functions wrote.
pub(super) fn is_picture(bytes: &[u8]) -> bool {
    let png = bytes.get(PNG_HEADER..).is_some_and(|chunks| chunks.starts_with(PNG_MARK));
    png || bytes.starts_with(b"<svg") && bytes.ends_with(SVG_MARK.as_bytes())
}

/// Writes SVG text with our mark.
pub(super) fn write_svg(path: &Path, svg: String) -> Result<(), Error> {
    let line_end = if svg.ends_with('\n') { "" } else { "\n" };
    Ok(io::write_atomic(path, (svg + line_end + SVG_MARK).as_bytes())?)
}

/// Writes a PNG file with our mark.
pub(super) fn write_png(path: &Path, png: &[u8]) -> Result<(), Error> {
    let (header, chunks) = png.split_at(PNG_HEADER.min(png.len()));
    Ok(io::write_atomic(path, &[header, PNG_MARK, chunks].concat())?)
}
