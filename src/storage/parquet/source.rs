//! Opening: a directory of parts, or one file. A digest is checked before anything is decoded.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use parquet::file::metadata::ParquetMetaDataReader;
use sha2::{Digest as _, Sha256};

use super::columns::batch_rows;
use super::decoder::{Decoder, guard};
use super::pages::{PageFault, check_pages};
use super::rows::read;
use super::{FILE_SHA256_KEY, MANIFEST_FILE, MANIFEST_KEY, PART_KEY, entry, find_file_digest, footer};
use crate::io::{self, IoError};
use crate::schema::{Episode, Layout, Manifest, Part, SELF_SHA256_PLACEHOLDER, SchemaError, hex};
use crate::storage::rows::by_episode;
use crate::storage::{EpisodeSource, MANIFEST_LIMIT, StorageError, Take, Tally};

/// An episode, and its content hash or what is wrong with it.
type Checked = (Episode, Result<[u8; 32], SchemaError>);
/// The digest and size of a file, in the making.
type FileDigest = JoinHandle<Result<(String, u64), IoError>>;

/// Reads some episodes ahead, so that they are checked side by side.
struct Ahead {
    decoder: Decoder,
    /// Rows that are decoded and checked ahead, unless one episode has more.
    rows: usize,
    ready: VecDeque<Checked>,
    /// What came after the episodes that are ready.
    fault: Option<StorageError>,
}

impl Ahead {
    fn open(path: &Path, layout: &Layout) -> Result<Self, StorageError> {
        let decoder = Decoder::open(path, layout)?;
        Ok(Self { decoder, rows: batch_rows(layout), ready: VecDeque::new(), fault: None })
    }

    /// The next episode of the store of which `total` was read, and its content hash; `None` at the end of the file.
    fn next(&mut self, total: &Tally, layout: &Layout) -> Result<Option<Checked>, StorageError> {
        if self.ready.is_empty() && self.fault.is_none() {
            let (mut episodes, mut rows) = (Vec::new(), 0);
            while rows < self.rows && self.fault.is_none() {
                match self.decoder.next_episode(total.episodes + episodes.len() as u64) {
                    Ok(Some(episode)) => {
                        rows += episode.rows();
                        episodes.push(episode);
                    }
                    Ok(None) => break,
                    Err(fault) => self.fault = Some(fault),
                }
            }
            let hashes = total.check_each(layout, &episodes);
            self.ready = episodes.into_iter().zip(hashes).collect();
        }
        match (self.ready.pop_front(), &self.fault) {
            (None, Some(_)) => self.fault.take().map_or(Ok(None), Err),
            (ready, _) => Ok(ready),
        }
    }
}

/// A directory of parts.
pub(super) struct Parts {
    directory: PathBuf,
    manifest: Manifest,
    layout: Layout,
    next_part: usize,
    /// The open part, and what was read of it.
    current: Option<(Ahead, Tally)>,
    /// The digest of a part to come, in the making, and that part's number.
    digest: Option<(usize, FileDigest)>,
    total: Tally,
}

impl Parts {
    /// Reads the manifest and checks that the parts follow each other and are there.
    pub(super) fn open(directory: &Path) -> Result<Self, StorageError> {
        let path = directory.join(MANIFEST_FILE);
        if !path.exists() {
            let message =
                format!("the directory has no {MANIFEST_FILE}: give a directory that `ccmarl record` finished");
            return Err(StorageError::NotAStore { message, path: directory.to_owned() });
        }
        let text = io::read_text(&path, MANIFEST_LIMIT)?;
        let manifest = parse(&text, &path)?;
        let mut next = 0;
        for part in &manifest.parts {
            let [from, to] = part.episodes;
            if from != next || to <= from {
                let message = format!("{}: expected episodes from {next} on, found {from} to {to}", part.file);
                return Err(StorageError::Damaged { message, path });
            }
            next = to;
            let file = directory.join(&part.file);
            if !file.is_file() {
                let message =
                    format!("part {} of episodes {from} to {} is missing: copy the store again", part.file, to - 1);
                return Err(StorageError::Damaged { message, path: directory.to_owned() });
            }
        }
        if next != manifest.episodes {
            let message = format!("the parts hold {next} episodes, the manifest says {}", manifest.episodes);
            return Err(StorageError::Damaged { message, path });
        }
        let layout = manifest.layout();
        Ok(Self {
            directory: directory.to_owned(),
            manifest,
            layout,
            next_part: 0,
            current: None,
            digest: None,
            total: Tally::default(),
        })
    }

    /// Checks the digest of the next part, while that of the one after is begun; `None` when there is none.
    fn next_part(&mut self) -> Result<Option<PathBuf>, StorageError> {
        let Some(part) = self.manifest.parts.get(self.next_part) else {
            return Ok(None);
        };
        let path = self.directory.join(&part.file);
        let begun = self.digest.take().filter(|(number, _)| *number == self.next_part);
        check_part(&path, part, || {
            let made = begun.and_then(|(_, thread)| thread.join().ok());
            made.unwrap_or_else(|| io::sha256_file(&path))
        })?;
        self.next_part += 1;
        self.digest = self.manifest.parts.get(self.next_part).map(|next| {
            let path = self.directory.join(&next.file);
            (self.next_part, std::thread::spawn(move || io::sha256_file(&path)))
        });
        Ok(Some(path))
    }

