//! Stores: recorded episodes on disk. One schema, several containers, lossless between them.
//!
//! Adding a format: write `storage/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod convert;
mod form;
mod ipc;
mod lock;
mod mcap;
mod names;
mod parquet;
mod recover;
mod rescue;
mod rows;
mod tally;
mod verify;

use std::path::{Path, PathBuf};

pub use parquet::PairsWriter;

use crate::io::IoError;
use crate::registry::Entry;
use crate::schema::{Episode, Manifest, SchemaError};
use names::{carries, publish, start_partial};
use tally::Tally;
use verify::Findings;

pub use convert::convert;
pub use form::{TableForm, table_form};
pub use lock::Owner;
pub use mcap::{Cell, TopicColumn, topic_columns, topic_names};
pub use names::refuse_within_store;
pub use recover::{Recovered, left_beside, recover};
pub use rescue::{Rescued, rescue};
pub use rows::{Rows, Take};
pub use verify::{Problem, Report, Watch, ranges, verify};

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
    /// Whether a store has what viewers draw; true of forms that never have it, so that a copy in another form does.
    viewer: fn(&Path) -> bool,
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
    #[error("{}: {}", cut_short(*episodes, path), path.display())]
    Truncated {
        /// Whole episodes before the cut.
        episodes: u64,
        /// Where.
        path: PathBuf,
    },
    /// Somebody is writing it.
    #[error("{owner} is writing it right now: wait until it has ended, or take another name: {}", path.display())]
    Busy {
        /// Who.
        owner: Owner,
        /// What is being written.
        path: PathBuf,
    },
    /// What is left of a recording or a conversion that did not finish.
    #[error(
        "its {what} did not finish; `ccmarl recover {}` puts its whole episodes in place, the same command with --force starts anew: {}",
        printable(target), path.display()
    )]
    Unfinished {
        /// `recording` or `conversion`.
        what: &'static str,
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
    /// A directory's name with the ending of a file.
    #[error(
        "a name in .{extension} is a file's, and / a directory's: leave out the one or the other: {}",
        path.display()
    )]
    Slash {
        /// The ending.
        extension: String,
        /// The name.
        path: PathBuf,
    },
    /// An output inside a store.
    #[error("the output would lie inside the store {}: give a place outside of it: {}", printable(store), path.display())]
    Within {
        /// The store, or what is being written of one.
        store: PathBuf,
        /// The output.
        path: PathBuf,
    },
    /// A store has its name: nothing was left unfinished.
    #[error(
        "nothing to recover: it is no unfinished recording; where `ccmarl verify` finds damage, `ccmarl recover {} --out NEW` saves what is sound: {}",
        printable(path), path.display()
    )]
    Finished {
        /// Where.
        path: PathBuf,
    },
    /// A store would replace what it is made from.
    #[error("this is the store itself, which cannot be made from itself, not even with --force; give another name: {}", .0.display())]
    Same(PathBuf),
    /// Nothing is damaged.
    #[error("nothing to recover: it is whole; `ccmarl verify` checks it, `ccmarl convert` copies it: {}", path.display())]
    Whole {
        /// Where.
        path: PathBuf,
    },
    /// A store beside which lies what was to replace it.
    #[error(
        "beside this store lies what did not finish; `ccmarl recover --force {}` puts its whole episodes in place of the store; to keep both, give the store another name first and leave out --force: {}",
        printable(path), path.display()
    )]
    Beside {
        /// The store.
        path: PathBuf,
    },
    /// What a kill left holds nothing.
    #[error("killed before its first episode was committed: there is nothing to recover; start again with --force: {}", path.display())]
    Empty {
        /// Where.
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

impl StorageError {
    /// Whether the user's words are at fault, not the data or the machine.
    pub fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::Extension { .. }
                | Self::Slash { .. }
                | Self::Within { .. }
                | Self::Same(_)
                | Self::Beside { .. }
                | Self::Io(IoError::Exists(_))
        )
    }
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
    names::check_output(path, options.force)?;
    crate::io::keep_freed_memory();
    (format_of(path).build.create)(path, manifest, options)
}

/// Opens the store at `path`.
///
/// # Errors
/// [`StorageError`] when it is missing, not a store, of a newer version, or damaged.
pub fn open(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    if let Some((path, target)) = recover::unfinished(path) {
        lock::refuse_living(&path)?;
        return Err(names::unfinished(&target, path));
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

/// Checks a file before its columns are read as a table by a reader that believes it: of Parquet the digest, when it is
/// a store or a part of one, and that no page asks for an absurd amount of memory; of Arrow IPC that no length does.
/// Other forms are not checked.
///
/// # Errors
/// [`StorageError::Damaged`].
pub fn check_table(path: &Path, form: TableForm) -> Result<(), StorageError> {
    match form {
        TableForm::Parquet => parquet::check_table(path),
        TableForm::IpcFile | TableForm::IpcStream => ipc::check(path, form == TableForm::IpcStream),
        _ => Ok(()),
    }
}

/// The first format that claims the path; Parquet when none does.
fn format_of(path: &Path) -> &'static Entry<Format> {
    FORMATS.iter().find(|e| (e.build.claims)(path)).unwrap_or(&FORMATS[FORMATS.len() - 1])
}

/// What is said of a file that ends too early; what can be done with it depends on what it holds.
fn cut_short(episodes: u64, path: &Path) -> String {
    match episodes {
        0 => "cut short, and no episode of it is whole: copy it again, or record again".to_owned(),
        _ => format!(
            "cut short after {episodes} whole episodes: copy it again, or keep these with `ccmarl recover --force {}`",
            printable(path)
        ),
    }
}

fn printable(path: &Path) -> String {
    crate::io::printable(&path.display().to_string())
}
