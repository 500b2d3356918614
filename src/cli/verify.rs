//! `ccmarl verify STORE`: everything that can be checked about a store, every fault that is found.

use std::path::PathBuf;

use serde::Serialize;
use serde_json::Value;

use super::{Outcome, ui};
use crate::Error;
use crate::registry::Spec;
use crate::scenario::{self, Scenario};
use crate::schema::{Episode, Manifest};
use crate::storage::{self, Problem, Report};

const EXAMPLES: &str = "\
Examples:
  ccmarl verify data/tag
  ccmarl verify data/probe.mcap --format json

Checks digests, checksums, lengths, the order of rows, flags, the link matrix, final rows, counters, reward sums and
widths. Exit code 0: all holds; 1: something is wrong; 3: what is there holds, but data was lost.";

/// Arguments of `verify`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A directory, .parquet or .mcap file, or the name of a recording that did not finish
    store: PathBuf,
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
}

/// Runs the command. Memory is one episode.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let bar = ui::progress(0, "verifying");
    let mut scenario = None;
    let mut watch = |manifest: &Manifest, episode: &Episode| {
        bar.set_length(manifest.episodes.max(manifest.planned));
        bar.inc(1);
        rewards(scenario.get_or_insert_with(|| scenario_of(manifest)).as_deref(), episode)
    };
    let report = storage::verify(&args.store, &mut watch);
    bar.finish_and_clear();
    let report = report.map_err(Error::from)?;
    let (verdict, outcome) = if report.is_wrong() {
        ("wrong", Outcome::Wrong)
    } else if report.is_clean() {
        ("clean", Outcome::Done)
    } else {
        ("lost", Outcome::DataLost)
    };
    print(args, &report, verdict)?;
    Ok(outcome)
}

/// The scenario that the manifest names, if this program has it.
fn scenario_of(manifest: &Manifest) -> Option<Box<dyn Scenario>> {
    let Value::Object(_) = &manifest.scenario else { return None };
    let spec: Spec = serde_json::from_value(manifest.scenario.clone()).ok()?;
    scenario::build(&spec).ok()
}

/// Compares the team reward of each step with the agents' rewards, where the scenario says how they belong together.
fn rewards(scenario: Option<&dyn Scenario>, episode: &Episode) -> Option<String> {
    let scenario = scenario?;
    let mut agents = vec![0.0; episode.rewards.len()];
    for (step, &team) in episode.reward.iter().enumerate() {
        for (agent, column) in agents.iter_mut().zip(&episode.rewards) {
            *agent = column[step];
        }
        let expected = scenario.team_reward(&agents);
        if team != expected {
            return Some(format!("step {step}: the agents' rewards give the team {expected}, found {team}"));
        }
    }
    None
}

fn print(args: &Args, report: &Report, verdict: &'static str) -> anyhow::Result<()> {
    let manifest = report.manifest.as_ref();
    let printed = Printed {
        store: args.store.display().to_string(),
        verdict,
        schema_version: manifest.map(|m| m.schema_version),
        episodes: report.episodes,
        steps: report.steps,
        content: manifest.map(|m| m.content.as_str()).filter(|content| !content.is_empty()),
        problems: &report.problems,
        unlisted: report.unlisted,
        notes: &report.notes,
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
