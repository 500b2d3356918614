//! Writing: one message per row, one per episode, a chunk ended and flushed with each episode.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions, Writer};
use prost::Message;

use super::proto::{self, DESCRIPTORS, VIEWER_DESCRIPTORS};
use super::viewer::Viewer;
use super::{EPISODE_TOPIC, JSON_KEY, MANIFEST_RECORD, POSES_TOPIC, RECORDING_RECORD, SCENE_TOPIC, STEP_TOPIC};
use crate::io::IoError;
use crate::schema::{Episode, Layout, Manifest, STEP_SECS};
use crate::storage::{EpisodeSink, Options, StorageError, Tally, lock, publish, start_partial};

/// A store under construction, in the hidden sibling `.<name>.partial`.
pub(super) struct McapSink {
    path: PathBuf,
    partial: PathBuf,
    force: bool,
    manifest: Manifest,
    layout: Layout,
    writer: Writer<BufWriter<File>>,
    channels: Channels,
    /// What is drawn, unless it was not asked for, or cannot be.
    viewer: Option<Viewer>,
    /// Reused from row to row; the agents' names stay.
    row: proto::Step,
    bytes: Vec<u8>,
    total: Tally,
    finished: bool,
}

impl McapSink {
    /// Starts a store at `path`.
    pub(super) fn create(path: &Path, manifest: &Manifest, options: Options) -> Result<Self, StorageError> {
        let layout = manifest.layout();
        let schema = |source| StorageError::Schema { source, path: path.to_owned() };
        layout.check().map_err(schema)?;
        let unsealed = Manifest { parts: Vec::new(), ..manifest.clone() }.sealed_json().map_err(schema)?;
        let partial = start_partial(path, options.force)?;
        let file = File::create_new(&partial).map_err(IoError::os("create", &partial))?;
        lock::hold_file(&file, &partial)?;
        let viewer = if options.viewer { Viewer::new(manifest, &layout) } else { None };
        let (writer, channels) = start(file, unsealed, viewer.is_some()).map_err(|e| refused(e, &partial))?;
        let agents = layout.agents.iter().map(|a| proto::Agent { name: a.name.clone(), ..proto::Agent::default() });
        let row = proto::Step { agents: agents.collect(), ..proto::Step::default() };
        Ok(Self {
            path: path.to_owned(),
            partial,
            force: options.force,
            manifest: manifest.clone(),
            layout,
            writer,
            channels,
            viewer,
            row,
            bytes: Vec::new(),
            total: Tally::default(),
            finished: false,
        })
    }

    /// Fills a reused message with row `r`.
    fn fill(&self, row: &mut proto::Step, e: &Episode, r: usize) {
        fn copy<T: Copy>(out: &mut Vec<T>, values: &[T], row: usize, width: usize) {
            out.clear();
            out.extend_from_slice(&values[row * width..(row + 1) * width]);
        }
        let acted = r < e.steps;
        let n = self.layout.communicators().len();
        (row.episode, row.step) = (e.index, r as u32);
        (row.is_first, row.is_last, row.is_terminal) = (r == 0, !acted, !acted && e.terminal);
        copy(&mut row.state, &e.state, r, self.layout.state_fields.len());
        copy(&mut row.link, &e.link, r, n * n);
        row.reward = acted.then(|| e.reward[r]);
        for (i, (spec, agent)) in self.layout.agents.iter().zip(&mut row.agents).enumerate() {
            copy(&mut agent.observation, &e.observations[i].data, r, spec.observation);
            copy(&mut agent.message, &e.messages[i].data, r, spec.message);
            agent.action.clear();
            if acted {
                copy(&mut agent.action, &e.actions[i].data, r, spec.action);
            }
            agent.reward = acted.then(|| e.rewards[i][r]);
        }
    }

    /// Writes a message. `row` counts through all episodes.
    fn write(&mut self, channel_id: u16, step: usize, row: u64, message: &impl Message) -> Result<(), StorageError> {
        self.bytes.clear();
        message.encode(&mut self.bytes).map_err(|e| refused(std::io::Error::other(e).into(), &self.partial))?;
        // Nothing is delayed: a message is delivered, or lost, in the step in which it was sent.
        let (log_time, publish_time) = (time(row), time(row));
        let header = MessageHeader { channel_id, sequence: step as u32, log_time, publish_time };
        self.writer.write_to_known_channel(&header, &self.bytes).map_err(|e| refused(e, &self.partial))
    }
}

/// Nanoseconds from the start of the file to a row.
fn time(row: u64) -> u64 {
    row.saturating_mul((STEP_SECS * 1e9) as u64)
}

