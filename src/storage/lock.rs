//! One writer per name. The operating system holds the lock and lets it go when the process ends, however it ends, so
//! none is ever stale: what a kill left is not locked.

use std::fs::{File, TryLockError};
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};

use super::StorageError;
use crate::io::IoError;

/// Name of the lock within a directory that is being written; it holds the writer's process number.
pub(super) const LOCK_FILE: &str = "lock";

/// Locks the directory in which this process writes a store.
pub(super) fn hold_directory(directory: &Path) -> Result<File, StorageError> {
    let path = directory.join(LOCK_FILE);
    let mut file = File::create_new(&path).map_err(IoError::os("create", &path))?;
    refuse_locked(&file.try_lock(), directory, None)?;
    write!(file, "{}", std::process::id()).map_err(IoError::os("write", &path))?;
    Ok(file)
}

/// Locks the file in which this process writes a store.
pub(super) fn hold_file(file: &File, path: &Path) -> Result<(), StorageError> {
    refuse_locked(&file.try_lock(), path, None)
}

/// Removes the lock file of a store that has its name.
pub(super) fn release(store: &Path) -> Result<(), StorageError> {
    Ok(crate::io::remove(&store.join(LOCK_FILE))?)
}

/// Whether nothing but a lock is left in a directory: no part, no journal.
pub(super) fn is_alone(directory: &Path) -> bool {
    let entries = std::fs::read_dir(directory);
    entries.is_ok_and(|mut entries| entries.all(|entry| entry.is_ok_and(|e| e.file_name() == LOCK_FILE)))
}

/// Locks what a writer left behind; refused while that writer lives.
pub(super) fn hold_leftover(leftover: &Path) -> Result<Option<File>, StorageError> {
    ask(leftover, File::try_lock)
}

/// Refuses what a living writer writes. Readers do not stand in each other's way.
pub(super) fn refuse_living(leftover: &Path) -> Result<(), StorageError> {
    ask(leftover, File::try_lock_shared).map(drop)
}

/// Asks for the lock of a writer.
fn ask(leftover: &Path, lock: fn(&File) -> Result<(), TryLockError>) -> Result<Option<File>, StorageError> {
    let path = if leftover.is_dir() { leftover.join(LOCK_FILE) } else { leftover.to_owned() };
    // to write, since network file systems give such locks only to who may write
    let opened = File::options().read(true).write(true).open(&path).or_else(|_| File::open(&path));
    let Ok(mut file) = opened else { return Ok(None) };
    let mut owner = String::new();
    if leftover.is_dir() {
        (&mut file).take(20).read_to_string(&mut owner).ok();
    }
    refuse_locked(&lock(&file), leftover, owner.parse().ok())?;
    Ok(Some(file))
}

fn refuse_locked(taken: &Result<(), TryLockError>, path: &Path, owner: Option<u32>) -> Result<(), StorageError> {
    match taken {
        Err(TryLockError::WouldBlock) => Err(StorageError::Busy { owner: Owner(owner), path: PathBuf::from(path) }),
        // Some network file systems have no locks: there, two writers are told of each other by the name alone.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(()),
    }
}

/// Who writes, as far as it is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Owner(Option<u32>);

impl std::fmt::Display for Owner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            Some(pid) => write!(f, "process {pid}"),
            None => f.write_str("another process"),
        }
    }
}
