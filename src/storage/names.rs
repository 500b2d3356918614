//! What may be written where: names of outputs, what stands there already, and what belongs to somebody else.

use std::path::{Path, PathBuf};

use super::{MANIFEST_LIMIT, StorageError, lock, recover};
use crate::io::{self, IoError};

/// The file that makes a directory a store.
const MANIFEST_FILE: &str = "manifest.json";

/// Refuses a name whose ending looks like that of another kind of file. A number is no such ending (`dropout-0.2`), and
/// a name that ends in a slash, or is a directory already, is a directory's.
fn check_name(path: &Path) -> Result<(), StorageError> {
    let Some(extension) = path.extension() else { return Ok(()) };
    let extension = extension.to_string_lossy().into_owned();
    let known = ["parquet", "mcap"].iter().any(|known| extension.eq_ignore_ascii_case(known));
    let number = extension.starts_with(|c: char| c.is_ascii_digit());
    let slash = path.as_os_str().as_encoded_bytes().ends_with(b"/");
    if known && slash {
        return Err(StorageError::Slash { extension, path: path.to_owned() });
    }
    if known || number || slash || path.is_dir() {
        return Ok(());
    }
    Err(StorageError::Extension { extension, path: path.to_owned() })
}

/// Refuses what no store can be written to, before any work is done.
pub(super) fn check_output(path: &Path, force: bool) -> Result<(), StorageError> {
    check_name(path)?;
    refuse_within_store(path)?;
    Ok(io::refuse_existing(path, force)?)
}

/// Refuses to write a store onto the one that it is made from.
pub(super) fn refuse_same(from: &Path, to: &Path) -> Result<(), StorageError> {
    let real = |path: &Path| path.canonicalize().ok();
    if real(from).is_some() && real(from) == real(to) { Err(StorageError::Same(to.to_owned())) } else { Ok(()) }
}

/// Refuses an output inside a store, or inside one that is being written: other readers would take it for a part, and
/// `--force` on that store would have to remove it.
///
/// # Errors
/// [`StorageError::Within`].
pub fn refuse_within_store(path: &Path) -> Result<(), StorageError> {
    let real = path.ancestors().skip(1).find_map(|above| {
        let above = if above.as_os_str().is_empty() { Path::new(".") } else { above };
        above.canonicalize().ok()
    });
    for above in real.iter().flat_map(|real| real.ancestors()) {
        if is_store(above) || recover::target_of(above).is_some() {
            return Err(StorageError::Within { store: above.to_owned(), path: path.to_owned() });
        }
    }
    Ok(())
}

/// Whether a directory has a rollout manifest.
fn is_store(directory: &Path) -> bool {
    let text = io::read_text(&directory.join(MANIFEST_FILE), MANIFEST_LIMIT).unwrap_or_default();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    json["kind"] == "rollouts"
}

/// Where a store is built: checks that `path` and its `.partial` sibling may be replaced and that nobody writes there,
/// removes an old sibling, makes the directories above. With `force`, only empty directories and what ccmarl made are
/// replaced.
pub(super) fn start_partial(path: &Path, force: bool) -> Result<PathBuf, StorageError> {
    io::refuse_existing(path, force)?;
    refuse_foreign(path)?;
    let partial = io::partial_path(path);
    if partial.symlink_metadata().is_ok() {
        lock::hold_leftover(&partial)?;
        if !force {
            return Err(unfinished(path, partial));
        }
        io::remove(&partial)?;
    }
    io::create_parent(path)?;
    Ok(partial)
}

/// What is said of what a kill left.
pub(super) fn unfinished(target: &Path, path: PathBuf) -> StorageError {
    let task = (super::format_of(target).build.salvage)(&path).map(|left| left.manifest().task.clone());
    let what = what(task.as_deref().unwrap_or_default());
    StorageError::Unfinished { what, target: target.to_owned(), path }
}

/// What makes a store whose unsealed manifest names this task.
pub(super) fn what(task: &str) -> &'static str {
    if task == "convert" { "conversion" } else { "recording" }
}

/// Refuses to replace what ccmarl did not make, when something stands at `path`: it may be an empty directory or file, a
/// file that carries a rollout manifest, or a directory with one that holds nothing but the files of a store.
pub(super) fn refuse_foreign(path: &Path) -> Result<(), IoError> {
    if path.symlink_metadata().is_err() {
        return Ok(());
    }
    let foreign = || Err(IoError::Foreign(path.to_owned()));
    if !path.is_dir() {
        let size = path.metadata().map_err(IoError::os("read", path))?.len();
        let ours = size == 0 || begins_as_ours(path)?;
        return if ours { Ok(()) } else { foreign() };
    }
    let mut names = Vec::new();
    for entry in std::fs::read_dir(path).map_err(IoError::os("list", path))? {
        let entry = entry.map_err(IoError::os("list", path))?;
        let is_file = entry.file_type().map_err(IoError::os("list", path))?.is_file();
        names.push((entry.file_name(), is_file));
    }
    names.sort();
    if !names.is_empty() && !is_store(path) {
        return foreign();
    }
    match names.into_iter().find(|(name, is_file)| !is_file || !is_part_of_a_store(&name.to_string_lossy())) {
        Some((name, _)) => Err(IoError::ForeignEntry { entry: PathBuf::from(name), path: path.to_owned() }),
        None => Ok(()),
    }
}

/// Whether a directory store has files of this name. The lock is there only until the kill of a writer.
fn is_part_of_a_store(name: &str) -> bool {
    let number = name.strip_prefix("part-").and_then(|rest| rest.strip_suffix(".parquet"));
    let part = number.is_some_and(|number| number.len() >= 5 && number.bytes().all(|b| b.is_ascii_digit()));
    part || [MANIFEST_FILE, lock::LOCK_FILE].contains(&name)
}

/// Puts a finished store under its name, as [`io::publish`] does, unless that holds what ccmarl did not make.
pub(super) fn publish(from: &Path, to: &Path, force: bool) -> Result<(), IoError> {
    if force {
        refuse_foreign(to)?; // again: a recording takes its time
    }
    io::publish(from, to, force, MANIFEST_FILE)
}

/// Whether a file begins as Parquet does and ends with a manifest, or as our MCAP, which may be cut short.
fn begins_as_ours(path: &Path) -> Result<bool, IoError> {
    use std::io::Read as _;
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(IoError::os("open", path))?;
    file.take(1 << 12).read_to_end(&mut head).map_err(IoError::os("read", path))?;
    let recording = head.windows(16).any(|bytes| bytes == b"ccmarl.recording");
    if head.starts_with(b"\x89MCAP") && recording {
        return Ok(true);
    }
    Ok(head.starts_with(b"PAR1") && carries(path, "ccmarl.manifest")?)
}

/// Whether a file has this metadata key in its last mebibyte.
pub(super) fn carries(path: &Path, key: &str) -> Result<bool, IoError> {
    use std::io::{Read as _, Seek as _, SeekFrom};
    let mut file = std::fs::File::open(path).map_err(IoError::os("open", path))?;
    let size = file.metadata().map_err(IoError::os("read", path))?.len();
    let mut tail = Vec::new();
    file.seek(SeekFrom::Start(size.saturating_sub(1 << 20))).map_err(IoError::os("read", path))?;
    file.take(1 << 20).read_to_end(&mut tail).map_err(IoError::os("read", path))?;
    Ok(tail.windows(key.len()).any(|w| w == key.as_bytes()))
}