    /// Opens the next part; false when there is none.
    fn open_part(&mut self) -> Result<bool, StorageError> {
        let Some(path) = self.next_part()? else { return Ok(false) };
        self.current = Some((Ahead::open(&path, &self.layout)?, Tally::default()));
        Ok(true)
    }
}

impl EpisodeSource for Parts {
    fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    fn read_rows(&mut self, agents: &[usize], take: &mut Take<'_>) -> Result<(), StorageError> {
        if self.current.is_some() {
            return by_episode(self, agents, take); // the part at hand has been begun by episodes
        }
        while let Some(path) = self.next_part()? {
            let [from, to] = self.manifest.parts[self.next_part - 1].episodes;
            if read(&path, &self.layout, agents, &mut self.total, take)?.is_break() {
                return Ok(());
            }
            if self.total.episodes != to {
                let found = self.total.episodes.saturating_sub(from);
                let message = format!("expected {} episodes, found {found}", to - from);
                return Err(StorageError::Damaged { message, path });
            }
        }
        self.total.compare(&self.manifest, &self.directory)
    }

    fn skip_to(&mut self, episode: u64) -> Result<(), StorageError> {
        while let Some(part) = self.manifest.parts.get(self.next_part)
            && self.current.is_none()
            && part.episodes[1] <= episode
        {
            self.total.skip_to(part.episodes[1]);
            self.next_part += 1;
        }
        while self.total.episodes < episode && self.next_episode()?.is_some() {}
        Ok(())
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        loop {
            let Some((decoder, tally)) = &mut self.current else {
                if self.open_part()? {
                    continue;
                }
                self.total.compare(&self.manifest, &self.directory)?;
                return Ok(None);
            };
            let part = &self.manifest.parts[self.next_part - 1];
            let path = self.directory.join(&part.file);
            if let Some((episode, hash)) = decoder.next(&self.total, &self.layout)? {
                let hash = hash.map_err(|source| StorageError::Schema { source, path })?;
                tally.add(&episode, &hash);
                self.total.add(&episode, &hash);
                return Ok(Some(episode));
            }
            let [from, to] = part.episodes;
            if tally.episodes != to - from || tally.content() != part.content {
                let message = format!("expected the {} episodes of the manifest's digest, found others", to - from);
                return Err(StorageError::Damaged { message, path });
            }
            self.current = None;
        }
    }
}

/// One file.
pub(super) struct Single {
    path: PathBuf,
    manifest: Manifest,
    layout: Layout,
    decoder: Option<Ahead>,
    total: Tally,
}

impl Single {
    /// Checks the digest of the whole file, then reads its manifest.
    pub(super) fn open(path: &Path) -> Result<Self, StorageError> {
        check_file(path)?;
        let damaged = |message: String| StorageError::Damaged { message, path: path.to_owned() };
        let metadata = footer(path)?;
        let text = entry(&metadata, MANIFEST_KEY);
        let manifest = parse(text.ok_or_else(|| damaged(format!("it has no {MANIFEST_KEY}")))?, path)?;
        let layout = manifest.layout();
        let rows = u64::try_from(metadata.file_metadata().num_rows()).unwrap_or(0);
        if manifest.steps.checked_add(manifest.episodes) != Some(rows) {
            let (episodes, steps) = (manifest.episodes, manifest.steps);
            return Err(damaged(format!("{episodes} episodes of {steps} steps do not give its {rows} rows")));
        }
        let decoder = Some(Ahead::open(path, &layout)?);
        Ok(Self { path: path.to_owned(), manifest, layout, decoder, total: Tally::default() })
    }
}

impl EpisodeSource for Single {
    fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    fn read_rows(&mut self, agents: &[usize], take: &mut Take<'_>) -> Result<(), StorageError> {
        if self.total.episodes > 0 {
            return by_episode(self, agents, take);
        }
        self.decoder = None;
        if read(&self.path, &self.layout, agents, &mut self.total, take)?.is_break() {
            return Ok(());
        }
        self.total.compare(&self.manifest, &self.path)
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        let Some(decoder) = &mut self.decoder else { return Ok(None) };
        if let Some((episode, hash)) = decoder.next(&self.total, &self.layout)? {
            let hash = hash.map_err(|source| StorageError::Schema { source, path: self.path.clone() })?;
            self.total.add(&episode, &hash);
            return Ok(Some(episode));
        }
        self.decoder = None;
        self.total.compare(&self.manifest, &self.path)?;
        Ok(None)
    }
}

fn parse(text: &str, path: &Path) -> Result<Manifest, StorageError> {
    Manifest::parse(text).map_err(|source| StorageError::Schema { source, path: path.to_owned() })
}

