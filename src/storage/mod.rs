//! Stores: recorded episodes on disk. One schema, several containers, lossless between them.
//!
//! Adding a format: write `storage/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod convert;
mod lock;
mod mcap;
mod parquet;
mod recover;
mod rows;
mod tally;
mod verify;

use std::path::{Path, PathBuf};

pub use parquet::PairsWriter;

use crate::io::IoError;
use crate::registry::Entry;
use crate::schema::{Episode, Manifest, SchemaError};
use tally::Tally;
use verify::Findings;

pub use convert::convert;
pub use lock::Owner;
pub use recover::{Recovered, recover};
pub use rows::{Rows, Take};
pub use verify::{Problem, Report, Watch, verify};

/// All formats, in the order in which a path is offered to them; the last takes what none claims.
pub const FORMATS: &[Entry<Format>] = &[mcap::ENTRY, parquet::ENTRY];

/// Largest manifest that is read, bytes.
const MANIFEST_LIMIT: u64 = 64 << 20;

/// Metadata key of a table of pairs.
const PAIRS_KEY: &str = "ccmarl.pairs";

/// Starts a store at a path, for a manifest.
pub type Create = fn(&Path, &Manifest, Options) -> Result<Box<dyn EpisodeSink>, StorageError>;

/// How a store is written.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Replace what ccmarl wrote under this name before.
    pub force: bool,
    /// Also write what viewers draw, where the format has viewers; the rollouts do not depend on it.
    pub viewer: bool,
}

/// How a format is recognised, written and read.
#[derive(Clone, Copy, Debug)]
pub struct Format {
    /// Whether an output path asks for this format (by its extension).
    pub claims: fn(&Path) -> bool,
    /// Starts a store; nothing appears under `path` before [`EpisodeSink::finish`].
    pub create: Create,
    /// Opens a store for reading; checks its manifest and digests.
    pub open: fn(&Path) -> Result<Box<dyn EpisodeSource>, StorageError>,
    /// Opens what a kill left of a store: its whole episodes, then an error that says why there are no more.
    salvage: fn(&Path) -> Result<Box<dyn EpisodeSource>, StorageError>,
    /// Reports everything that is wrong with a store that the reader refused.
    diagnose: fn(&Path, &mut Findings<'_>) -> Result<(), StorageError>,
}

/// Takes episodes in index order and seals them into a store.
///
/// The bytes of the finished store depend on the episodes alone, not on when the caller commits.
pub trait EpisodeSink: Send {
    /// Appends the next episode; it is safe only after the next [`EpisodeSink::commit`].
    ///
    /// # Errors
    /// [`StorageError`] when the episode is out of order, breaks the schema or holds a NaN, or the disk refuses.
    fn append(&mut self, episode: &Episode) -> Result<(), StorageError>;

    /// Appends the next episodes; a sink that can works on them with all threads of the caller's pool.
    ///
    /// # Errors
    /// As [`EpisodeSink::append`].
    fn append_all(&mut self, episodes: &[Episode]) -> Result<(), StorageError> {
        episodes.iter().try_for_each(|episode| self.append(episode))
    }

    /// Hands all episodes appended so far to the operating system: once this returns they survive the death of the
    /// process. Returns how many these are. Costs one write; call it per batch of episodes.
    ///
    /// # Errors
    /// [`StorageError`] when the disk refuses.
    fn commit(&mut self) -> Result<u64, StorageError>;

    /// Seals the store under its name and returns the final manifest.
    ///
    /// # Errors
    /// [`StorageError`] when the disk refuses.
    fn finish(self: Box<Self>) -> Result<Manifest, StorageError>;
}

/// Reads episodes in index order, holding a bounded number in memory.
pub trait EpisodeSource: Send {
    /// The store's manifest.
    fn manifest(&self) -> &Manifest;

    /// The next episode, or `None` at the end. Each is checked against the layout.
    ///
    /// # Errors
    /// [`StorageError`] when data is damaged, missing or against the schema.
    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError>;

