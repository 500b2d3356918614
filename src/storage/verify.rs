//! Is a store what it says? Every check of the reader, and what a reader need not care about.

use std::path::Path;

use serde::Serialize;

use super::{StorageError, format_of, lock, names, recover};
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
    /// A manifest with its own digest right.
    trusted: Option<Manifest>,
    /// Number of the last sound episode.
    last: Option<u64>,
    watch: &'a mut Watch<'a>,
}

impl<'a> Findings<'a> {
    /// Nothing yet.
    pub(super) fn new(watch: &'a mut Watch<'a>) -> Self {
        Self { report: Report::default(), trusted: None, last: None, watch }
    }

    /// Takes note of a manifest whose own digest is right; the first one stays.
    pub(super) fn trust(&mut self, manifest: &Manifest) {
        self.trusted.get_or_insert_with(|| manifest.clone());
    }

    /// A manifest that can be believed, if there is one.
    pub(super) fn trusted(&self) -> Option<&Manifest> {
        self.trusted.as_ref()
    }

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
            Ok(manifest) => {
                self.trusted = Some(manifest.clone());
                Some(manifest)
            }
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
        if self.last.is_some_and(|last| episode.index <= last) {
            let place = format!("episode {}", episode.index);
            return self.wrong("rows", &place, "it is there twice, or out of order".to_owned());
        }
        self.last = Some(episode.index);
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
    let mut findings = Findings::new(watch);
    if let Some((leftover, target)) = recover::unfinished(path) {
        lock::refuse_living(&leftover)?;
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
            (findings.report, findings.last) = (Report::default(), None);
            (format_of(path).build.diagnose)(path, &mut findings)?;
            if findings.is_clean() {
                findings.error("reading", "store", &error);
            }
            strays(path, &mut findings)?;
        }
    }
    let notes = findings.report.manifest.as_ref().map(notes).unwrap_or_default();
    findings.report.notes.extend(notes);
    Ok(findings.report)
}

/// What a sealed manifest says that a user should know.
fn notes(manifest: &Manifest) -> Vec<String> {
    let mut notes = Vec::new();
    if manifest.planned > 0 && !manifest.content.is_empty() {
        let (episodes, planned) = (manifest.episodes, manifest.planned);
        let why =
            if manifest.kept.is_empty() { "the recording was stopped, or cut short" } else { "the others were lost" };
        notes.push(format!("{episodes} of {planned} planned episodes: {why}"));
    }
    if !manifest.kept.is_empty() {
        let numbers = ranges(&manifest.kept);
        notes.push(format!("saved from a damaged store, where its episodes were numbered {numbers}"));
    }
    notes
}

/// Ranges \[from, to) in words.
pub fn ranges(ranges: &[[u64; 2]]) -> String {
    let one = |[from, to]: &[u64; 2]| {
        if to.saturating_sub(1) <= *from { from.to_string() } else { format!("{from} to {}", to - 1) }
    };
    let shown: Vec<String> = ranges.iter().take(20).map(one).collect();
    let more = ranges.len().saturating_sub(20);
    if more > 0 { format!("{} and {more} more ranges", shown.join(", ")) } else { shown.join(", ") }
}

/// Reads all episodes as any reader does.
pub(super) fn read(path: &Path, findings: &mut Findings<'_>) -> Result<(), StorageError> {
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
    let place = leftover.display().to_string();
    match (format_of(target).build.salvage)(leftover) {
        Ok(mut source) => {
            findings.describe(source.manifest());
            loop {
                match source.next_episode() {
                    Ok(Some(episode)) => findings.episode(&episode),
                    Ok(None) | Err(StorageError::Truncated { .. }) => break,
                    Err(error @ StorageError::Io(_)) => return Err(error),
                    Err(error) => {
                        findings.error("journal", &place, &error);
                        break;
                    }
                }
            }
        }
        Err(error @ StorageError::Io(_)) => return Err(error),
        Err(StorageError::Empty { .. }) => {
            let message = "it was killed before its first episode was committed: start again with --force".to_owned();
            findings.lost("recording", &place, message);
            return Ok(());
        }
        Err(error) => findings.error("journal", &place, &error),
    }
    let manifest = findings.report.manifest.as_ref();
    let (planned, task) = manifest.map_or((0, ""), |m| (m.planned, &m.task[..]));
    let of = if planned > 0 { format!(" of {planned} planned") } else { String::new() };
    let again = if task.is_empty() { "" } else { ", and the same command with --force starts anew" };
    let message = format!(
        "the {} did not finish: {}{of} episodes are whole; `ccmarl recover {}` puts them in place{again}",
        names::what(task),
        findings.report.episodes,
        target.display()
    );
    findings.lost("recording", &place, message);
    Ok(())
}
