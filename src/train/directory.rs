//! A run directory: what may lie in it, how it appears, and what a kill leaves in it.

use std::fs::{File, TryLockError};
use std::path::Path;

use super::checkpoint;
use super::evaluate::EVALUATION_FILE;
use super::protocol::STANDARD_FILE;
use super::{TrainConfig, TrainError, Trainer};
use crate::io::{self, IoError};

/// What a run directory may hold; anything else in it is somebody's own.
const RUN_FILES: [&str; 8] = [
    CONFIG,
    "metrics.parquet",
    "timings.parquet",
    EVALUATION_FILE,
    STANDARD_FILE,
    MUTUAL,
    "events.out.tfevents.ccmarl",
    CHECKPOINTS,
];

/// Estimates of what the team's messages tell, where somebody put them beside its tables.
const MUTUAL: &str = "mi.parquet";
/// The configuration, fully resolved; says that a directory is a run.
pub(super) const CONFIG: &str = "config.toml";
pub(super) const CHECKPOINTS: &str = "checkpoint";

/// Refuses an output directory that exists, or with `force` one that is not just a run.
pub(super) fn refuse_foreign(dir: &Path, force: bool) -> Result<(), TrainError> {
    io::refuse_existing(dir, force)?;
    if !dir.exists() {
        return Ok(());
    }
    let own = names(dir)?;
    if !own.is_empty() && TrainConfig::parse(&dir.join(CONFIG)).is_err() {
        return Err(IoError::Foreign(dir.to_owned()).into());
    }
    let checkpoints = dir.join(CHECKPOINTS);
    let below = if checkpoints.is_dir() { names(&checkpoints)? } else { Vec::new() };
    for (folder, names, known) in [(dir, own, &RUN_FILES[..]), (&checkpoints, below, &checkpoint::FILES)] {
        if let Some(name) = names.iter().find(|name| !known.contains(&name.as_str()) && !is_leftover(name)) {
            return Err(IoError::ForeignEntry { entry: name.into(), path: folder.to_owned() }.into());
        }
    }
    Ok(())
}

/// A directory that is held. It is let go in so many words: closing would not do while a process that was just forked
/// has the file too.
pub(super) struct Held(File);

impl Drop for Held {
    fn drop(&mut self) {
        self.0.unlock().ok(); // what fails ends with the process
    }
}

/// Holds a directory for this process, if it is there: two that train into one would undo each other's work. The
/// operating system lets go when the process ends, so no lock is ever stale; where it has no locks there is only the name.
pub(super) fn hold(dir: &Path) -> Result<Option<Held>, TrainError> {
    let Ok(file) = File::open(dir) else { return Ok(None) };
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => Err(TrainError::Busy(dir.to_owned())),
        Ok(()) | Err(TryLockError::Error(_)) => Ok(Some(Held(file))),
    }
}

/// Makes the directory of a run that has not taken a step: with its configuration and first checkpoint it appears under
/// its name, and only then is what was there gone. It is held from its first file on; the lock goes with the rename.
pub(super) fn create(trainer: &mut Trainer, force: bool) -> Result<Option<Held>, TrainError> {
    let dir = trainer.dir.clone();
    let partial = io::partial_path(&dir);
    drop(hold(&partial)?); // a living writer's partial is not removed
    let own = |name: &String| RUN_FILES.contains(&name.as_str()) || is_leftover(name);
    if partial.exists() && !names(&partial)?.iter().all(own) {
        return Err(IoError::Foreign(partial).into()); // a recording that `recover` can still put in place
    }
    io::remove(&partial)?;
    io::create_parent(&partial.join(CONFIG))?;
    let held = hold(&partial)?;
    trainer.dir.clone_from(&partial);
    let saved = write_config(trainer).and_then(|()| trainer.save());
    trainer.dir.clone_from(&dir);
    saved?;
    io::publish(&partial, &dir, force, CONFIG)?;
    Ok(held)
}

/// Writes `config.toml`.
pub(super) fn write_config(trainer: &Trainer) -> Result<(), TrainError> {
    Ok(io::write_atomic(&trainer.dir.join(CONFIG), trainer.config.to_toml()?.as_bytes())?)
}

/// Removes files that were being written when a kill came.
pub(super) fn remove_leftovers(dir: &Path) -> Result<(), TrainError> {
    for folder in [dir.to_owned(), dir.join(CHECKPOINTS)] {
        if folder.is_dir() {
            for name in names(&folder)?.iter().filter(|name| is_leftover(name)) {
                io::remove(&folder.join(name))?;
            }
        }
    }
    Ok(())
}

/// Removes tests and estimates of a run that is about to go on: they are of the team that it had. Returns their names.
pub(super) fn remove_tests(trainer: &Trainer) -> Result<Vec<&'static str>, TrainError> {
    if trainer.tests.best.params.is_empty() {
        io::remove(&trainer.dir.join(CHECKPOINTS).join(checkpoint::BEST))?; // otherwise the next checkpoint's is its
    }
    let there = |name: &&str| trainer.dir.join(name).exists();
    let names: Vec<_> = [EVALUATION_FILE, STANDARD_FILE, MUTUAL].into_iter().filter(there).collect();
    names.iter().try_for_each(|name| io::remove(&trainer.dir.join(name)))?;
    Ok(names)
}

/// Whether a name is that of a file on its way to one of a run's names: `.<name>.` and random letters.
fn is_leftover(name: &str) -> bool {
    let Some((stem, ending)) = name.strip_prefix('.').and_then(|rest| rest.rsplit_once('.')) else { return false };
    let ours = RUN_FILES.contains(&stem) || checkpoint::FILES.contains(&stem);
    ours && ending.len() == 6 && ending.chars().all(|c| c.is_ascii_alphanumeric())
}

/// Names in a directory, sorted; one that is not UTF-8 is nobody's of ours.
fn names(dir: &Path) -> Result<Vec<String>, TrainError> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(IoError::os("list", dir))? {
        names.push(entry.map_err(IoError::os("list", dir))?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_is_let_go_though_a_forked_process_has_its_file_too() {
        let dir = tempfile::tempdir().unwrap();
        let held = hold(dir.path()).unwrap().unwrap();
        assert!(matches!(hold(dir.path()), Err(TrainError::Busy(_))));
        let forked = held.0.try_clone().unwrap();
        drop(held);
        assert!(hold(dir.path()).unwrap().is_some());
        drop(forked);
    }

    #[test]
    fn leftovers_are_told_from_what_somebody_put_there() {
        for ours in [".metrics.parquet.a1B2c3", ".state.safetensors.ABCdef", ".config.toml.000000"] {
            assert!(is_leftover(ours), "{ours}");
        }
        for foreign in [
            ".thesis.safetensors.a1B2c3",
            "metrics.parquet.a1B2c3",
            ".thesis.tex.a1B2c3",
            ".metrics.parquet.a1B2c34",
            ".metrics.parquet",
        ] {
            assert!(!is_leftover(foreign), "{foreign}");
        }
    }
}
