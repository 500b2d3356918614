//! From a damaged store to a new one of its sound episodes.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::verify::{Findings, read};
use super::{EpisodeSink, Options, StorageError, create_with, format_of, names, recover};
use crate::io::{self, IoError};
use crate::schema::{Episode, Manifest};

/// What was saved of a damaged store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rescued {
    /// Episodes in the new store; 0 when none was sound, and none was written.
    pub episodes: u64,
    /// Episodes that the damaged store held when it was sealed, else those that it was to hold.
    pub planned: u64,
    /// The numbers that were saved, as ranges \[from, to), as they were in the damaged store.
    pub kept: Vec<[u64; 2]>,
}

impl Rescued {
    /// The numbers that were lost, as ranges \[from, to).
    pub fn lost(&self) -> Vec<[u64; 2]> {
        let ends = self.kept.iter().map(|[_, to]| *to);
        let begins = self.kept.iter().map(|[from, _]| *from).chain([self.planned]);
        std::iter::once(0).chain(ends).zip(begins).filter(|(from, to)| from < to).map(|(from, to)| [from, to]).collect()
    }
}

/// Writes the sound episodes of the damaged store `path` into a new store `to`, numbered anew from 0; its manifest says
/// which they were. An episode is sound when its content hash, the digest of its part, or that of all content vouches
/// for it. `path` is only read. Memory is bounded. `None` when `stop` turned true; nothing is left then.
///
/// # Errors
/// [`StorageError::Whole`] when nothing is wrong with `path`, and [`StorageError::Beside`] when what was to replace it lies
/// beside it; [`StorageError`] when no manifest in it can be trusted, it
/// is what a kill left, `to` exists (without `force`), or the disk refuses.
pub fn rescue(
    path: &Path,
    to: &Path,
    force: bool,
    watch: &mut dyn FnMut(&Manifest, &Episode),
    stop: &AtomicBool,
) -> Result<Option<Rescued>, StorageError> {
    names::check_output(to, force)?;
    names::refuse_same(path, to)?;
    if let Some((left, target)) = recover::unfinished(path) {
        if target.exists() {
            return Err(StorageError::Beside { path: target });
        }
        return Err(names::unfinished(&target, left));
    }
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    match read(path, &mut Findings::new(&mut |_, _| None)) {
        Ok(()) if recover::left_beside(path).is_some() => {
            return Err(StorageError::Beside { path: path.to_owned() });
        }
        Ok(()) => return Err(StorageError::Whole { path: path.to_owned() }),
        Err(error @ (StorageError::Io(_) | StorageError::NotAStore { .. })) => return Err(error),
        Err(_) => {}
    }
    let diagnose = format_of(path).build.diagnose;
    let mut kept: Vec<[u64; 2]> = Vec::new();
    let mut note = |_: &Manifest, episode: &Episode| {
        match kept.last_mut() {
            Some([_, to]) if *to == episode.index => *to += 1,
            _ => kept.push([episode.index, episode.index + 1]),
        }
        None
    };
    let mut findings = Findings::new(&mut note);
    diagnose(path, &mut findings)?;
    let Some(manifest) = findings.trusted().map(held) else {
        let message = "no manifest in it can be trusted, so that nothing says what its episodes are".to_owned();
        return Err(StorageError::Damaged { message, path: path.to_owned() });
    };
    let episodes = kept.iter().map(|[from, to]| to - from).sum();
    let rescued = Rescued { episodes, planned: manifest.planned.max(episodes), kept };
    if episodes == 0 {
        return Ok(Some(rescued));
    }
    let options = Options { force, viewer: (format_of(path).build.viewer)(path) };
    let manifest = Manifest { kept: rescued.kept.clone(), ..manifest };
    let mut sink = create_with(to, &manifest, options)?;
    match copy(path, &mut *sink, &manifest, watch, stop) {
        Ok(copied) if copied == rescued.episodes => sink.finish().map(|_| Some(rescued)),
        other => {
            drop(sink);
            io::remove(&io::partial_path(to))?;
            if stop.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let found = other?;
            let message = format!("it changed while it was read: {found} sound episodes after {episodes}");
            Err(StorageError::Damaged { message, path: path.to_owned() })
        }
    }
}

/// An unsealed manifest that plans what the damaged store held: a recording that was stopped in good order holds fewer
/// episodes than were planned, and the others never were.
fn held(manifest: &Manifest) -> Manifest {
    let planned = if manifest.episodes > 0 { manifest.episodes } else { manifest.planned };
    Manifest { planned, ..manifest.unsealed() }
}

/// Appends every sound episode, with the next number; how many these were.
fn copy(
    path: &Path,
    sink: &mut dyn EpisodeSink,
    manifest: &Manifest,
    watch: &mut dyn FnMut(&Manifest, &Episode),
    stop: &AtomicBool,
) -> Result<u64, StorageError> {
    let (mut count, mut fault) = (0, None);
    let mut append = |_: &Manifest, episode: &Episode| {
        if fault.is_none() && !stop.load(Ordering::Relaxed) {
            let renumbered = Episode { index: count, ..episode.clone() };
            match sink.append(&renumbered) {
                Ok(()) => count += 1,
                Err(error) => fault = Some(error),
            }
            watch(manifest, episode);
        }
        None
    };
    (format_of(path).build.diagnose)(path, &mut Findings::new(&mut append))?;
    fault.map_or(Ok(count), Err)
}
