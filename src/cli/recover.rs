//! `ccmarl recover NAME`: what a killed recording left, put under its name; what is sound of a damaged store, in a new one.

use std::path::{Path, PathBuf};

use super::args::stop_flag;
use super::{Outcome, ui};
use crate::io::printable;
use crate::schema::{Episode, Manifest};
use crate::{Error, storage};

const EXAMPLES: &str = "\
Examples:
  ccmarl recover data/tag              # record --out data/tag was killed; data/.tag.partial is what it left
  ccmarl recover data/probe.mcap
  ccmarl recover copied.mcap --force   # cut short by a bad copy: keeps its whole episodes
  ccmarl recover data/bad --out data/good   # a bad chunk or part: the sound episodes, into a new store

A recording is built in a hidden .<name>.partial beside its name; every episode that was reported as committed is in it.
With --out a damaged store is only read; its sound episodes are numbered anew, and the new manifest's `kept` says which
they were. Exit code 0: all planned episodes are there; 3: some are not, and how many is said.";

/// Arguments of `recover`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// The name that was given to --out, or the hidden .partial beside it
    store: PathBuf,
    /// Write the sound episodes of a damaged store here, under a new name
    #[arg(long, value_name = "NEW")]
    out: Option<PathBuf>,
    /// Replace what has the name meanwhile
    #[arg(long)]
    force: bool,
}

/// Runs the command. Memory is one part's buffers.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    if let Some(out) = &args.out {
        return rescue(args, out);
    }
    let bar = ui::progress(0, "recovering");
    let mut watch = |manifest: &Manifest, _: &Episode| {
        bar.set_length(manifest.planned);
        bar.inc(1);
    };
    let recovered = storage::recover(&args.store, args.force, &mut watch, stop_flag()?);
    bar.finish_and_clear();
    let Some(recovered) = recovered.map_err(Error::from)? else {
        ui::say("interrupted: all is as it was");
        return Ok(Outcome::Interrupted);
    };
    if let Some(ended) = &recovered.ended {
        ui::say(&format!("the episodes end where the data does: {ended}"));
    }
    if let Some(kept) = &recovered.kept {
        ui::say(&format!("what could not be read is kept: {}", kept.display()));
    }
    let (k, n) = (recovered.episodes, recovered.planned);
    match n.checked_sub(k) {
        _ if n == 0 => ui::say("lost: unknown, since nobody noted how many episodes were planned"),
        Some(lost @ 1..) => ui::say(&format!(
            "lost: {lost} of {n} planned episodes{}",
            if recovered.ended.is_some() { "" } else { ": they are not whole in what was left" }
        )),
        _ => {}
    }
    if k == 0 {
        ui::say("no whole episode: nothing was put in place; record again with --force");
    } else {
        ui::print(&format!("recovered {k} episodes: {}", printable(&recovered.path.display().to_string())))?;
    }
    Ok(if recovered.is_loss() { Outcome::DataLost } else { Outcome::Done })
}

/// Saves what is sound of a damaged store.
fn rescue(args: &Args, out: &Path) -> anyhow::Result<Outcome> {
    let bar = ui::progress(0, "saving");
    let mut watch = |manifest: &Manifest, _: &Episode| {
        bar.set_length(manifest.planned);
        bar.inc(1);
    };
    let rescued = storage::rescue(&args.store, out, args.force, &mut watch, stop_flag()?);
    bar.finish_and_clear();
    let Some(rescued) = rescued.map_err(Error::from)? else {
        ui::say("interrupted: nothing was written");
        return Ok(Outcome::Interrupted);
    };
    let (k, n, lost) = (rescued.episodes, rescued.planned, rescued.lost());
    if lost.is_empty() {
        ui::say("no episode was lost: what is damaged is none of them");
    } else {
        ui::say(&format!("lost: {} of {n} episodes: {}", n - k, storage::ranges(&lost)));
    }
    if k == 0 {
        ui::say("no episode is sound: nothing was written");
    } else {
        ui::print(&format!("recovered {k} episodes: {}", printable(&out.display().to_string())))?;
    }
    Ok(Outcome::DataLost)
}
