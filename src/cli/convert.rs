//! `ccmarl convert FROM TO`: a store in another form, without loss.

use std::path::PathBuf;

use super::args::stop_flag;
use super::{Outcome, ui};
use crate::schema::{Episode, Manifest};
use crate::{Error, storage};

const EXAMPLES: &str = "\
Examples:
  ccmarl convert data/tag data/tag.mcap
  ccmarl convert data/probe.mcap data/probe.parquet
  ccmarl convert data/tag data/small.mcap --no-viewer

The content digest is the same in every form. An .mcap made from an .mcap has what viewers draw if that one has it.
Interrupted (exit code 4), it leaves nothing behind.";

/// Arguments of `convert`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A directory, .parquet or .mcap file that `ccmarl record` made
    from: PathBuf,
    /// Store to write: a directory, or a file ending in .parquet or .mcap
    to: PathBuf,
    /// Replace the store if it exists
    #[arg(long)]
    force: bool,
    /// Leave out what viewers draw (topics /scene and /poses of an .mcap)
    #[arg(long)]
    no_viewer: bool,
}

/// Runs the command. Memory is one part's buffers.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let bar = ui::progress(0, "converting");
    let mut watch = |manifest: &Manifest, _: &Episode| {
        bar.set_length(manifest.episodes);
        bar.inc(1);
    };
    let options = storage::Options { force: args.force, viewer: !args.no_viewer };
    let written = storage::convert(&args.from, &args.to, options, &mut watch, stop_flag()?);
    bar.finish_and_clear();
    let Some(manifest) = written.map_err(Error::from)? else {
        ui::say("interrupted: nothing was written");
        return Ok(Outcome::Interrupted);
    };
    let to = crate::io::printable(&args.to.display().to_string());
    ui::print(&format!("converted {} episodes, content {}: {to}", manifest.episodes, manifest.content))?;
    Ok(Outcome::Done)
}
