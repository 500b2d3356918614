//! Everything that is wrong with a damaged directory or file, part by part.

use std::path::Path;

use super::decoder::Decoder;
use super::source::check_file;
use super::{MANIFEST_FILE, MANIFEST_KEY, PART_KEY, entry, footer};
use crate::io::{self, IoError};
use crate::schema::{Layout, Manifest, Part};
use crate::storage::tally::check;
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
        let Some((manifest, digest)) = single(path, findings)? else { return Ok(()) };
        let layout = manifest.layout();
        let sound = digest || content(path, &layout, 0) == Some((manifest.episodes, manifest.content.clone()));
        decode(path, &layout, 0, sound, &mut total, findings);
        manifest
    };
    if findings.is_clean()
        && let Err(error) = total.compare(&manifest, path)
    {
        findings.error("counters", "manifest", &error);
    }
    Ok(())
}

/// The manifest of one file, and whether its digest is right.
fn single(path: &Path, findings: &mut Findings<'_>) -> Result<Option<(Manifest, bool)>, StorageError> {
    let digest = check_file(path);
    let right = digest.is_ok();
    match digest {
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
    Ok(findings.manifest(MANIFEST_KEY, entry(&metadata, MANIFEST_KEY)).map(|manifest| (manifest, right)))
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
        let (path, layout) = (directory.join(&part.file), manifest.layout());
        let sound = check_part(&path, part, &layout, findings);
        let (mut tally, before) = (total.clone(), findings.len());
        if path.is_file() {
            decode(&path, &layout, from, sound, &mut tally, findings);
        }
        if sound && findings.trusted().is_none() {
            // the manifest beside it is damaged, but the part has a copy
            let copy = footer(&path).ok().and_then(|metadata| Manifest::parse(entry(&metadata, PART_KEY)?).ok());
            if let Some(copy) = copy {
                findings.trust(&copy);
            }
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

/// Presence, length and digest of a part; whether its episodes can be trusted.
fn check_part(path: &Path, part: &Part, layout: &Layout, findings: &mut Findings<'_>) -> bool {
    let ([from, to], place) = (part.episodes, &part.file[..]);
    let episodes = format!("episodes {from} to {}", to.saturating_sub(1));
    match io::sha256_file(path) {
        Err(IoError::Missing(_)) => findings.lost("parts", place, format!("it is missing, and with it {episodes}")),
        Err(error) => findings.wrong("parts", place, error.to_string()),
        Ok((_, bytes)) if bytes < part.bytes => {
            findings.lost("length", place, format!("cut short, {bytes} of {} bytes ({episodes})", part.bytes));
        }
        Ok((sha256, _)) if sha256 != part.sha256 => {
            let sound = content(path, layout, from) == to.checked_sub(from).map(|count| (count, part.content.clone()));
            let what = if sound { "but still have" } else { "and do not have" };
            let message = format!("its bytes changed since it was written; {episodes} are in it, {what} their digest");
            findings.wrong("digest", place, message);
            return sound;
        }
        Ok(_) => return true,
    }
    false
}

/// How many episodes a file holds, and the digest of their content, if all can be read.
fn content(path: &Path, layout: &Layout, first: u64) -> Option<(u64, String)> {
    let (mut decoder, mut tally) = (Decoder::open(path, layout).ok()?, Tally::default());
    while let Some(episode) = decoder.next_episode(first + tally.episodes).ok()? {
        tally.add(&episode, &check(layout, &episode, first + tally.episodes).ok()?);
    }
    Some((tally.episodes, tally.content()))
}

/// Decodes the episodes of a file from number `expected` on; a bad one is reported, and the next one read. Episodes are
/// counted as sound only where a digest vouches for them.
fn decode(
    path: &Path,
    layout: &Layout,
    mut expected: u64,
    sound: bool,
    total: &mut Tally,
    findings: &mut Findings<'_>,
) {
    let place = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut decoder = match Decoder::open(path, layout) {
        Ok(decoder) => decoder,
        Err(error) => return findings.error("columns", &place, &error),
    };
    loop {
        match decoder.next_episode(expected) {
            Ok(None) => return,
            Ok(Some(episode)) => {
                match check(layout, &episode, expected) {
                    Ok(hash) => {
                        total.add(&episode, &hash);
                        if sound {
                            findings.episode(&episode);
                        }
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
