//! What a kill leaves of a directory or file: sealed parts, and the journals of those that were being written.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;

use super::decoder::Decoder;
use super::journal::journal_name;
use super::journal_reader::{JournalReader, Note};
use super::sink::part_name;
use super::source::check_file;
use super::{MANIFEST_FILE, MANIFEST_KEY, PART_KEY, entry, footer};
use crate::io::{self, IoError};
use crate::schema::{Episode, Layout, Manifest, SchemaError};
use crate::storage::tally::check;
use crate::storage::{EpisodeSource, MANIFEST_LIMIT, StorageError, Tally};

/// An unfinished store: its whole episodes in order, then an error that says what is wrong.
pub(super) struct Leftover {
    directory: PathBuf,
    manifest: Manifest,
    /// Digests that stand in the journals and the manifest, those of sealed parts' content among them.
    noted: BTreeSet<String>,
    layout: Layout,
    next_part: usize,
    current: Option<Open>,
    total: Tally,
}

/// A part or a journal.
struct Open {
    decoder: Decoder,
    path: PathBuf,
    /// Of a journal: what it says beside its rows.
    notes: Option<Receiver<Note>>,
}

impl Leftover {
    pub(super) fn open(directory: &Path) -> Result<Self, StorageError> {
        let manifest = manifest(directory)?.ok_or_else(|| StorageError::Empty { path: directory.to_owned() })?;
        let (manifest, noted) = (manifest.unsealed(), noted(directory)?);
        let layout = manifest.layout();
        let (directory, total) = (directory.to_owned(), Tally::default());
        Ok(Self { directory, manifest, noted, layout, next_part: 0, current: None, total })
    }

    /// The next part, or its journal where it was not sealed; false when there is neither.
    fn open_next(&mut self) -> Result<bool, StorageError> {
        let k = self.next_part;
        let (part, journal) = (self.directory.join(part_name(k)), self.directory.join(journal_name(k)));
        let (decoder, path, notes) = if part.is_file() && !journal.is_file() {
            self.vouch(&part)?;
            (Decoder::open(&part, &self.layout)?, part, None)
        } else if !journal.is_file() {
            return self.end(k, "is missing").map(|()| false);
        } else if let Some((batches, notes)) = JournalReader::open(&journal)? {
            let schema = batches.schema();
            (Decoder::journal(&journal, &self.layout, &schema, Box::new(batches))?, journal, Some(notes))
        } else {
            return self.end(k, "holds nothing").map(|()| false);
        };
        self.next_part += 1;
        self.current = Some(Open { decoder, path, notes });
        Ok(true)
    }

    /// Checks a sealed part before any of its episodes is given out: its own digest, or that of its content, which must
    /// have been noted. A digest that fits is no accident, so that it does not matter where it stands.
    fn vouch(&self, path: &Path) -> Result<(), StorageError> {
        match check_file(path) {
            Err(StorageError::NotAStore { .. }) => {}
            checked => return checked,
        }
        let (mut decoder, mut tally) = (Decoder::open(path, &self.layout)?, Tally::default());
        loop {
            let next = self.total.episodes + tally.episodes;
            let Some(episode) = decoder.next_episode(next)? else { break };
            let hash = check(&self.layout, &episode, next);
            tally.add(&episode, &hash.map_err(|source| StorageError::Schema { source, path: path.to_owned() })?);
        }
        if self.noted.contains(&tally.content()) {
            return Ok(());
        }
        let message = "no journal and no manifest that is left has the digest of its episodes".to_owned();
        Err(StorageError::Damaged { message, path: path.to_owned() })
    }

    /// Part or journal `k` is the last of which anything is there; refused when a later one is.
    fn end(&self, k: usize, what: &str) -> Result<(), StorageError> {
        for name in [part_name(k + 1), journal_name(k + 1)] {
            if self.directory.join(&name).exists() {
                let message = format!("{} {what}, but {name} is there", journal_name(k));
                return Err(StorageError::Damaged { message, path: self.directory.clone() });
            }
        }
        Ok(())
    }

    /// What stands behind the last episode of the open journal.
    fn end_of_journal(&self, notes: &Receiver<Note>, path: &Path) -> Result<(), StorageError> {
        let damaged = |message: String| Err(StorageError::Damaged { message, path: path.to_owned() });
        match notes.try_recv() {
            Err(_) => Ok(()),
            Ok(Note::Torn) => {
                self.end(self.next_part - 1, "is cut short")?;
                Err(StorageError::Truncated { episodes: self.total.episodes, path: path.to_owned() })
            }
            Ok(Note::Fault(message)) => damaged(message),
            Ok(Note::Hash(_)) => damaged("a content hash has no episode".to_owned()),
        }
    }
}

