//! `ccmarl verify STORE`: everything that can be checked about a store, every fault that is found.

use std::path::PathBuf;

use serde::Serialize;

use super::args::end_on_signals;
use super::{Outcome, ui};
use crate::Error;
use crate::record::{Difference, FLOAT_TOLERANCE, Resimulation, scenario_of};
use crate::scenario::Scenario;
use crate::schema::{Episode, Manifest};
use crate::storage::{self, Problem, Report};

const EXAMPLES: &str = "\
Examples:
  ccmarl verify data/tag
  ccmarl verify data/probe.mcap --format json
  ccmarl verify data/tag --resimulate

Checks digests, checksums, lengths, the order of rows, flags, the link matrix, final rows, counters, reward sums and
widths. --resimulate plays every step again from its recorded state and actions and compares state (1e-9), observations
and rewards (1e-6), also of a store that another program wrote. Exit code 0: all holds; 1: something is wrong; 3: what is there holds, but data was lost.";

/// Arguments of `verify`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A directory, .parquet or .mcap file, or the name of a recording that did not finish
    store: PathBuf,
    /// Play every step again in the scenario that the manifest names, and compare
    #[arg(long)]
    resimulate: bool,
    /// How to print
    #[arg(long, value_enum, default_value_t)]
    format: ui::Format,
}

/// What is printed; the JSON keys are its fields.
#[derive(Debug, Serialize)]
struct Printed<'a> {
    store: String,
    /// `clean`, `wrong` or `lost`.
    verdict: &'static str,
    schema_version: Option<u32>,
    /// Sound episodes.
    episodes: u64,
    /// Their steps.
    steps: u64,
    content: Option<&'a str>,
    problems: &'a [Problem],
    /// Problems that are not listed.
    unlisted: u64,
    notes: &'a [String],
    /// With `--resimulate`: the largest difference per column.
    resimulation: Option<&'a [Difference]>,
}

/// Runs the command. Memory is what the reader holds: some batches of rows, or one episode.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    let bar = ui::progress(0, "verifying");
    let (mut scenario, mut again) = (None, None);
    let mut watch = |manifest: &Manifest, episode: &Episode| {
        bar.set_length(manifest.episodes.max(manifest.planned));
        bar.inc(1);
        let wrong = rewards(scenario.get_or_insert_with(|| scenario_of(manifest).ok()).as_deref(), episode);
        let wrong = wrong.map(|message| ("rewards", message));
        if !args.resimulate {
            return wrong;
        }
        // what cannot be played again is said once, below
        let again = again.get_or_insert_with(|| Resimulation::of(manifest)).as_mut().ok()?;
        again.play(episode).err().map(|e| ("resimulation", e.to_string())).or(wrong)
    };
    let report = storage::verify(&args.store, &mut watch);
    bar.finish_and_clear();
    ui::say_left_beside(&args.store);
    let mut report = report.map_err(Error::from)?;
    let again = again.transpose().unwrap_or_else(|error| {
        let (place, message) = ("manifest".to_owned(), error.to_string());
        report.problems.push(Problem { check: "resimulation", place, message, lost: false });
        None
    });
    let differences = again.map(Resimulation::differences);
    for column in differences.iter().flatten().filter(|column| !column.holds()) {
        let Difference { column, largest, tolerance, episode, step } = column;
        report.problems.push(Problem {
            check: "resimulation",
            place: column.clone(),
            message: format!("differs by {largest:.3e} at episode {episode} step {step}, allowed is {tolerance:.0e}"),
            lost: false,
        });
    }
    let (verdict, outcome) = if report.is_wrong() {
        ("wrong", Outcome::Wrong)
    } else if report.is_clean() {
        ("clean", Outcome::Done)
    } else {
        ("lost", Outcome::DataLost)
    };
    print(args, &report, verdict, differences.as_deref())?;
    Ok(outcome)
}

/// Compares the team reward of each step with the agents' rewards; another program may have rounded them otherwise.
fn rewards(scenario: Option<&dyn Scenario>, episode: &Episode) -> Option<String> {
    let scenario = scenario?;
    let mut agents = vec![0.0; episode.rewards.len()];
    for (step, &team) in episode.reward.iter().enumerate() {
        for (agent, column) in agents.iter_mut().zip(&episode.rewards) {
            *agent = column[step];
        }
        let expected = scenario.team_reward(&agents);
        let size = agents.iter().fold(expected.abs(), |size, r| size + r.abs());
        if (team - expected).abs() > FLOAT_TOLERANCE as f32 * size {
            return Some(format!("step {step}: the agents' rewards give the team {expected}, found {team}"));
        }
    }
    None
}

fn print(
    args: &Args,
    report: &Report,
    verdict: &'static str,
    resimulation: Option<&[Difference]>,
) -> anyhow::Result<()> {
    let manifest = report.manifest.as_ref();
    let printed = Printed {
        store: args.store.display().to_string(),
        verdict,
        schema_version: manifest.map(|m| m.schema_version),
        episodes: report.episodes,
        steps: report.steps,
        // the manifest's digest is that of the episodes that were found only if all are there and sound
        content: manifest.filter(|_| report.is_clean()).map(|m| m.content.as_str()),
        problems: &report.problems,
        unlisted: report.unlisted,
        notes: &report.notes,
        resimulation,
    };
    if args.format == ui::Format::Json {
        return ui::print_json(&printed);
    }
    let optional = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
    let mut facts = vec![
        ("store", printed.store),
        ("verdict", printed.verdict.to_owned()),
        ("schema version", optional(printed.schema_version.map(|v| v.to_string()))),
        ("sound episodes", printed.episodes.to_string()),
        ("steps", printed.steps.to_string()),
        ("content", optional(printed.content.map(str::to_owned))),
        ("problems", (report.problems.len() as u64 + report.unlisted).to_string()),
    ];
    facts.extend(report.notes.iter().map(|note| ("note", note.clone())));
    let rows: Vec<Vec<String>> = facts.into_iter().map(|(k, v)| vec![k.to_owned(), v]).collect();
    ui::print_table(&["fact", "value"], &rows)?;
    if let Some(columns) = resimulation {
        ui::print("")?;
        let row = |d: &Difference| {
            let place =
                if d.largest == 0.0 { "-".to_owned() } else { format!("episode {} step {}", d.episode, d.step) };
            vec![d.column.clone(), format!("{:.2e}", d.largest), format!("{:.0e}", d.tolerance), place]
        };
        let rows: Vec<Vec<String>> = columns.iter().map(row).collect();
        ui::print_table(&["column", "largest difference", "allowed", "where"], &rows)?;
    }
    if report.problems.is_empty() {
        return Ok(());
    }
    ui::print("")?;
    let row = |p: &Problem| {
        let kind = if p.lost { "lost" } else { "wrong" };
        vec![kind.to_owned(), p.check.to_owned(), p.place.clone(), p.message.clone()]
    };
    let rows: Vec<Vec<String>> = report.problems.iter().map(row).collect();
    ui::print_table(&["kind", "check", "place", "problem"], &rows)
}
