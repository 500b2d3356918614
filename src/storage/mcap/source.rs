//! Reading: first all checksums and the manifest, then the episodes, chunk by chunk.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError, parse_record};

use super::assembler::{Assembler, Channels};
use super::tail::check_tail;
use super::{JSON_KEY, MANIFEST_RECORD, RECORDING_RECORD, SCENE_TOPIC};
use crate::io::IoError;
use crate::schema::{Episode, Manifest};
use crate::storage::{EpisodeSource, StorageError, Tally};

/// Longest record that is read, bytes. With no limit one flipped bit can ask for any amount of memory.
const RECORD_LIMIT: usize = 64 << 20;

/// Records of a file, or of one chunk, one after the other.
pub(super) struct Records<R> {
    input: R,
    path: PathBuf,
    reader: LinearReader,
}

/// Why the records ended.
pub(super) enum Stop {
    /// The file ends within a record.
    Short,
    /// Anything else.
    Error(StorageError),
}

impl Records<File> {
    pub(super) fn open(path: &Path, options: LinearReaderOptions) -> Result<Self, StorageError> {
        let file = File::open(path).map_err(IoError::os("open", path))?;
        Ok(Self::new(file, path, options))
    }
}

impl<R: Read> Records<R> {
    pub(super) fn new(input: R, path: &Path, options: LinearReaderOptions) -> Self {
        let options = options.with_record_length_limit(RECORD_LIMIT);
        Self { input, path: path.to_owned(), reader: LinearReader::new_with_options(options) }
    }

    /// Calls `take` with records (opcode, body) until it returns true; false at the end of the file.
    pub(super) fn each(&mut self, mut take: impl FnMut(u8, &[u8]) -> Result<bool, String>) -> Result<bool, Stop> {
        let damaged = |message: String| Stop::Error(StorageError::Damaged { message, path: self.path.clone() });
        while let Some(event) = self.reader.next_event() {
            match event {
                Ok(LinearReadEvent::ReadRequest(need)) => {
                    let slot = self.reader.insert(need.clamp(1 << 16, 1 << 20));
                    let read = self.input.read(slot).map_err(IoError::os("read", &self.path));
                    self.reader.notify_read(read.map_err(|e| Stop::Error(e.into()))?);
                }
                Ok(LinearReadEvent::Record { data, opcode }) => {
                    if take(opcode, data).map_err(damaged)? {
                        return Ok(true);
                    }
                }
                Err(McapError::UnexpectedEof) => return Err(Stop::Short),
                Err(error) => return Err(damaged(format!("{error}: copy it again"))),
            }
        }
        Ok(false)
    }
}

/// A store open for reading.
pub(super) struct McapSource {
    path: PathBuf,
    manifest: Manifest,
    records: Option<Records<File>>,
    assembler: Assembler,
    total: Tally,
    /// Whether it may end anywhere.
    leftover: bool,
}

impl McapSource {
    /// Checks the checksums of the file and its manifest.
    pub(super) fn open(path: &Path) -> Result<Self, StorageError> {
        check_magic(path)?;
        let options = LinearReaderOptions::default()
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true);
        let found = match scan(path, options, &mut |_, _, _| {}) {
            Ok(found) => found,
            Err(Stop::Short) => {
                return Err(StorageError::Truncated { episodes: count_episodes(path)?, path: path.to_owned() });
            }
            Err(Stop::Error(error)) => return Err(error),
        };
        let Some(text) = found.manifest else {
            let message = format!("an MCAP file without a metadata record {MANIFEST_RECORD}");
            return Err(StorageError::NotAStore { message, path: path.to_owned() });
        };
        let schema = |source| StorageError::Schema { source, path: path.to_owned() };
        let manifest = Manifest::parse(&text).map_err(schema)?;
        Self::start(path, manifest, LinearReaderOptions::default(), false)
    }

    /// What a kill left, or a file that was cut short: its whole episodes, then an error that says what is wrong. The
    /// manifest is the one from before the recording.
    pub(super) fn salvage(path: &Path) -> Result<Self, StorageError> {
        check_magic(path)?;
        let options = LinearReaderOptions::default().with_skip_end_magic(true);
        let mut text = None;
        let found = Records::open(path, options)?.each(|opcode, body| {
            text = metadata(opcode, body, RECORDING_RECORD)?;
            Ok(text.is_some())
        });
        let schema = |source| StorageError::Schema { source, path: path.to_owned() };
        match (text, found) {
            (Some(text), _) => {
                let manifest = Manifest::parse(&text).map_err(schema)?.unsealed();
                Self::start(path, manifest, LinearReaderOptions::default().with_skip_end_magic(true), true)
            }
            (None, Err(Stop::Error(error))) => Err(error),
            (None, _) => Err(StorageError::Empty { path: path.to_owned() }),
        }
    }

    fn start(
        path: &Path,
        manifest: Manifest,
        options: LinearReaderOptions,
        leftover: bool,
    ) -> Result<Self, StorageError> {
        let records = Records::open(path, options.with_prevalidate_chunk_crcs(true))?;
        let assembler = Assembler::new(manifest.layout());
        Ok(Self {
            path: path.to_owned(),
            manifest,
            records: Some(records),
            assembler,
            total: Tally::default(),
            leftover,
        })
    }
}