impl EpisodeSource for Leftover {
    fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        loop {
            let Some(Open { decoder, path, notes }) = &mut self.current else {
                if self.open_next()? {
                    continue;
                }
                return Ok(None);
            };
            let index = self.total.episodes;
            if let Some(episode) = decoder.next_episode(index)? {
                let hash = self.total.check(&self.layout, &episode);
                let hash = hash.map_err(|source| StorageError::Schema { source, path: path.clone() })?;
                if let Some(notes) = notes
                    && !matches!(notes.try_recv(), Ok(Note::Hash(noted)) if noted == hash)
                {
                    let message = format!("episode {index} does not have the content hash that was noted with it");
                    return Err(StorageError::Damaged { message, path: path.clone() });
                }
                self.total.add(&episode, &hash);
                return Ok(Some(episode));
            }
            if let Some(Open { path, notes: Some(notes), .. }) = &self.current {
                self.end_of_journal(notes, path)?;
            }
            self.current = None;
        }
    }
}

/// Where the text of a manifest may be found; `None` where none was written yet.
type Candidate = Box<dyn Fn() -> Result<Option<String>, StorageError>>;

/// The manifest: that of the directory, of the newest journal that has a whole one, or of the first part. `None` when
/// there is none, and nothing is damaged.
fn manifest(directory: &Path) -> Result<Option<Manifest>, StorageError> {
    let parse = |text: &str| {
        Manifest::parse(text).map_err(|source| StorageError::Schema { source, path: directory.to_owned() })
    };
    let mut candidates: Vec<Candidate> = Vec::new();
    let (own, part) = (directory.join(MANIFEST_FILE), directory.join(part_name(0)));
    if own.is_file() {
        candidates.push(Box::new(move || Ok(Some(io::read_text(&own, MANIFEST_LIMIT)?))));
    }
    for journal in journals(directory)? {
        candidates.push(Box::new(move || {
            let opened = JournalReader::open(&journal)?; // none: it was begun when the kill came
            Ok(opened.map(|(reader, _)| reader.schema().metadata().get(MANIFEST_KEY).cloned().unwrap_or_default()))
        }));
    }
    if part.is_file() {
        candidates.push(Box::new(move || {
            let metadata = footer(&part)?;
            let text = entry(&metadata, PART_KEY).or_else(|| entry(&metadata, MANIFEST_KEY));
            Ok(Some(text.unwrap_or_default().to_owned()))
        }));
    }
    let mut fault = None;
    for text in candidates {
        match text().and_then(|text| text.map(|text| parse(&text)).transpose()) {
            Ok(None) => {}
            Ok(manifest) => return Ok(manifest),
            Err(error @ StorageError::Schema { source: SchemaError::Version { .. }, .. }) => return Err(error),
            Err(error) => fault = Some(error),
        }
    }
    fault.map_or(Ok(None), Err)
}

/// How much of a journal is searched for digests: its manifest stands at the beginning.
const NOTED_LIMIT: u64 = 16 << 20;

/// Everything in the journals and the manifest that has the form of a digest, damaged or not.
fn noted(directory: &Path) -> Result<BTreeSet<String>, StorageError> {
    let mut found = BTreeSet::new();
    let own = directory.join(MANIFEST_FILE);
    for path in journals(directory)?.into_iter().chain(own.is_file().then_some(own)) {
        let file = File::open(&path).map_err(IoError::os("open", &path))?;
        let mut bytes = Vec::new();
        file.take(NOTED_LIMIT).read_to_end(&mut bytes).map_err(IoError::os("read", &path))?;
        let words = bytes.split(|byte| !byte.is_ascii_hexdigit()).filter(|word| word.len() == 64);
        found.extend(words.map(|word| String::from_utf8_lossy(word).into_owned()));
    }
    Ok(found)
}

/// The journals that are there, newest first.
fn journals(directory: &Path) -> Result<Vec<PathBuf>, StorageError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(IoError::os("list", directory))? {
        let path = entry.map_err(IoError::os("list", directory))?.path();
        if path.extension().is_some_and(|ending| ending == "arrows") {
            found.push(path);
        }
    }
    found.sort();
    found.reverse();
    Ok(found)
}