    /// Hands over the rows that are left, of these agents, until there are none or `take` wants no more. Faster than
    /// episodes where the store keeps columns: their content hashes are not computed anew, since the digest of the file
    /// says that its bytes are those that were written.
    ///
    /// # Errors
    /// As [`EpisodeSource::next_episode`]; rows before the fault were handed over.
    fn read_rows(&mut self, agents: &[usize], take: &mut Take<'_>) -> Result<(), StorageError> {
        rows::by_episode(self, agents, take)
    }

    /// Goes on to episode number `episode` without returning those before. A directory passes over whole parts without
    /// opening them.
    ///
    /// # Errors
    /// As [`EpisodeSource::next_episode`].
    fn skip_to(&mut self, episode: u64) -> Result<(), StorageError> {
        for _ in 0..episode {
            if self.next_episode()?.is_none() {
                break;
            }
        }
        Ok(())
    }
}

/// What goes wrong with a store. The path comes last.
#[derive(Debug, thiserror::Error)]
pub enum StorageError {
    /// The file system.
    #[error(transparent)]
    Io(#[from] IoError),
    /// The data breaks the schema.
    #[error("{source}: {}", path.display())]
    Schema {
        /// Which rule.
        source: SchemaError,
        /// Where.
        path: PathBuf,
    },
    /// Not a store, or not one that can be read.
    #[error("not a rollout store: {message}: {}", path.display())]
    NotAStore {
        /// What was expected and found, and what to do.
        message: String,
        /// Where.
        path: PathBuf,
    },
    /// The file ends too early.
    #[error("cut short: {episodes} of its episodes are whole; record again, or copy the file again: {}", path.display())]
    Truncated {
        /// Whole episodes before the cut.
        episodes: u64,
        /// Where.
        path: PathBuf,
    },
    /// Somebody is writing it.
    #[error("{owner} is writing it right now: wait until it has ended, or give another --out: {}", path.display())]
    Busy {
        /// Who.
        owner: Owner,
        /// What is being written.
        path: PathBuf,
    },
    /// What is left of a recording that did not finish.
    #[error(
        "its recording did not finish; `ccmarl recover {}` puts its whole episodes in place, --force records anew: {}",
        printable(target), path.display()
    )]
    Unfinished {
        /// The store's name.
        target: PathBuf,
        /// The hidden `.partial` beside it.
        path: PathBuf,
    },
    /// An output name that asks for a form which there is not.
    #[error(
        "no store ends in .{extension}: give a name in .parquet or .mcap, one without an ending for a directory, or one that ends in / for a directory of just this name: {}",
        path.display()
    )]
    Extension {
        /// The ending.
        extension: String,
        /// The name.
        path: PathBuf,
    },
    /// A digest or a structure does not match.
    #[error("damaged: {message}: {}", path.display())]
    Damaged {
        /// What was expected and found, and what to do.
        message: String,
        /// Where.
        path: PathBuf,
    },
}

/// Starts a store at `path`, with what viewers draw; its extension chooses the format (`.mcap`, `.parquet`, anything
/// else a directory of Parquet parts).
///
/// # Errors
/// [`IoError::Exists`] without `force`; [`StorageError`] when the disk refuses.
pub fn create(path: &Path, manifest: &Manifest, force: bool) -> Result<Box<dyn EpisodeSink>, StorageError> {
    create_with(path, manifest, Options { force, viewer: true })
}

/// Starts a store at `path`, as [`create`] does, with options.
///
/// # Errors
/// As [`create`].
pub fn create_with(path: &Path, manifest: &Manifest, options: Options) -> Result<Box<dyn EpisodeSink>, StorageError> {
    check_name(path)?;
    crate::io::refuse_existing(path, options.force)?;
    crate::io::keep_freed_memory();
    (format_of(path).build.create)(path, manifest, options)
}

