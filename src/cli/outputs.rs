//! Files that commands write beside their results: what `--force` may replace of them, and pictures that say who drew them.

use std::path::{Path, PathBuf};

use crate::figure::{self, Data, FIGURES};
use crate::io::{self, IoError};
use crate::registry::find;
use crate::{Error, mi, storage};

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

/// A form of output file.
pub(super) type Write<R> = fn(&[R]) -> Result<Vec<u8>, String>;

/// How rows are written to a file of this name, which must not hold anything that is not ours.
pub(super) fn table<R: mi::Row>(path: &Path, force: bool) -> Result<Write<R>, Error> {
    io::refuse_existing(path, force)?;
    storage::refuse_within_store(path)?;
    let forms: [(&str, Write<R>); 3] = [("json", mi::to_json), ("csv", mi::to_csv), ("parquet", mi::to_parquet)];
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    let form = forms.iter().find(|(name, _)| extension.as_deref() == Some(*name));
    let usage = || {
        Error::Usage(format!("--out: expected a name that ends in .json, .csv or .parquet, found {}", path.display()))
    };
    let write = form.map(|(_, write)| *write).ok_or_else(usage)?;
    if path.symlink_metadata().is_ok() && !mi::holds::<R>(path) {
        return Err(IoError::Foreign(path.to_owned()).into());
    }
    Ok(write)
}

/// The error that names the option which a picture was given with.
fn of_plot(error: Error) -> Error {
    match error {
        Error::Io(IoError::Exists(path)) => {
            let path = path.display();
            Error::Usage(format!("output exists: give --force to replace it, or another --plot: {path}"))
        }
        Error::Io(IoError::Foreign(path)) => IoError::ForeignPicture(path).into(),
        other => other,
    }
}

/// Where a picture goes.
pub(super) struct Picture {
    path: PathBuf,
    is_png: bool,
}

impl Picture {
    /// Checks the name before anything is computed.
    pub(super) fn at(path: &Path, force: bool) -> Result<Self, Error> {
        let ends = |with: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(with));
        if !ends("svg") && !ends("png") {
            let message = format!("--plot: expected a name that ends in .svg or .png, found {}", path.display());
            return Err(Error::Usage(message));
        }
        check(path, force, is_picture).map_err(of_plot)?;
        Ok(Self { path: path.to_owned(), is_png: ends("png") })
    }

    /// Where it goes.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Draws the figure of this name.
    pub(super) fn draw(&self, figure: &str, data: &Data) -> anyhow::Result<()> {
        let entry = find("figure", FIGURES, figure)?;
        if self.is_png {
            let folder = tempfile::tempdir()?;
            let whole = folder.path().join("figure.png");
            figure::png(entry, data, &whole)?;
            write_png(&self.path, &io::read_bytes(&whole, u64::MAX - 1).map_err(Error::from)?)?;
        } else {
            write_svg(&self.path, figure::svg(entry, data)?)?;
        }
        Ok(())
    }
}

/// Writes SVG text with our mark.
pub(super) fn write_svg(path: &Path, svg: String) -> Result<(), Error> {
    let line_end = if svg.ends_with('\n') { "" } else { "\n" };
    Ok(io::write_atomic(path, (svg + line_end + SVG_MARK).as_bytes())?)
}

/// Writes a PNG file with our mark.
fn write_png(path: &Path, png: &[u8]) -> Result<(), Error> {
    let (header, chunks) = png.split_at(PNG_HEADER.min(png.len()));
    Ok(io::write_atomic(path, &[header, PNG_MARK, chunks].concat())?)
}