impl EpisodeSource for McapSource {
    fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        let Some(records) = &mut self.records else { return Ok(None) };
        let (assembler, mut found) = (&mut self.assembler, None);
        let read = records.each(|opcode, body| {
            found = assembler.take(opcode, body)?;
            Ok(found.is_some())
        });
        let (rows, index) = (assembler.rows(), self.total.episodes);
        match read {
            Err(Stop::Short) => {
                if self.leftover {
                    check_tail(&self.path)?;
                }
                return Err(StorageError::Truncated { episodes: index, path: self.path.clone() });
            }
            Err(Stop::Error(error)) => return Err(error),
            Ok(_) => {}
        }
        if let Some((episode, hash)) = found {
            self.total.add(&episode, &hash);
            return Ok(Some(episode));
        }
        self.records = None;
        if self.leftover {
            check_tail(&self.path)?;
        }
        if rows > 0 {
            let message = format!("episode {index} has {rows} rows and no end");
            return Err(StorageError::Damaged { message, path: self.path.clone() });
        }
        if !self.manifest.content.is_empty() {
            self.total.compare(&self.manifest, &self.path)?;
        }
        Ok(None)
    }
}

/// Refuses what does not begin as an MCAP file.
fn check_magic(path: &Path) -> Result<(), StorageError> {
    let mut magic = Vec::new();
    let file = File::open(path).map_err(IoError::os("open", path))?;
    file.take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(IoError::os("read", path))?;
    if !MAGIC.starts_with(&magic) {
        let message = "it does not begin as an MCAP file".to_owned();
        return Err(StorageError::NotAStore { message, path: path.to_owned() });
    }
    Ok(())
}

/// The JSON text of the metadata record of this name, if this is it.
pub(super) fn metadata(opcode: u8, body: &[u8], name: &str) -> Result<Option<String>, String> {
    if opcode != op::METADATA {
        return Ok(None);
    }
    match parse_record(opcode, body).map_err(|e| e.to_string())? {
        Record::Metadata(mut m) if m.name == name => Ok(m.metadata.remove(JSON_KEY)),
        _ => Ok(None),
    }
}

/// The manifests of a file.
#[derive(Default)]
pub(super) struct Manifests {
    /// As it was before the recording.
    pub(super) recording: Option<String>,
    /// Sealed.
    pub(super) manifest: Option<String>,
}

/// Reads a file from end to end without decoding its chunks, checks what `options` ask for, and returns the manifests.
/// `see` is told of every record: where it begins, its opcode and its body.
pub(super) fn scan(
    path: &Path,
    options: LinearReaderOptions,
    see: &mut dyn FnMut(u64, u8, &[u8]),
) -> Result<Manifests, Stop> {
    let mut found = Manifests::default();
    let mut at = MAGIC.len() as u64;
    let mut records = Records::open(path, options.with_emit_chunks(true)).map_err(Stop::Error)?;
    records.each(|opcode, body| {
        see(at, opcode, body);
        at += 9 + body.len() as u64; // opcode and length
        match opcode {
            op::METADATA => {
                found.recording = metadata(opcode, body, RECORDING_RECORD)?.or(found.recording.take());
                found.manifest = metadata(opcode, body, MANIFEST_RECORD)?.or(found.manifest.take());
            }
            op::DATA_END | op::FOOTER => match parse_record(opcode, body).map_err(|e| e.to_string())? {
                Record::DataEnd(end) if end.data_section_crc == 0 => return Err("no checksum of the data".to_owned()),
                Record::Footer(end) if end.summary_crc == 0 => return Err("no checksum of the summary".to_owned()),
                _ => {}
            },
            _ => {}
        }
        Ok(false)
    })?;
    Ok(found)
}

/// Whether a file draws its episodes: its channels stand before the end of the first one. What cannot be read may.
pub(super) fn draws(path: &Path) -> bool {
    let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true).with_skip_end_magic(true);
    let (mut channels, mut found) = (Channels::default(), false);
    let read = Records::open(path, options).map(|mut records| {
        records.each(|opcode, body| {
            match parse_record(opcode, body) {
                Ok(Record::Channel(channel)) => {
                    found |= channel.topic == SCENE_TOPIC;
                    channels.add(body)?;
                }
                Ok(Record::Message { header, .. }) if channels.episode.contains(&header.channel_id) => return Ok(true),
                _ => {}
            }
            Ok(found)
        })
    });
    found || !matches!(read, Ok(Ok(_)))
}

/// Whole episodes of a file that was cut short.
fn count_episodes(path: &Path) -> Result<u64, StorageError> {
    let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true).with_skip_end_magic(true);
    let (mut channels, mut episodes) = (Channels::default(), 0);
    let counted = Records::open(path, options)?.each(|opcode, body| {
        if opcode == op::CHANNEL {
            channels.add(body)?;
        } else if opcode == op::MESSAGE
            && let Ok(Record::Message { header, .. }) = parse_record(opcode, body)
        {
            episodes += u64::from(channels.episode.contains(&header.channel_id));
        }
        Ok(false)
    });
    match counted {
        Ok(_) | Err(Stop::Short) => Ok(episodes),
        Err(Stop::Error(error)) => Err(error),
    }
}
