//! Everything that is wrong with a damaged directory or file, part by part.

use std::path::Path;

use super::decoder::Decoder;
use super::source::check_file;
use super::{MANIFEST_FILE, MANIFEST_KEY, entry, footer};
use crate::io::{self, IoError};
use crate::schema::{Layout, Manifest, Part};
use crate::storage::verify::Findings;
use crate::storage::{MANIFEST_LIMIT, StorageError, Tally};

/// Reports the manifest, each part and each episode that does not hold.
pub(super) fn diagnose(path: &Path, findings: &mut Findings<'_>) -> Result<(), StorageError> {
    let mut total = Tally::default();
    let manifest = if path.is_dir() {
        let text = io::read_text(&path.join(MANIFEST_FILE), MANIFEST_LIMIT);
        if let Err(error) = &text {
            findings.wrong("manifest", MANIFEST_FILE, error.to_string());
        }
        let Some(manifest) = findings.manifest(MANIFEST_FILE, text.ok().as_deref()) else { return Ok(()) };
        parts(path, &manifest, &mut total, findings);
        manifest
    } else {
        let Some(manifest) = single(path, findings)? else { return Ok(()) };
        decode(path, &manifest.layout(), 0, &mut total, findings);
        manifest
    };
    if findings.is_clean()
        && let Err(error) = total.compare(&manifest, path)
    {
        findings.error("counters", "manifest", &error);
    }
    Ok(())
}

/// The digest and the manifest of one file.
fn single(path: &Path, findings: &mut Findings<'_>) -> Result<Option<Manifest>, StorageError> {
    match check_file(path) {
        Ok(()) => {}
        Err(StorageError::Truncated { .. }) => {
            findings.lost("length", "file", "it is cut short: the footer, and with it all rows, is gone".to_owned());
            return Ok(None);
        }
        Err(error @ StorageError::NotAStore { .. }) => return Err(error),
        Err(error) => findings.error("digest", "file", &error),
    }
    let metadata = match footer(path) {
        Ok(metadata) => metadata,
        Err(error @ StorageError::Io(_)) => return Err(error),
        Err(error) => {
            findings.error("footer", "file", &error);
            return Ok(None);
        }
    };
    Ok(findings.manifest(MANIFEST_KEY, entry(&metadata, MANIFEST_KEY)))
}

fn parts(directory: &Path, manifest: &Manifest, total: &mut Tally, findings: &mut Findings<'_>) {
    let mut next = 0;
    for part in &manifest.parts {
        let [from, to] = part.episodes;
        if from != next || to <= from {
            let message = format!("expected episodes from {next} on, found {from} to {to}");
            findings.wrong("manifest", &part.file, message);
        }
        next = to;
        check_part(directory, part, findings);
        let path = directory.join(&part.file);
        let (mut tally, before) = (total.clone(), findings.len());
        if path.is_file() {
            decode(&path, &manifest.layout(), from, &mut tally, findings);
        }
        let count = tally.episodes - total.episodes;
        if before == findings.len() && path.is_file() && Some(count) != to.checked_sub(from) {
            findings.wrong("counters", &part.file, format!("the manifest says episodes {from} to {to}, found {count}"));
        }
        *total = tally;
    }
    if next != manifest.episodes {
        let message = format!("the parts hold {next} episodes, the manifest says {}", manifest.episodes);
        findings.wrong("manifest", MANIFEST_FILE, message);
    }
}

/// Presence, length and digest of a part.
fn check_part(directory: &Path, part: &Part, findings: &mut Findings<'_>) {
    let ([from, to], place) = (part.episodes, &part.file[..]);
    let episodes = format!("episodes {from} to {}", to.saturating_sub(1));
    let path = directory.join(&part.file);
    match io::sha256_file(&path) {
        Err(IoError::Missing(_)) => findings.lost("parts", place, format!("it is missing, and with it {episodes}")),
        Err(error) => findings.wrong("parts", place, error.to_string()),
        Ok((_, bytes)) if bytes < part.bytes => {
            findings.lost("length", place, format!("cut short, {bytes} of {} bytes ({episodes})", part.bytes));
        }
        Ok((sha256, _)) if sha256 != part.sha256 => {
            findings.wrong("digest", place, format!("its bytes changed since it was written ({episodes})"));
        }
        Ok(_) => {}
    }
}

/// Decodes the episodes of a file from number `expected` on; a bad one is reported, and the next one read.
fn decode(path: &Path, layout: &Layout, mut expected: u64, total: &mut Tally, findings: &mut Findings<'_>) {
    let place = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut decoder = match Decoder::open(path, layout) {
        Ok(decoder) => decoder,
        Err(error) => return findings.error("columns", &place, &error),
    };
    loop {
        match decoder.next_episode(expected) {
            Ok(None) => return,
            Ok(Some(episode)) => {
                match crate::storage::tally::check(layout, &episode, expected) {
                    Ok(hash) => {
                        total.add(&episode, &hash);
                        findings.episode(&episode);
                    }
                    Err(error) => findings.wrong("values", &place, format!("episode {expected}: {error}")),
                }
                expected += 1;
            }
            Err(error) => {
                findings.error("rows", &place, &error);
                match decoder.skip() {
                    Some(next) => expected = next,
                    None => return,
                }
            }
        }
    }
}
