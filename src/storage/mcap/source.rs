//! Reading: first all checksums and the manifest, then the episodes, chunk by chunk.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError, parse_record};
use prost::Message as _;

use super::{EPISODE_TOPIC, JSON_KEY, MANIFEST_RECORD, STEP_TOPIC, proto};
use crate::io::IoError;
use crate::schema::{Episode, Layout, Manifest};
use crate::storage::{EpisodeSource, StorageError, Tally};

/// Longest record that is read, bytes. With no limit one flipped bit can ask for any amount of memory.
const RECORD_LIMIT: usize = 64 << 20;

/// Records of a file, one after the other.
struct Records {
    file: File,
    path: PathBuf,
    reader: LinearReader,
}

/// Why the records ended.
enum Stop {
    /// The file ends within a record.
    Short,
    /// Anything else.
    Error(StorageError),
}

impl Records {
    fn open(path: &Path, options: LinearReaderOptions) -> Result<Self, StorageError> {
        let file = File::open(path).map_err(IoError::os("open", path))?;
        let options = options.with_record_length_limit(RECORD_LIMIT);
        Ok(Self { file, path: path.to_owned(), reader: LinearReader::new_with_options(options) })
    }

    /// Calls `take` with records (opcode, body) until it returns true; false at the end of the file.
    fn each(&mut self, mut take: impl FnMut(u8, &[u8]) -> Result<bool, String>) -> Result<bool, Stop> {
        let damaged = |message: String| Stop::Error(StorageError::Damaged { message, path: self.path.clone() });
        while let Some(event) = self.reader.next_event() {
            match event {
                Ok(LinearReadEvent::ReadRequest(need)) => {
                    let slot = self.reader.insert(need.clamp(1 << 16, 1 << 20));
                    let read = self.file.read(slot).map_err(IoError::os("read", &self.path));
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

/// The channels of a file that matter here, by id.
#[derive(Default)]
struct Channels {
    step: Vec<u16>,
    episode: Vec<u16>,
}

impl Channels {
    fn add(&mut self, body: &[u8]) -> Result<(), String> {
        if let Record::Channel(channel) = parse_record(op::CHANNEL, body).map_err(|e| e.to_string())? {
            let list = match channel.topic.as_str() {
                STEP_TOPIC => &mut self.step,
                EPISODE_TOPIC => &mut self.episode,
                _ => return Ok(()),
            };
            if channel.message_encoding != "protobuf" {
                return Err(format!("topic {}: expected protobuf, found {}", channel.topic, channel.message_encoding));
            }
            if !list.contains(&channel.id) {
                list.push(channel.id);
            }
        }
        Ok(())
    }
}

/// A store open for reading.
pub(super) struct McapSource {
    path: PathBuf,
    manifest: Manifest,
    layout: Layout,
    records: Option<Records>,
    channels: Channels,
    /// Bytes that an encoded row has at most.
    row_limit: usize,
    total: Tally,
}

impl McapSource {
    /// Checks the checksums of the file and its manifest.
    pub(super) fn open(path: &Path) -> Result<Self, StorageError> {
        let not = |message: &str| StorageError::NotAStore { message: message.to_owned(), path: path.to_owned() };
        let mut magic = [0; 8];
        let mut file = File::open(path).map_err(IoError::os("open", path))?;
        if file.read_exact(&mut magic).is_err() || magic != *MAGIC {
            return Err(not("it does not begin as an MCAP file"));
        }
        let text = match scan(path) {
            Ok(text) => text.ok_or_else(|| not("an MCAP file without a metadata record ccmarl.manifest"))?,
            Err(Stop::Short) => {
                return Err(StorageError::Truncated { episodes: count_episodes(path)?, path: path.to_owned() });
            }
            Err(Stop::Error(error)) => return Err(error),
        };
        let schema = |source| StorageError::Schema { source, path: path.to_owned() };
        let manifest = Manifest::parse(&text).map_err(schema)?;
        let layout = manifest.layout();
        let n = layout.communicators().len();
        let agents: usize =
            layout.agents.iter().map(|a| 4 * (a.observation + a.message + a.action) + a.name.len() + 64).sum();
        let row_limit = 128 + 8 * layout.state_fields.len() + n * n + agents;
        let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true);
        let records = Some(Records::open(path, options)?);
        let (channels, total) = (Channels::default(), Tally::default());
        Ok(Self { path: path.to_owned(), manifest, layout, records, channels, row_limit, total })
    }
}

impl EpisodeSource for McapSource {
    fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        let Some(records) = &mut self.records else { return Ok(None) };
        let (layout, channels, limit) = (&self.layout, &mut self.channels, self.row_limit);
        let index = self.total.episodes;
        let mut episode = Episode::with_capacity(layout, index, 0);
        let (mut rows, mut end) = (0_usize, None);
        let found = records.each(|opcode, body| {
            match opcode {
                op::CHANNEL => channels.add(body)?,
                op::MESSAGE => {
                    let record = parse_record(opcode, body).map_err(|e| e.to_string())?;
                    let Record::Message { header, data } = record else { return Ok(false) };
                    if channels.step.contains(&header.channel_id) {
                        if data.len() > limit {
                            return Err(format!("a row of {} bytes is over the manifest's {limit}", data.len()));
                        }
                        let row = proto::Step::decode(&*data).map_err(|e| format!("{STEP_TOPIC}: {e}"))?;
                        add(layout, &mut episode, &mut rows, row)?;
                    } else if channels.episode.contains(&header.channel_id) {
                        end = Some(proto::Episode::decode(&*data).map_err(|e| format!("{EPISODE_TOPIC}: {e}"))?);
                    }
                }
                _ => {}
            }
            Ok(end.is_some())
        });
        let damaged = |message: String| StorageError::Damaged { message, path: self.path.clone() };
        match found {
            Ok(true) => {}
            Ok(false) if rows == 0 => {
                self.records = None;
                self.total.compare(&self.manifest, &self.path)?;
                return Ok(None);
            }
            Ok(false) => return Err(damaged(format!("episode {index} has {rows} rows and no end"))),
            Err(Stop::Short) => return Err(StorageError::Truncated { episodes: index, path: self.path.clone() }),
            Err(Stop::Error(error)) => return Err(error),
        }
        let end = end.unwrap_or_default();
        episode.steps = rows.saturating_sub(1);
        if end.index != index || end.steps.checked_add(1) != Some(rows as u64) || end.terminal != episode.terminal {
            let message =
                format!("episode {index} of {rows} rows: its end says episode {} of {} steps", end.index, end.steps);
            return Err(damaged(message));
        }
        let hash = self.total.check(&self.layout, &episode);
        let hash = hash.map_err(|source| StorageError::Schema { source, path: self.path.clone() })?;
        if end.content_hash != hash {
            return Err(damaged(format!("episode {index} does not have the content hash at its end")));
        }
        self.total.add(&episode, &hash);
        Ok(Some(episode))
    }
}

/// Appends a row to an episode, after checking it against the layout.
fn add(layout: &Layout, e: &mut Episode, rows: &mut usize, row: proto::Step) -> Result<(), String> {
    let r = *rows;
    if row.episode != e.index || u64::from(row.step) != r as u64 {
        let (episode, step) = (row.episode, row.step);
        return Err(format!("expected episode {} step {r}, found episode {episode} step {step}", e.index));
    }
    let place = || format!("episode {} step {r}", e.index);
    if row.is_first != (r == 0) || (row.is_terminal && !row.is_last) {
        return Err(format!("{}: is_first, is_last, is_terminal do not fit", place()));
    }
    if row.reward.is_some() == row.is_last || row.agents.len() != layout.agents.len() {
        return Err(format!("{}: rewards or agents do not fit", place()));
    }
    for (spec, agent) in layout.agents.iter().zip(&row.agents) {
        let acts = if row.is_last { 0 } else { spec.action };
        let widths = [
            (agent.observation.len(), spec.observation),
            (agent.message.len(), spec.message),
            (agent.action.len(), acts),
        ];
        if agent.name != spec.name || widths.iter().any(|(a, b)| a != b) || agent.reward.is_some() == row.is_last {
            return Err(format!("{}: agent {:?} does not fit the manifest's {:?}", place(), agent.name, spec.name));
        }
    }
    let n = layout.communicators().len();
    if row.state.len() != layout.state_fields.len() || row.link.len() != n * n {
        return Err(format!("{}: state or link has the wrong length", place()));
    }
    e.state.extend(row.state);
    e.link.extend(row.link);
    e.reward.extend(row.reward);
    for (i, agent) in row.agents.into_iter().enumerate() {
        e.observations[i].data.extend(agent.observation);
        e.messages[i].data.extend(agent.message);
        e.actions[i].data.extend(agent.action);
        e.rewards[i].extend(agent.reward);
    }
    e.terminal = row.is_terminal;
    *rows += 1;
    Ok(())
}

/// Reads a file from end to end without decoding its chunks: checks the checksums of the data section and of the
/// summary, and returns the manifest.
fn scan(path: &Path) -> Result<Option<String>, Stop> {
    let options = LinearReaderOptions::default()
        .with_emit_chunks(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true)
        .with_check_finishes_after_end_magic(true);
    let mut manifest = None;
    let mut records = Records::open(path, options).map_err(Stop::Error)?;
    records.each(|opcode, body| {
        match opcode {
            op::METADATA | op::DATA_END | op::FOOTER => match parse_record(opcode, body).map_err(|e| e.to_string())? {
                Record::Metadata(mut m) if m.name == MANIFEST_RECORD => manifest = m.metadata.remove(JSON_KEY),
                Record::DataEnd(end) if end.data_section_crc == 0 => return Err("no checksum of the data".to_owned()),
                Record::Footer(end) if end.summary_crc == 0 => return Err("no checksum of the summary".to_owned()),
                _ => {}
            },
            _ => {}
        }
        Ok(false)
    })?;
    Ok(manifest)
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
