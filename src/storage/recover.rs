//! From what a kill left to a store under its name.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::{EpisodeSource, Options, StorageError, format_of, lock, names, publish};
use crate::io::{self, IoError};
use crate::schema::{Episode, Manifest};

/// How a recovery ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Recovered {
    /// Where the store is, or would be.
    pub path: PathBuf,
    /// Episodes in it; 0 when there was nothing to put in place.
    pub episodes: u64,
    /// Episodes that were to be recorded; 0 when nobody knew.
    pub planned: u64,
    /// Why the episodes end where they end, unless they ended in good order.
    pub ended: Option<String>,
    /// Where the leftover is kept that could not be read to its end.
    pub kept: Option<PathBuf>,
}

impl Recovered {
    /// Whether episodes that were to be there are not, or may be missing since nobody knew how many.
    pub fn is_loss(&self) -> bool {
        self.ended.is_some() || self.planned == 0 || self.episodes < self.planned
    }
}

/// What a kill left of the store that `path` names, and that store's name. `path` may be the name, the hidden `.partial`
/// beside it, or a file within that.
pub(super) fn unfinished(path: &Path) -> Option<(PathBuf, PathBuf)> {
    for candidate in [Some(path), path.parent()].into_iter().flatten() {
        if let Some(target) = target_of(candidate)
            && candidate.exists()
        {
            return Some((candidate.to_owned(), target));
        }
    }
    let partial = io::partial_path(path);
    (!path.exists() && partial.exists()).then(|| (partial, path.to_owned()))
}

/// What a kill left beside the store at `path`, which is there itself: a recording with `--force` that did not finish.
pub fn left_beside(path: &Path) -> Option<PathBuf> {
    let partial = io::partial_path(path);
    (path.exists() && partial.exists()).then_some(partial)
}

/// `.<name>.partial` → `<name>`.
pub(super) fn target_of(partial: &Path) -> Option<PathBuf> {
    let name = partial.file_name()?.as_encoded_bytes();
    let name = name.strip_prefix(b".")?.strip_suffix(b".partial")?;
    let target = partial.with_file_name(os_str(name)?);
    (io::partial_path(&target) == partial).then_some(target)
}

#[cfg(unix)]
#[expect(clippy::unnecessary_wraps, reason = "elsewhere a name may be no text")]
fn os_str(bytes: &[u8]) -> Option<&OsStr> {
    Some(std::os::unix::ffi::OsStrExt::from_bytes(bytes))
}

#[cfg(not(unix))]
fn os_str(bytes: &[u8]) -> Option<&OsStr> {
    std::str::from_utf8(bytes).ok().map(OsStr::new)
}

/// Puts the whole episodes of an unfinished store under its name, and removes what was left; what cannot be read to its
/// end is kept beside it instead. `path` is the name, or
/// what is left beside it, or a finished file that was cut short; that one is replaced only with `force`. Memory is
/// bounded. A kill meanwhile loses nothing: what was left goes last. `None` when `stop` turned true; all is as before
/// then.
///
/// # Errors
/// [`StorageError`] when there is nothing to recover, the name is taken and `force` is not given, a program is still
/// writing it, or the disk refuses.
pub fn recover(
    path: &Path,
    force: bool,
    watch: &mut dyn FnMut(&Manifest, &Episode),
    stop: &AtomicBool,
) -> Result<Option<Recovered>, StorageError> {
    let (leftover, target) = match unfinished(path) {
        Some(found) => found,
        None if io::partial_path(path).exists() => (io::partial_path(path), path.to_owned()),
        None if path.exists() => (path.to_owned(), path.to_owned()),
        None => return Err(IoError::Missing(path.to_owned()).into()),
    };
    if leftover == target {
        match super::open(&target) {
            Err(StorageError::Truncated { .. }) => {}
            Err(StorageError::Damaged { message, path }) => {
                let name = io::printable(&target.display().to_string());
                let message = format!("{message}; `ccmarl recover {name} --out NEW` saves what is sound");
                return Err(StorageError::Damaged { message, path });
            }
            Err(error) => return Err(error),
            Ok(_) => return Err(StorageError::Finished { path: target }),
        }
    }
    let _held = lock::hold_leftover(&leftover)?;
    let format = format_of(&target).build;
    if leftover != target
        && lock::is_alone(&leftover)
        && let Ok(store) = super::open(&target)
    {
        // the kill came when the store had its name, before the empty rest was removed
        io::remove(&leftover)?;
        let episodes = store.manifest().episodes;
        let planned = store.manifest().planned.max(episodes);
        return Ok(Some(Recovered { path: target, episodes, planned, ended: None, kept: None }));
    }
    if leftover != target && !force && target.symlink_metadata().is_ok() {
        return Err(StorageError::Beside { path: target });
    }
    io::refuse_existing(&target, force)?;
    names::refuse_foreign(&target)?;
    let mut source = (format.salvage)(&leftover)?;
    let manifest = source.manifest().clone();
    let mut recovered =
        Recovered { path: target.clone(), episodes: 0, planned: manifest.planned, ended: None, kept: None };
    // Built under a name of its own, with the ending of the target, which chooses the format.
    let mut name = std::ffi::OsString::from(".recovered.");
    name.push(target.file_name().unwrap_or("out".as_ref()));
    let built = target.with_file_name(name);
    let options = Options { force: true, viewer: (format.viewer)(&leftover) };
    let mut sink = (format.create)(&built, &manifest, options)?;
    while let Some(episode) = next(&mut *source, &mut recovered)? {
        if stop.load(Ordering::Relaxed) {
            drop(sink);
            io::remove(&io::partial_path(&built))?;
            return Ok(None);
        }
        sink.append(&episode)?;
        recovered.episodes += 1;
        watch(&manifest, &episode);
    }
    if recovered.episodes == 0 {
        return Ok(Some(recovered)); // the sink removes what it began
    }
    sink.finish()?;
    publish(&built, &target, force)?;
    if recovered.ended.is_some() && leftover != target {
        // what cannot be read now may hold more: it stays, where nothing takes it for a recording
        let mut names = (1..=u32::MAX).map(|k| leftover.with_extension(format!("unrecovered-{k}")));
        let kept = names.find(|name| name.symlink_metadata().is_err()).unwrap_or_else(|| leftover.clone());
        std::fs::rename(&leftover, &kept).map_err(IoError::os("keep", &kept))?;
        recovered.kept = Some(kept);
    } else if leftover != target {
        io::remove(&leftover)?;
    }
    Ok(Some(recovered))
}

/// The next episode; `None` at the end of what is whole, and why it ends there goes into `recovered`.
fn next(source: &mut dyn EpisodeSource, recovered: &mut Recovered) -> Result<Option<Episode>, StorageError> {
    match source.next_episode() {
        Err(StorageError::Truncated { .. }) => Ok(None),
        Err(error @ StorageError::Io(_)) => Err(error),
        Err(error) => {
            recovered.ended = Some(error.to_string());
            Ok(None)
        }
        read => read,
    }
}
