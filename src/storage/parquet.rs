//! # What it is
//! The Parquet store: a directory of `part-*.parquet` with a `manifest.json`, or one `.parquet` file. Dataframe tools
//! open either without this program.
//!
//! # Definition
//! One row per step, T + 1 rows per episode, sorted by (`episode`, `step`); the last row has null `action.*` and
//! `reward*`. The manifest is `manifest.json`, or the metadata entry `ccmarl.manifest` of the one file, which also
//! carries `ccmarl.file_sha256`: the SHA-256 of the whole file with these 64 digits written as zeros.
//!
//! # Shapes and units
//! `episode` int64, `step` int32, flags bool, `state` f64\[S\], `observation.*`, `message.*`, `action.*` f32 lists of
//! fixed size, `link` bool\[N·N\] \[sender\]\[receiver\], `reward*` f32. A column of width 0 is left out.
//!
//! # Parameters
//! None. Floats are split into byte streams under zstd, without a dictionary; row groups hold whole episodes, up to
//! 131,072 rows or 128 MiB of rows in memory; a part holds up to 4,000 episodes or 128 MiB of rows in memory.
//!
//! # When it fails
//! Until it is finished a store lives in the hidden sibling `.<name>.partial`, with a journal (an Arrow IPC stream)
//! that holds all committed episodes and their content hashes; a kill leaves that, and `recover` reads it. A journal also
//! knows the digests of the parts that are sealed by then. Reading checks the digest of a file before it is decoded.
//!
//! # Reference
//! Apache Parquet format 2.10; RLDS step flags (Ramos et al. 2021, arXiv 2111.02767).
//!
//! # Differences from the reference implementation
//! RLDS nests steps in episodes; here a step is a row with scalar keys, so that any engine can group by them.

mod batch;
mod columns;
mod decoder;
mod diagnose;
mod encoder;
mod group;
mod journal;
mod journal_reader;
mod leaf;
mod levels;
mod pages;
mod pairs;
mod rows;
mod salvage;
mod shared;
mod side_by_side;
mod sink;
mod source;
mod twins;

use std::fs::File;
use std::path::Path;

pub use pairs::PairsWriter;
use parquet::file::metadata::{ParquetMetaData, ParquetMetaDataReader};

use super::{EpisodeSink, EpisodeSource, Format, Options, StorageError};
use crate::io::IoError;
use crate::registry::Entry;
use crate::schema::Manifest;

/// Name of the manifest inside a directory store.
pub(super) const MANIFEST_FILE: &str = "manifest.json";
/// Metadata key of the manifest in a single file and in a journal.
const MANIFEST_KEY: &str = "ccmarl.manifest";
/// Metadata key of the unsealed manifest in a part of a directory.
const PART_KEY: &str = "ccmarl.part";
/// Metadata key of a single file's own digest.
const FILE_SHA256_KEY: &str = "ccmarl.file_sha256";

/// The Parquet store.
pub(super) const ENTRY: Entry<Format> = Entry {
    name: "parquet",
    summary: "a directory of Parquet parts with a manifest, or one .parquet file",
    reference: "Apache Parquet",
    value: None,
    build: Format { claims, create, open, salvage, diagnose: diagnose::diagnose, viewer: |_| true },
};

fn claims(path: &Path) -> bool {
    path.extension().is_none_or(|e| e.eq_ignore_ascii_case("parquet"))
}

fn is_single(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("parquet"))
}

fn create(path: &Path, manifest: &Manifest, options: Options) -> Result<Box<dyn EpisodeSink>, StorageError> {
    Ok(Box::new(sink::ParquetSink::create(path, manifest, options.force)?))
}

fn open(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    if path.is_dir() {
        Ok(Box::new(source::Parts::open(path)?))
    } else if is_single(path) {
        Ok(Box::new(source::Single::open(path)?))
    } else {
        let message =
            "expected a directory, a .parquet or a .mcap file; for a table use `ccmarl estimate-mi FILE --x … --y …`";
        Err(StorageError::NotAStore { message: message.to_owned(), path: path.to_owned() })
    }
}

pub(super) fn check_table(path: &Path) -> Result<(), StorageError> {
    source::check_table(path)
}

fn salvage(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    Ok(Box::new(salvage::Leftover::open(path)?))
}

/// The footer of a file.
fn footer(path: &Path) -> Result<ParquetMetaData, StorageError> {
    let file = File::open(path).map_err(IoError::os("open", path))?;
    decoder::guard(path, || ParquetMetaDataReader::new().parse_and_finish(&file))
}

/// What a footer says under a key.
fn entry<'a>(metadata: &'a ParquetMetaData, key: &str) -> Option<&'a str> {
    let mut entries = metadata.file_metadata().key_value_metadata().into_iter().flatten();
    entries.find(|kv| kv.key == key).and_then(|kv| kv.value.as_deref())
}

/// Where the 64 digits of the file's own digest begin in the end of its footer: after the key stand two bytes of
/// Thrift (field header, length).
fn find_file_digest(footer: &[u8]) -> Option<usize> {
    let key = FILE_SHA256_KEY.as_bytes();
    let at = footer.windows(key.len()).rposition(|w| w == key)? + key.len() + 2;
    (at + 64 <= footer.len()).then_some(at)
}
