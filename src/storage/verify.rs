//! Is a store what it says? Every check of the reader, and what a reader need not care about.

use std::path::Path;

use serde::Serialize;

use super::{StorageError, format_of, recover};
use crate::io::IoError;
use crate::schema::{Episode, Manifest};

/// Problems that are listed; the rest is counted.
const LISTED: usize = 1000;

/// One thing that is not as it should be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// What was checked: `digest`, `checksum`, `length`, `manifest`, `parts`, `columns`, `rows`, `values`, `counters`, …
    pub check: &'static str,
    /// Which part, chunk or episode.
    pub place: String,
    /// What was expected and found.
    pub message: String,
    /// Whether data is gone; otherwise it is wrong.
    pub lost: bool,
}

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// The manifest, if one could be read; not necessarily a sound one.
    pub manifest: Option<Manifest>,
    /// Sound episodes.
    pub episodes: u64,
    /// Their steps.
    pub steps: u64,
    /// What is not as it should be; at most 1000.
    pub problems: Vec<Problem>,
    /// Problems beyond these.
    pub unlisted: u64,
    /// What is worth knowing and no problem.
    pub notes: Vec<String>,
}

impl Report {
    /// Whether nothing is wrong and nothing lost.
    pub fn is_clean(&self) -> bool {
        self.problems.is_empty()
    }

    /// Whether something that is there is wrong, not only gone.
    pub fn is_wrong(&self) -> bool {
        self.unlisted > 0 || self.problems.iter().any(|p| !p.lost)
    }
}

/// A caller's look at an episode: what was checked, and what is wrong with it.
pub type Watch<'a> = dyn FnMut(&Manifest, &Episode) -> Option<(&'static str, String)> + 'a;

/// Collects what is found.
pub(super) struct Findings<'a> {
    report: Report,
    watch: &'a mut Watch<'a>,
}

impl Findings<'_> {
    /// Something is wrong.
    pub(super) fn wrong(&mut self, check: &'static str, place: &str, message: String) {
        self.push(Problem { check, place: place.to_owned(), message, lost: false });
    }

    /// Something is gone.
    pub(super) fn lost(&mut self, check: &'static str, place: &str, message: String) {
        self.push(Problem { check, place: place.to_owned(), message, lost: true });
    }

    /// An error of a reader is a problem; its path is the place.
    pub(super) fn error(&mut self, check: &'static str, place: &str, error: &StorageError) {
        match error {
            StorageError::Damaged { message, .. } | StorageError::NotAStore { message, .. } => {
                self.wrong(check, place, message.clone());
            }
            StorageError::Schema { source, .. } => self.wrong(check, place, source.to_string()),
            StorageError::Truncated { .. } => self.lost(check, place, "it is cut short".to_owned()),
            other => self.wrong(check, place, other.to_string()),
        }
    }

    fn push(&mut self, problem: Problem) {
        if self.report.problems.contains(&problem) {
            return; // two passes over a file say the same
        }
        if self.report.problems.len() < LISTED {
            self.report.problems.push(problem);
        } else {
            self.report.unlisted += 1;
        }
    }

    /// A manifest that is read even when its digest is wrong, which is reported.
    pub(super) fn manifest(&mut self, place: &str, text: Option<&str>) -> Option<Manifest> {
        let Some(text) = text else {
            self.wrong("manifest", place, "there is none".to_owned());
            return None;
        };
        let manifest = match Manifest::parse(text) {
            Ok(manifest) => Some(manifest),
            Err(error) => {
                self.wrong("manifest", place, error.to_string());
                Manifest::parse_damaged(text).ok()
            }
        };
        self.report.manifest.clone_from(&manifest);
        manifest
    }

    /// What the episodes belong to, where there is no sealed manifest.
    pub(super) fn describe(&mut self, manifest: &Manifest) {
        self.report.manifest = Some(manifest.clone());
    }

    /// Counts a sound episode, and asks the caller for its opinion.
    pub(super) fn episode(&mut self, episode: &Episode) {
        self.report.episodes += 1;
        self.report.steps += episode.steps as u64;
        let Some(manifest) = self.report.manifest.take() else { return };
        if let Some((check, message)) = (self.watch)(&manifest, episode) {
            self.wrong(check, &format!("episode {}", episode.index), message);
        }
        self.report.manifest = Some(manifest);
    }

    /// Problems so far.
    pub(super) fn len(&self) -> usize {
        self.report.problems.len()
    }

    /// Whether there is no problem so far.
    pub(super) fn is_clean(&self) -> bool {
        self.report.is_clean()
    }
}

