//! `ccmarl quickstart`: the whole line once, as the commands that a user would type.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clap::Parser as _;

use super::args::stop_flag;
use super::{Cli, Command, Outcome, dispatch, report, ui};
use crate::io;

const HELP: &str = "\
Trains cc-maddpg and fc-maddpg briefly on simple_spread, records both over a link that loses 20 % of the messages,
estimates what messages tell about actions, tests both on the eight channels, and writes index.html. Every step is an
ordinary command and is shown as it runs. About a minute on two cores.";

/// What says that a directory was made by this command.
const MARKER: &str = "quickstart.txt";

/// All that may lie in a directory of ours; `report` only until its page is moved up.
const OURS: [&str; 9] =
    [MARKER, "runs", "data", "report", "index.html", "command.txt", "provenance.json", "figures", "tables"];

/// Arguments of `quickstart`.
#[derive(Debug, clap::Args)]
#[command(after_help = HELP)]
pub(super) struct Args {
    /// Directory to write
    #[arg(long, default_value = "reports/quickstart")]
    out: PathBuf,
    /// Replace the directory if an earlier quick start made it
    #[arg(long)]
    force: bool,
}

/// The commands, in order, with their outputs under `dir`.
fn commands(dir: &str) -> Vec<Vec<String>> {
    let mut all = Vec::new();
    let mut add = |words: &str| all.push(words.split(' ').map(|word| word.replace("DIR", dir)).collect());
    for algorithm in ["fc-maddpg", "cc-maddpg"] {
        add(&format!(
            "train --scenario simple_spread --algorithm {algorithm} --steps 200000 --seed 1 --out DIR/runs/{algorithm}"
        ));
    }
    for algorithm in ["fc-maddpg", "cc-maddpg"] {
        let record = format!(
            "record --scenario simple_spread --policy run:DIR/runs/{algorithm} --action-noise 0.3 --link dropout:0.2 --episodes 600 --seed 2 --out DIR/data/{algorithm}"
        );
        add(&record);
        add(&format!("{record}.mcap"));
        add(&format!(
            "estimate-mi DIR/data/{algorithm} --estimator gaussian,jsd,club --seed 1 --out DIR/runs/{algorithm}/mi.parquet"
        ));
        add(&format!("evaluate DIR/runs/{algorithm} --suite paper --episodes 100"));
    }
    add("inspect DIR/data/cc-maddpg");
    add("report DIR/runs/fc-maddpg DIR/runs/cc-maddpg --title Quick\u{a0}start --out DIR/report");
    all
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let started = Instant::now();
    let stop = stop_flag()?; // before any command in it, so that none ends the process
    prepare(&args.out, args.force)?;
    let made = make(&args.out, stop);
    // half a quick start is of no use, and cannot go on
    if !matches!(made, Ok(Outcome::Done | Outcome::DataLost)) {
        std::fs::remove_dir_all(&args.out).map_err(io::IoError::os("remove the unfinished", &args.out))?;
    }
    let outcome = made?;
    let seconds = started.elapsed().as_secs_f64();
    match outcome {
        Outcome::Done => ui::say(&format!(
            "\nmade {}/index.html in {seconds:.0} s: two trained teams, four stores, their mutual information, eight \
             channels.\nnext: open the page; then train for longer (--steps 4000000), on simple_tag, or with your own \
             channel (--prior markov:heavy)",
            args.out.display()
        )),
        Outcome::Interrupted => ui::say(&format!(
            "interrupted: removed {}; the same command starts again from the beginning",
            args.out.display()
        )),
        Outcome::DataLost | Outcome::Wrong => {}
    }
    Ok(outcome)
}

/// Runs the commands, then moves the page to the top of the directory.
fn make(out: &Path, stop: &AtomicBool) -> anyhow::Result<Outcome> {
    let dir = out.to_string_lossy().into_owned();
    for words in commands(&dir) {
        ui::say(&format!("\n$ ccmarl {}", words.join(" ")));
        let cli = Cli::try_parse_from(std::iter::once("ccmarl".to_owned()).chain(words))?;
        let outcome = match cli.command {
            // where the page lies is said below, once it is there
            Command::Report(args) => report::make(&args)?.map_or(Outcome::Interrupted, |_| Outcome::Done),
            command => dispatch(command)?,
        };
        if outcome != Outcome::Done {
            return Ok(outcome);
        }
        if stop.load(Ordering::Relaxed) {
            return Ok(Outcome::Interrupted);
        }
    }
    // the page belongs at the top of the directory, beside the runs and stores it was made from
    let report = out.join("report");
    for entry in std::fs::read_dir(&report).map_err(io::IoError::os("list", &report))? {
        let from = entry?.path();
        if let Some(name) = from.file_name() {
            std::fs::rename(&from, out.join(name)).map_err(io::IoError::os("move", &from))?;
        }
    }
    std::fs::remove_dir(&report).map_err(io::IoError::os("remove", &report))?;
    Ok(Outcome::Done)
}

/// Makes the directory; what an earlier quick start left is replaced only with `force`, and only if nothing else is in it.
fn prepare(out: &Path, force: bool) -> anyhow::Result<()> {
    io::refuse_existing(out, force).map_err(crate::Error::from)?;
    if out.exists() {
        let mut foreign = !out.join(MARKER).exists();
        for entry in std::fs::read_dir(out).map_err(io::IoError::os("list", out))? {
            foreign |= !OURS.contains(&entry?.file_name().to_string_lossy().as_ref());
        }
        if foreign {
            return Err(crate::Error::from(io::IoError::Foreign(out.to_owned())).into());
        }
        std::fs::remove_dir_all(out).map_err(io::IoError::os("replace", out))?;
    }
    let lines: Vec<String> = commands("DIR").iter().map(|words| format!("ccmarl {}\n", words.join(" "))).collect();
    io::write_atomic(
        &out.join(MARKER),
        format!("made by ccmarl {}:\n{}", env!("CARGO_PKG_VERSION"), lines.concat()).as_bytes(),
    )?;
    Ok(())
}