/// Checks a single file against the digest that it carries; says what it is when it carries none.
pub(super) fn check_file(path: &Path) -> Result<(), StorageError> {
    let os = |action| IoError::os(action, path);
    let not = |message: &str| Err(StorageError::NotAStore { message: message.to_owned(), path: path.to_owned() });
    let mut file = File::open(path).map_err(os("open"))?;
    let size = file.metadata().map_err(os("read"))?.len();
    let mut magic = [0; 4];
    if size < 12 || file.read_exact(&mut magic).is_err() || magic != *b"PAR1" {
        return not("it does not begin as a Parquet file");
    }
    file.seek(SeekFrom::End(-8)).map_err(os("read"))?;
    let mut end = [0; 8];
    file.read_exact(&mut end).map_err(os("read"))?;
    if end[4..] != *b"PAR1" {
        return Err(StorageError::Truncated { episodes: 0, path: path.to_owned() });
    }
    let footer = u64::from(u32::from_le_bytes([end[0], end[1], end[2], end[3]])).min(size - 8);
    // The entry stands near the footer's end, so one mebibyte is enough however long a footer claims to be.
    let tail = (footer + 8).min(1 << 20);
    file.seek(SeekFrom::Start(size - tail)).map_err(os("read"))?;
    let mut text = Vec::new();
    (&file).take(tail).read_to_end(&mut text).map_err(os("read"))?;
    let Some(at) = find_file_digest(&text) else {
        let part = text.windows(PART_KEY.len()).any(|w| w == PART_KEY.as_bytes());
        return not(if part {
            "it is one part of a directory store: give the directory"
        } else {
            "a Parquet file without ccmarl's manifest; for a table use `ccmarl estimate-mi FILE --x … --y …`"
        });
    };
    let digits = size - tail + at as u64;
    let (mut hash, mut block, mut position) = (Sha256::new(), vec![0; 1 << 18], 0_u64);
    file.seek(SeekFrom::Start(0)).map_err(os("read"))?;
    loop {
        let n = file.read(&mut block).map_err(os("read"))?;
        if n == 0 {
            break;
        }
        for (i, byte) in SELF_SHA256_PLACEHOLDER.bytes().enumerate() {
            let offset = (digits + i as u64).wrapping_sub(position);
            if offset < n as u64 {
                block[offset as usize] = byte;
            }
        }
        hash.update(&block[..n]);
        position += n as u64;
    }
    if hex(&hash.finalize()).as_bytes() != &text[at..at + 64] {
        let message =
            format!("its bytes do not have the digest in its {FILE_SHA256_KEY}: they changed since it was written");
        return Err(StorageError::Damaged { message, path: path.to_owned() });
    }
    Ok(())
}

/// Largest page of anybody's table, bytes or values: writers cut them at about a mebibyte.
const TABLE_PAGE_LIMIT: u64 = 512 << 20;

/// Checks a Parquet file before somebody else's reader takes columns from it: the digest, when it is a store or a part of
/// one, and what its pages ask for. What cannot be read at all is left to that reader.
pub(in crate::storage) fn check_table(path: &Path) -> Result<(), StorageError> {
    match check_file(path) {
        Err(StorageError::NotAStore { .. } | StorageError::Truncated { .. }) => check_part_of(path)?,
        checked => checked?,
    }
    let file = File::open(path).map_err(IoError::os("open", path))?;
    let Ok(metadata) = guard(path, || ParquetMetaDataReader::new().parse_and_finish(&file)) else { return Ok(()) };
    match check_pages(&file, &metadata, TABLE_PAGE_LIMIT) {
        Err(PageFault::Greedy(message)) => Err(StorageError::Damaged { message, path: path.to_owned() }),
        Ok(()) | Err(PageFault::Unreadable(_)) => Ok(()),
    }
}

/// Checks the digest of a part in the manifest beside it, if there is one that names it.
fn check_part_of(path: &Path) -> Result<(), StorageError> {
    let manifest = path.with_file_name(MANIFEST_FILE);
    let Ok(text) = io::read_text(&manifest, MANIFEST_LIMIT) else { return Ok(()) };
    let Ok(manifest) = Manifest::parse(&text) else { return Ok(()) };
    let name = path.file_name().unwrap_or_default();
    match manifest.parts.iter().find(|part| *part.file == *name) {
        Some(part) => check_part(path, part, || io::sha256_file(path)),
        None => Ok(()),
    }
}

/// Compares a part with its length and digest in the manifest; `digest` is asked only when it is long enough.
fn check_part(
    path: &Path,
    part: &Part,
    digest: impl FnOnce() -> Result<(String, u64), IoError>,
) -> Result<(), StorageError> {
    let size = std::fs::metadata(path).map_err(IoError::os("read", path))?.len();
    let (expected, [from, to]) = (part.bytes, part.episodes);
    let damaged = |what: String| {
        let message = format!("{what} (episodes {from} to {}): copy the store again", to.saturating_sub(1));
        StorageError::Damaged { message, path: path.to_owned() }
    };
    if size < expected {
        return Err(damaged(format!("cut short, {size} of {expected} bytes")));
    }
    let (sha256, bytes) = digest()?;
    if sha256 != part.sha256 || bytes != expected {
        return Err(damaged("the bytes changed since it was written".to_owned()));
    }
    Ok(())
}
