//! # What it is
//! The MCAP store: one file that robotics viewers and log tools open.
//!
//! # Definition
//! Topic `/rollout/step` carries one protobuf message per row, `/rollout/episode` one per episode, after its rows, with
//! its content hash. For viewers, `/scene` (`foxglove.SceneUpdate`: agents, landmarks, links) and `/poses`
//! (`foxglove.PosesInFrame`: agents) repeat what a row says; readers of rollouts ignore both. The schemas are in the
//! file as descriptor sets (src/schema/proto/\*.proto). The manifest is the metadata record `ccmarl.manifest`; `ccmarl.recording`, at the start, is what was known before the recording.
//!
//! # Shapes and units
//! As in the schema: `state` f64\[S\], `observation`, `message`, `action` f32 per agent, `link` bool\[N·N\]. Times are
//! nanoseconds: 0.1 s per row, counted through all episodes; publish time is when a row's messages were sent, log time
//! when they were delivered, sequence is the step.
//!
//! # Parameters
//! Whether viewers' topics are written (they are by default). A chunk ends with each episode (and at 1 MiB), zstd, one thread, so that the bytes are the same anywhere.
//! The container's index of chunks is kept in memory until the end, about 600 bytes per episode.
//!
//! # When it fails
//! A file that was cut short is an error that counts its whole episodes. All checksums are checked before anything is
//! decoded: chunks, data section, summary; records are limited to 64 MiB.
//!
//! # Reference
//! MCAP format specification, mcap.dev/spec.
//!
//! # Differences from the reference implementation
//! None in the container. Checksums may be absent in MCAP at large; here they must be there.

mod assembler;
mod diagnose;
mod fields;
mod proto;
mod sink;
mod source;
mod tail;
mod topics;
mod viewer;

use std::path::Path;

pub use topics::{Cell, TopicColumn, topic_columns, topic_names};

use super::{EpisodeSink, EpisodeSource, Format, Options, StorageError};
use crate::registry::Entry;
use crate::schema::Manifest;

/// Topic of the rows.
const STEP_TOPIC: &str = "/rollout/step";
/// Topic of the ends of episodes.
const EPISODE_TOPIC: &str = "/rollout/episode";
/// Topic of the drawn world.
const SCENE_TOPIC: &str = "/scene";
/// Topic of the agents' poses.
const POSES_TOPIC: &str = "/poses";
/// Metadata record of the sealed manifest.
const MANIFEST_RECORD: &str = "ccmarl.manifest";
/// Metadata record of the manifest as it was before the recording.
const RECORDING_RECORD: &str = "ccmarl.recording";
/// Key of the JSON text in both records.
const JSON_KEY: &str = "json";

/// The MCAP store.
pub(super) const ENTRY: Entry<Format> = Entry {
    name: "mcap",
    summary: "one .mcap file of protobuf messages",
    reference: "MCAP specification",
    value: None,
    build: Format { claims, create, open, salvage, diagnose: diagnose::diagnose, viewer: source::draws },
};

fn claims(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mcap")) && !path.is_dir()
}

fn create(path: &Path, manifest: &Manifest, options: Options) -> Result<Box<dyn EpisodeSink>, StorageError> {
    Ok(Box::new(sink::McapSink::create(path, manifest, options)?))
}

fn open(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    Ok(Box::new(source::McapSource::open(path)?))
}

fn salvage(path: &Path) -> Result<Box<dyn EpisodeSource>, StorageError> {
    Ok(Box::new(source::McapSource::salvage(path)?))
}
