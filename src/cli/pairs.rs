//! `ccmarl pairs`: a store as a table with one row per (episode, step, sender, receiver).

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use serde_json::json;

use super::args::{end_on_signals, stop_flag};
use super::{Outcome, ui};
use crate::Error;
use crate::pairs::PairsError;
use crate::storage::{self, PairsWriter};

const EXAMPLES: &str = "\
Examples:
  ccmarl pairs data/tag --out pairs.parquet
  duckdb -c \"select sender, receiver, avg(delivered::int) from 'pairs.parquet' group by all order by all\"

Columns: episode, step, sender, receiver, delivered, message (what was sent), action (the receiver's). Rows are the
steps with an action. Memory stays bounded, however large the store.";

/// Arguments of `pairs`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A directory, .parquet or .mcap file that `ccmarl record` made
    store: PathBuf,
    /// Parquet file to write, x.parquet
    #[arg(long)]
    out: PathBuf,
    /// Replace the file if ccmarl wrote it
    #[arg(long)]
    force: bool,
    /// How the summary is printed
    #[arg(long, value_enum, default_value_t)]
    format: ui::Format,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    if args.out.extension().is_none_or(|ending| ending != "parquet") {
        let message = format!("--out: a table of pairs is a .parquet file, found {}", args.out.display());
        return Err(Error::Usage(message).into());
    }
    crate::io::refuse_existing(&args.out, args.force).map_err(Error::from)?;
    storage::refuse_within_store(&args.out).map_err(Error::from)?;
    end_on_signals()?; // until there is something to clean up
    let mut source = storage::open(&args.store).map_err(Error::from)?;
    let layout = source.manifest().layout();
    if layout.links().is_empty() {
        return Err(Error::from(PairsError::NoLinks { found: layout.communicators().len() }).into());
    }
    let stop = stop_flag()?;
    let mut table = PairsWriter::create(&args.out, source.manifest(), args.force).map_err(Error::from)?;
    let bar = ui::progress(source.manifest().episodes, "episodes");
    while let Some(episode) = source.next_episode().map_err(Error::from)? {
        if stop.load(Ordering::Relaxed) {
            ui::say("interrupted: nothing was written");
            return Ok(Outcome::Interrupted);
        }
        table.append(&episode).map_err(Error::from)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    let rows = table.finish().map_err(Error::from)?;
    let (out, episodes, links) = (args.out.display().to_string(), source.manifest().episodes, layout.links().len());
    match args.format {
        ui::Format::Json => ui::print_json(&json!({"out": out, "episodes": episodes, "links": links, "rows": rows}))?,
        ui::Format::Table => {
            let facts = [
                ("table", out),
                ("episodes", episodes.to_string()),
                ("links", links.to_string()),
                ("rows", rows.to_string()),
            ];
            ui::print_table(&["pairs", ""], &facts.map(|(k, v)| vec![k.to_owned(), v]))?;
        }
    }
    Ok(Outcome::Done)
}
