//! Files: atomic writes, directories that appear whole, digests.

use std::cell::Cell;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Once;
use std::sync::atomic::{AtomicUsize, Ordering};

use sha2::{Digest as _, Sha256};

use crate::schema::hex;

/// What can go wrong with a path. The path comes last.
#[derive(Debug, thiserror::Error)]
pub enum IoError {
    /// The operating system refused.
    #[error("could not {action}: {source}: {}", path.display())]
    Os {
        /// What was tried, as a verb phrase.
        action: &'static str,
        /// The reason given.
        source: std::io::Error,
        /// Where.
        path: PathBuf,
    },
    /// The output is already there.
    #[error("output exists: give --force to replace it, or another --out: {}", .0.display())]
    Exists(PathBuf),
    /// Nothing there.
    #[error("no such file or directory: {}", .0.display())]
    Missing(PathBuf),
    /// `--force` would replace something that this program did not make.
    #[error("refusing to replace what ccmarl did not make; remove it by hand, or give another --out: {}", .0.display())]
    Foreign(PathBuf),
    /// The same of a picture.
    #[error("refusing to replace what is no picture of ccmarl; remove it by hand, or give another --plot: {}", .0.display())]
    ForeignPicture(PathBuf),
    /// `--force` would remove something that this program did not put there.
    #[error(
        "refusing to replace a directory that holds what ccmarl did not put there: {}; move it, or give another --out: {}",
        printable(&entry.display().to_string()), path.display()
    )]
    ForeignEntry {
        /// The first such name in the directory.
        entry: PathBuf,
        /// The directory.
        path: PathBuf,
    },
}

impl IoError {
    /// Wraps an operating-system error; for `map_err`.
    pub fn os(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Os { action, source, path }
    }
}

/// Refuses an output path that exists, unless `force`.
///
/// # Errors
/// [`IoError::Exists`].
pub fn refuse_existing(path: &Path, force: bool) -> Result<(), IoError> {
    if !force && path.symlink_metadata().is_ok() { Err(IoError::Exists(path.to_owned())) } else { Ok(()) }
}

/// Reads a whole file of at most `limit` bytes.
///
/// # Errors
/// [`IoError::Os`] (also when the file is larger).
pub fn read_bytes(path: &Path, limit: u64) -> Result<Vec<u8>, IoError> {
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(IoError::os("open", path))?;
    file.take(limit + 1).read_to_end(&mut bytes).map_err(IoError::os("read", path))?;
    if bytes.len() as u64 > limit {
        let too_large = std::io::Error::other(format!("larger than the limit of {limit} bytes"));
        return Err(IoError::os("read", path)(too_large));
    }
    Ok(bytes)
}

/// Reads a whole text file of at most `limit` bytes.
///
/// # Errors
/// [`IoError::Missing`], [`IoError::Os`] (also when the file is larger, or not UTF-8).
pub fn read_text(path: &Path, limit: u64) -> Result<String, IoError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()));
    }
    let mut text = String::new();
    let file = File::open(path).map_err(IoError::os("open", path))?;
    file.take(limit + 1).read_to_string(&mut text).map_err(IoError::os("read as UTF-8 text", path))?;
    if text.len() as u64 > limit {
        let too_large = std::io::Error::other(format!("larger than the limit of {limit} bytes"));
        return Err(IoError::os("read", path)(too_large));
    }
    Ok(text)
}

/// Writes a file that is there whole, with all its bytes on disk, or not at all. Makes missing parent directories.
///
/// # Errors
/// [`IoError::Os`].
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), IoError> {
    create_parent(path)?;
    let mut file = atomic_write_file::AtomicWriteFile::open(path).map_err(IoError::os("create", path))?;
    file.write_all(bytes).map_err(IoError::os("write", path))?;
    file.commit().map_err(IoError::os("put in place", path))
}

/// Makes the directories above `path`.
///
/// # Errors
/// [`IoError::Os`].
pub fn create_parent(path: &Path) -> Result<(), IoError> {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => {
            std::fs::create_dir_all(parent).map_err(IoError::os("create the directory", parent))
        }
        _ => Ok(()),
    }
}

/// The sibling `.<name>.partial` in which an output is built before it takes its name.
pub fn partial_path(path: &Path) -> PathBuf {
    hidden_sibling(path, "partial")
}

fn hidden_sibling(path: &Path, ending: &str) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or("out".as_ref())); // the name's own bytes: it need not be UTF-8
    name.push(".");
    name.push(ending);
    path.with_file_name(name)
}

