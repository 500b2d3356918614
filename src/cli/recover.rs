//! `ccmarl recover NAME`: what a killed recording left, put under its name.

use std::path::PathBuf;

use super::{Outcome, ui};
use crate::schema::{Episode, Manifest};
use crate::{Error, storage};

const EXAMPLES: &str = "\
Examples:
  ccmarl recover data/tag              # record --out data/tag was killed; data/.tag.partial is what it left
  ccmarl recover data/probe.mcap
  ccmarl recover copied.mcap --force   # cut short by a bad copy: keeps its whole episodes

A recording is built in a hidden .<name>.partial beside its name; every episode that was reported as committed is in it.
Exit code 0: all planned episodes are there; 3: some are not, and how many is said.";

/// Arguments of `recover`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// The name that was given to --out, or the hidden .partial beside it
    store: PathBuf,
    /// Replace what has the name meanwhile
    #[arg(long)]
    force: bool,
}

/// Runs the command. Memory is one part's buffers.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let bar = ui::progress(0, "recovering");
    let mut watch = |manifest: &Manifest, _: &Episode| {
        bar.set_length(manifest.planned);
        bar.inc(1);
    };
    let recovered = storage::recover(&args.store, args.force, &mut watch);
    bar.finish_and_clear();
    let recovered = recovered.map_err(Error::from)?;
    if let Some(ended) = &recovered.ended {
        ui::say(&format!("the episodes end where the data does: {ended}"));
    }
    if let Some(kept) = &recovered.kept {
        let kept = crate::io::printable(&kept.display().to_string());
        ui::say(&format!("what could not be read is kept: {kept}"));
    }
    let (k, n) = (recovered.episodes, recovered.planned);
    match n.checked_sub(k) {
        _ if n == 0 => ui::say("lost: unknown, since nobody noted how many episodes were planned"),
        Some(lost @ 1..) => ui::say(&format!(
            "lost: {lost} of {n} planned episodes{}",
            if recovered.ended.is_some() { "" } else { "; they had not been committed" }
        )),
        _ => {}
    }
    if k == 0 {
        ui::say("no whole episode: nothing was put in place; record again with --force");
    } else {
        ui::print(&format!("recovered {k} episodes: {}", crate::io::printable(&recovered.path.display().to_string())))?;
    }
    Ok(if recovered.is_loss() { Outcome::DataLost } else { Outcome::Done })
}