/// Opens the store at `path`.
///
/// # Errors
/// [`StorageError`] when it is missing, not a store, of a newer version, or damaged.
pub fn open(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    if let Some((path, target)) = recover::unfinished(path) {
        return Err(StorageError::Unfinished { target, path });
    }
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    crate::io::keep_freed_memory();
    let source = (format_of(path).build.open)(path)?;
    if source.manifest().episodes == 0 {
        let message = "it holds zero episodes: record again".to_owned();
        return Err(StorageError::NotAStore { message, path: path.to_owned() });
    }
    Ok(source)
}

/// Checks a Parquet file before its columns are read as a table: the digest, when it is a store or a part of one, and
/// that no page asks for an absurd amount of memory.
///
/// # Errors
/// [`StorageError::Damaged`].
pub fn check_table(path: &Path) -> Result<(), StorageError> {
    parquet::check_table(path)
}

/// Refuses a name whose ending looks like that of another kind of file. A number is no such ending (`dropout-0.2`), and
/// a name that ends in a slash, or is a directory already, is a directory's.
fn check_name(path: &Path) -> Result<(), StorageError> {
    let Some(extension) = path.extension() else { return Ok(()) };
    let extension = extension.to_string_lossy().into_owned();
    let known = ["parquet", "mcap"].iter().any(|known| extension.eq_ignore_ascii_case(known));
    let number = extension.starts_with(|c: char| c.is_ascii_digit());
    if known || number || path.as_os_str().as_encoded_bytes().ends_with(b"/") || path.is_dir() {
        return Ok(());
    }
    Err(StorageError::Extension { extension, path: path.to_owned() })
}

/// Where a store is built: checks that `path` and its `.partial` sibling may be replaced and that nobody writes there,
/// removes an old sibling, makes the directories above. With `force`, only empty directories and what ccmarl made are
/// replaced.
fn start_partial(path: &Path, force: bool) -> Result<PathBuf, StorageError> {
    crate::io::refuse_existing(path, force)?;
    if path.symlink_metadata().is_ok() && !is_ours(path)? {
        return Err(IoError::Foreign(path.to_owned()).into());
    }
    let partial = crate::io::partial_path(path);
    if partial.symlink_metadata().is_ok() {
        lock::hold_leftover(&partial)?;
        if !force {
            return Err(StorageError::Unfinished { target: path.to_owned(), path: partial });
        }
        crate::io::remove(&partial)?;
    }
    crate::io::create_parent(path)?;
    Ok(partial)
}

/// Whether ccmarl made what stands at `path`: an empty directory or file, one with a rollout manifest, or a file that
/// carries one.
fn is_ours(path: &Path) -> Result<bool, IoError> {
    if path.is_dir() {
        if std::fs::read_dir(path).map_err(IoError::os("list", path))?.next().is_none() {
            return Ok(true);
        }
        let manifest = crate::io::read_text(&path.join("manifest.json"), MANIFEST_LIMIT).unwrap_or_default();
        let json: serde_json::Value = serde_json::from_str(&manifest).unwrap_or_default();
        return Ok(json["kind"] == "rollouts");
    }
    let size = path.metadata().map_err(IoError::os("read", path))?.len();
    Ok(size == 0 || carries(path, "ccmarl.manifest")?)
}

/// Whether a file has this metadata key in its last mebibyte.
fn carries(path: &Path, key: &str) -> Result<bool, IoError> {
    use std::io::{Read as _, Seek as _, SeekFrom};
    let mut file = std::fs::File::open(path).map_err(IoError::os("open", path))?;
    let size = file.metadata().map_err(IoError::os("read", path))?.len();
    let mut tail = Vec::new();
    file.seek(SeekFrom::Start(size.saturating_sub(1 << 20))).map_err(IoError::os("read", path))?;
    file.take(1 << 20).read_to_end(&mut tail).map_err(IoError::os("read", path))?;
    Ok(tail.windows(key.len()).any(|w| w == key.as_bytes()))
}

/// The first format that claims the path; Parquet when none does.
fn format_of(path: &Path) -> &'static Entry<Format> {
    FORMATS.iter().find(|e| (e.build.claims)(path)).unwrap_or(&FORMATS[FORMATS.len() - 1])
}

fn printable(path: &Path) -> String {
    crate::io::printable(&path.display().to_string())
}