/// Puts a finished file or directory under its final name, replacing what `force` allows it to replace.
///
/// A directory is replaced only if it is empty or holds `marker` (the file that says that ccmarl made it). It is first
/// renamed to `.<name>.replaced`, and deleted once the new one is in place.
///
/// # Errors
/// [`IoError::Exists`], [`IoError::Foreign`], [`IoError::Os`].
pub fn publish(from: &Path, to: &Path, force: bool, marker: &str) -> Result<(), IoError> {
    refuse_existing(to, force)?;
    if to.is_dir() {
        let empty = std::fs::read_dir(to).map_err(IoError::os("list", to))?.next().is_none();
        if !empty && !to.join(marker).exists() {
            return Err(IoError::Foreign(to.to_owned()));
        }
    }
    // a rename replaces a file by a file in one step; all else takes two, and a kill between them must lose nothing
    let aside = hidden_sibling(to, "replaced");
    let two_steps = to.symlink_metadata().is_ok() && (to.is_dir() || from.is_dir());
    if two_steps {
        remove(&aside)?;
        std::fs::rename(to, &aside).map_err(IoError::os("set aside", to))?;
    }
    if let Err(error) = std::fs::rename(from, to) {
        if two_steps {
            std::fs::rename(&aside, to).map_err(IoError::os("put back", to))?;
        }
        return Err(IoError::os("put in place", to)(error));
    }
    sync_dir(to.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")))?;
    if two_steps { remove(&aside) } else { Ok(()) }
}

/// Removes a file, a link (not what it points to) or a directory, if it is there.
///
/// # Errors
/// [`IoError::Os`].
pub fn remove(path: &Path) -> Result<(), IoError> {
    let Ok(found) = path.symlink_metadata() else { return Ok(()) };
    let removed = if found.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    removed.map_err(IoError::os("remove", path))
}

/// Makes a rename in `dir` durable.
///
/// # Errors
/// [`IoError::Os`].
pub fn sync_dir(dir: &Path) -> Result<(), IoError> {
    File::open(dir).and_then(|d| d.sync_all()).map_err(IoError::os("sync", dir))
}

/// SHA-256 of a file, 64 hex digits, and its size in bytes; reads in blocks.
///
/// # Errors
/// [`IoError::Missing`], [`IoError::Os`].
pub fn sha256_file(path: &Path) -> Result<(String, u64), IoError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()));
    }
    let mut file = File::open(path).map_err(IoError::os("open", path))?;
    let (mut hash, mut block, mut size) = (Sha256::new(), vec![0; 1 << 18], 0);
    loop {
        let n = file.read(&mut block).map_err(IoError::os("read", path))?;
        if n == 0 {
            return Ok((hex(&hash.finalize()), size));
        }
        hash.update(&block[..n]);
        size += n as u64;
    }
}

/// Keeps freed memory in the process for what is allocated next.
///
/// A store is written and read in column buffers of some hundred kilobytes. By default glibc gives each of them back to
/// the system, which hands it out again page by page: a quarter of the processor time of a recording, measured. It stops
/// that for sizes up to the largest block that was freed, so one such block, never touched, is enough. Elsewhere this
/// does nothing.
pub fn keep_freed_memory() {
    drop(std::hint::black_box(Vec::<u8>::with_capacity(31 << 20)));
}

/// Text that came from a file, safe to print on a terminal: control characters are shown escaped.
pub fn printable(text: &str) -> String {
    text.chars().flat_map(|c| if c.is_control() { c.escape_default().collect() } else { vec![c] }).collect()
}

/// Calls of [`caught`] under way.
static CAUGHT: AtomicUsize = AtomicUsize::new(0);
static HOOK: Once = Once::new();

std::thread_local! {
    /// Whether this thread is inside [`caught`].
    static INSIDE: Cell<bool> = const { Cell::new(false) };
}

/// Calls a foreign reader; `None` when it panics, as polars does on some damaged files.
///
/// The panic's message is not printed. Only this thread and polars' own workers are silenced, and only meanwhile.
pub fn caught<T>(read: impl FnOnce() -> T) -> Option<T> {
    HOOK.call_once(|| {
        let print = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            let worker = || std::thread::current().name().is_some_and(|name| name.starts_with("polars"));
            if !(INSIDE.get() || CAUGHT.load(Ordering::SeqCst) > 0 && worker()) {
                print(panic);
            }
        }));
    });
    let outer = INSIDE.replace(true);
    CAUGHT.fetch_add(1, Ordering::SeqCst);
    let result = catch_unwind(AssertUnwindSafe(read));
    CAUGHT.fetch_sub(1, Ordering::SeqCst);
    INSIDE.set(outer);
    result.ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_directory_is_replaced_only_with_its_marker_and_leaves_nothing_beside_it() {
        let dir = tempfile::tempdir().unwrap();
        let (from, to) = (dir.path().join("new"), dir.path().join("out"));
        let fill = |path: &Path, text: &str| write_atomic(path, text.as_bytes()).unwrap();
        fill(&from.join("marker"), "new");
        fill(&to.join("thesis.tex"), "old");
        assert!(matches!(publish(&from, &to, true, "marker"), Err(IoError::Foreign(_))));
        assert_eq!(names(dir.path()), ["new", "out"]);
        fill(&to.join("marker"), "old");
        fill(&dir.path().join(".out.replaced/left"), "by a kill");
        publish(&from, &to, true, "marker").unwrap();
        assert_eq!((names(dir.path()), names(&to)), (vec!["out".to_owned()], vec!["marker".to_owned()]));
    }

    #[test]
    fn what_cannot_be_replaced_is_put_back() {
        let dir = tempfile::tempdir().unwrap();
        let to = dir.path().join("out");
        write_atomic(&to.join("marker"), b"old").unwrap();
        let error = publish(&dir.path().join("gone"), &to, true, "marker").unwrap_err().to_string();
        assert!(error.starts_with("could not put in place: "), "{error}");
        assert_eq!((names(dir.path()), names(&to)), (vec!["out".to_owned()], vec!["marker".to_owned()]));
    }

    #[test]
    fn a_panic_of_a_reader_is_none() {
        assert_eq!(caught(|| 7), Some(7));
        assert_eq!(caught(|| [1, 2][std::hint::black_box(2)]), None);
    }
}