/// Channels of the topics.
struct Channels {
    step: u16,
    episode: u16,
    scene: u16,
    poses: u16,
}

/// Header, first metadata record, schemas, channels.
fn start(file: File, unsealed: String, viewer: bool) -> Result<(Writer<BufWriter<File>>, Channels), McapError> {
    let mut writer = WriteOptions::new()
        .library(concat!("ccmarl/", env!("CARGO_PKG_VERSION")))
        .disable_seeking(true) // a chunk appears whole, so a kill leaves no half one
        .compression_threads(0) // more threads give other bytes
        .create(BufWriter::with_capacity(1 << 18, file))?;
    writer.write_metadata(&record(RECORDING_RECORD, unsealed))?;
    let mut channel = |topic, message, descriptors| {
        let schema = writer.add_schema(message, "protobuf", descriptors)?;
        writer.add_channel(schema, topic, "protobuf", &BTreeMap::new())
    };
    let step = channel(STEP_TOPIC, "ccmarl.v1.Step", DESCRIPTORS)?;
    let episode = channel(EPISODE_TOPIC, "ccmarl.v1.Episode", DESCRIPTORS)?;
    let (mut scene, mut poses) = (0, 0);
    if viewer {
        scene = channel(SCENE_TOPIC, "foxglove.SceneUpdate", VIEWER_DESCRIPTORS)?;
        poses = channel(POSES_TOPIC, "foxglove.PosesInFrame", VIEWER_DESCRIPTORS)?;
    }
    Ok((writer, Channels { step, episode, scene, poses }))
}

fn record(name: &str, json: String) -> Metadata {
    Metadata { name: name.to_owned(), metadata: BTreeMap::from([(JSON_KEY.to_owned(), json)]) }
}

impl EpisodeSink for McapSink {
    fn append(&mut self, episode: &Episode) -> Result<(), StorageError> {
        let schema = |source| StorageError::Schema { source, path: self.path.clone() };
        let hash = self.total.check(&self.layout, episode).map_err(schema)?;
        let before = self.total.steps + self.total.episodes;
        let mut row = std::mem::take(&mut self.row);
        for r in 0..episode.rows() {
            let at = before + r as u64;
            self.fill(&mut row, episode, r);
            self.write(self.channels.step, r, at, &row)?;
            if let Some(viewer) = &self.viewer {
                let (scene, poses) =
                    (viewer.scene(&row.state, &row.link, time(at)), viewer.poses(&row.state, time(at)));
                self.write(self.channels.scene, r, at, &scene)?;
                self.write(self.channels.poses, r, at, &poses)?;
            }
        }
        self.row = row;
        let end = proto::Episode {
            index: episode.index,
            steps: episode.steps as u64,
            terminal: episode.terminal,
            episode_return: episode.episode_return(),
            content_hash: hash.to_vec(),
        };
        self.write(self.channels.episode, episode.steps, before + episode.steps as u64, &end)?;
        self.writer.flush().map_err(|e| refused(e, &self.partial))?;
        self.total.add(episode, &hash);
        Ok(())
    }

    fn commit(&mut self) -> Result<u64, StorageError> {
        Ok(self.total.episodes) // each append ended with a flush
    }

    fn finish(mut self: Box<Self>) -> Result<Manifest, StorageError> {
        self.total.seal(&mut self.manifest, &self.path)?;
        let path = self.path.clone();
        let schema = |source| StorageError::Schema { source, path: path.clone() };
        let text = self.manifest.sealed_json().map_err(schema)?;
        let sealed = self.writer.write_metadata(&record(MANIFEST_RECORD, text.clone()));
        sealed.and_then(|()| self.writer.finish().map(drop)).map_err(|e| refused(e, &self.partial))?;
        let file = File::open(&self.partial).map_err(IoError::os("open", &self.partial))?;
        file.sync_all().map_err(IoError::os("sync", &self.partial))?;
        publish(&self.partial, &self.path, self.force)?;
        self.finished = true;
        Manifest::parse(&text).map_err(schema)
    }
}

impl Drop for McapSink {
    /// An unfinished store is kept for recovery, unless it holds nothing.
    fn drop(&mut self) {
        if !self.finished && self.total.episodes == 0 {
            std::fs::remove_file(&self.partial).ok();
        }
    }
}

fn refused(error: McapError, path: &Path) -> StorageError {
    let source = match error {
        McapError::Io(source) => source,
        other => std::io::Error::other(other.to_string()),
    };
    IoError::os("write", path)(source).into()
}