/// Checks everything about the store at `path`, or about what a kill left under that name, and reports every fault: each
/// damaged part, chunk and episode, with the first thing that is wrong in it. `watch` sees every sound episode; what it
/// returns is a problem as well.
///
/// # Errors
/// [`StorageError`] when there is nothing at `path`, it is no store, or the disk refuses.
pub fn verify<'a>(path: &Path, watch: &'a mut Watch<'a>) -> Result<Report, StorageError> {
    let mut findings = Findings { report: Report::default(), watch };
    if let Some((leftover, target)) = recover::unfinished(path) {
        unfinished(&leftover, &target, &mut findings)?;
        return Ok(findings.report);
    }
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    // What the reader takes without an error has passed all checks; otherwise a second look finds all that is wrong.
    match read(path, &mut findings) {
        Ok(()) => strays(path, &mut findings)?,
        Err(error @ (StorageError::Io(_) | StorageError::NotAStore { .. })) => return Err(error),
        Err(error) => {
            findings.report = Report::default();
            (format_of(path).build.diagnose)(path, &mut findings)?;
            if findings.is_clean() {
                findings.error("reading", "store", &error);
            }
            strays(path, &mut findings)?;
        }
    }
    if let Some(manifest) = &findings.report.manifest
        && manifest.planned > 0
    {
        let note = format!("{} of {} planned episodes: the recording was stopped", manifest.episodes, manifest.planned);
        findings.report.notes.push(note);
    }
    Ok(findings.report)
}

/// Reads all episodes as any reader does.
fn read(path: &Path, findings: &mut Findings<'_>) -> Result<(), StorageError> {
    let mut source = super::open(path)?;
    findings.describe(source.manifest());
    while let Some(episode) = source.next_episode()? {
        findings.episode(&episode);
    }
    Ok(())
}

/// Parquet files in the directory that the manifest does not name: other tools would read them as part of the store.
fn strays(path: &Path, findings: &mut Findings<'_>) -> Result<(), StorageError> {
    let Some(manifest) = findings.report.manifest.clone().filter(|_| path.is_dir()) else { return Ok(()) };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(path).map_err(IoError::os("list", path))? {
        names.push(entry.map_err(IoError::os("list", path))?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    for name in names.iter().filter(|name| name.ends_with(".parquet")) {
        if !manifest.parts.iter().any(|part| part.file == *name) {
            findings.wrong("parts", name, "the manifest does not name it; other readers would take it in".to_owned());
        }
    }
    Ok(())
}

/// Counts what a kill left.
fn unfinished(leftover: &Path, target: &Path, findings: &mut Findings<'_>) -> Result<(), StorageError> {
    let mut ended = String::new();
    match (format_of(target).build.salvage)(leftover) {
        Ok(mut source) => {
            findings.describe(source.manifest());
            loop {
                match source.next_episode() {
                    Ok(Some(episode)) => findings.episode(&episode),
                    Ok(None) | Err(StorageError::Truncated { .. }) => break,
                    Err(error) => {
                        ended = format!("; then: {error}");
                        break;
                    }
                }
            }
        }
        Err(error @ StorageError::Io(_)) => return Err(error),
        Err(error) => ended = format!("; {error}"),
    }
    let planned = findings.report.manifest.as_ref().map_or(0, |m| m.planned);
    let of = if planned > 0 { format!(" of {planned} planned") } else { String::new() };
    let message = format!(
        "the recording did not finish: {}{of} episodes are whole{ended}; `ccmarl recover {}` puts them in place",
        findings.report.episodes,
        target.display()
    );
    findings.lost("recording", &leftover.display().to_string(), message);
    Ok(())
}
