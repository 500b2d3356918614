//! `ccmarl inspect STORE`: what a store holds, how it was made, its returns, sums and realised loss rates.

mod counts;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::Value;

use super::args::end_on_signals;
use super::{Outcome, ui};
use crate::Error;
use crate::io::{IoError, read_text, refuse_existing, write_atomic};
use crate::schema::AgentSpec;
use crate::stats::{mean, sd};
use crate::storage::{self, StorageError};
use counts::{Counts, Part, episodes, merge, parse_shard};

const EXAMPLES: &str = "\
Examples:
  ccmarl inspect data/tag
  ccmarl inspect data/tag --shard 3/16 --out parts/3.json
  ccmarl inspect --merge parts/*.json

Shards i/n count from 0. Merged in any order they print what one pass over the store prints, to the last bit.";

/// Largest part file that is read, bytes.
const PART_LIMIT: u64 = 4 << 30;

/// Show what a recorded store holds
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A directory, .parquet or .mcap file that `ccmarl record` made
    #[arg(required_unless_present = "merge")]
    store: Option<PathBuf>,
    /// Count only the i-th of n shards of the episodes
    #[arg(long, value_name = "I/N", requires = "out", value_parser = parse_shard)]
    shard: Option<[u64; 2]>,
    /// File for the counts of the shard
    #[arg(long, value_name = "PART", requires = "shard")]
    out: Option<PathBuf>,
    /// Put the counts of all shards together, in any order
    #[arg(long, value_name = "PART", num_args = 1.., conflicts_with_all = ["store", "shard"])]
    merge: Vec<PathBuf>,
    /// Replace the file of --out
    #[arg(long)]
    force: bool,
    /// How to print
    #[arg(long, value_enum, default_value_t)]
    format: ui::Format,
}

/// Everything that is printed; the JSON keys are its fields.
#[derive(Debug, Serialize)]
struct Summary {
    store: String,
    schema_version: u32,
    ccmarl: String,
    seed: u64,
    scenario: Value,
    link: Value,
    policy: Value,
    agents: Vec<AgentSpec>,
    content: String,
    files: usize,
    episodes: u64,
    steps: u64,
    terminal_episodes: u64,
    /// Sum of the team reward per episode.
    returns: Spread,
    /// Mean, over episodes, of the sum of the reward per agent.
    agent_returns: BTreeMap<String, f64>,
    /// Sum over all elements of each column, nulls left out, trues counted.
    sums: BTreeMap<String, f64>,
    /// Realised loss per directed link, over the steps with an action.
    loss: Vec<Loss>,
    /// All links together; null without links or steps.
    loss_rate: Option<f64>,
}

#[derive(Debug, Serialize)]
struct Spread {
    mean: f64,
    /// Sample standard deviation; null for one episode.
    sd: Option<f64>,
    min: f64,
    max: f64,
}

#[derive(Debug, Serialize)]
struct Loss {
    sender: String,
    receiver: String,
    steps: u64,
    lost: u64,
    /// Null without steps.
    rate: Option<f64>,
}

impl Summary {
    fn new(part: &Part) -> Self {
        let (counts, manifest) = (&part.counts, &part.manifest);
        let layout = manifest.layout();
        let communicators = layout.communicators();
        let (n, all) = (communicators.len(), counts.returns());
        let episodes = all.len() as f64;
        let name = |c: usize| layout.agents[communicators[c]].name.clone();
        let pairs = (0..n).flat_map(|s| (0..n).filter(move |&r| r != s).map(move |r| (s, r)));
        let rate = |lost: u64, steps: u64| (steps > 0).then(|| lost as f64 / steps as f64);
        let loss: Vec<Loss> = pairs
            .map(|(s, r)| {
                let (lost, steps) = (counts.lost[s * n + r], counts.steps);
                Loss { sender: name(s), receiver: name(r), steps, lost, rate: rate(lost, steps) }
            })
            .collect();
        let sums = counts.sums();
        let agent_return = |name: &str| sums.get(&format!("reward.{name}")).copied().unwrap_or(0.0) / episodes;
        Self {
            store: part.store.clone(),
            schema_version: manifest.schema_version,
            ccmarl: manifest.ccmarl.clone(),
            seed: manifest.seed,
            scenario: manifest.scenario.clone(),
            link: manifest.link.clone(),
            policy: manifest.policy.clone(),
            agents: manifest.agents.clone(),
            content: manifest.content.clone(),
            files: manifest.parts.len().max(1),
            episodes: manifest.episodes,
            steps: manifest.steps,
            terminal_episodes: counts.terminal,
            returns: Spread {
                mean: mean(&all),
                sd: (all.len() > 1).then(|| sd(&all)),
                min: all.iter().copied().fold(f64::INFINITY, f64::min),
                max: all.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            },
            agent_returns: layout.agents.iter().map(|a| (a.name.clone(), agent_return(&a.name))).collect(),
            sums,
            loss_rate: rate(loss.iter().map(|l| l.lost).sum(), loss.iter().map(|l| l.steps).sum()),
            loss,
        }
    }
}

/// Runs the command. Memory is what the reader holds and one number per episode.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    let whole = if let Some(store) = &args.store {
        ui::say_left_beside(store);
        if let Some(out) = &args.out {
            refuse_existing(out, args.force).map_err(Error::from)?;
            storage::refuse_within_store(out).map_err(Error::from)?;
            if out.exists() && !read_text(out, PART_LIMIT).is_ok_and(|text| Part::parse(&text).is_ok()) {
                return Err(Error::from(IoError::Foreign(out.clone())).into());
            }
        }
        let shard = args.shard.unwrap_or([0, 1]);
        let part = count(store, shard).map_err(Error::from)?;
        if let Some(out) = &args.out {
            write_atomic(out, part.sealed()?.as_bytes()).map_err(Error::from)?;
            let [from, to] = episodes(shard, part.manifest.episodes);
            ui::say(&format!("wrote the counts of episodes {from} to {to} (not included): {}", out.display()));
            return Ok(Outcome::Done);
        }
        part
    } else {
        let mut parts = Vec::new();
        for path in &args.merge {
            let text = read_text(path, PART_LIMIT).map_err(Error::from)?;
            let part = Part::parse(&text).map_err(|message| anyhow::anyhow!("{message}: {}", path.display()));
            parts.push(part?);
        }
        merge(parts)?
    };
    let summary = Summary::new(&whole);
    match args.format {
        ui::Format::Json => ui::print_json(&summary)?,
        ui::Format::Table => print_tables(&summary)?,
    }
    Ok(Outcome::Done)
}

/// Counts the episodes of a shard.
fn count(store: &Path, shard: [u64; 2]) -> Result<Part, StorageError> {
    let mut source = storage::open(store)?;
    let layout = source.manifest().layout();
    let mut counts = Counts::new(&layout);
    let [from, to] = episodes(shard, source.manifest().episodes);
    let bar = ui::progress(to - from, "reading");
    if from < to {
        source.skip_to(from)?;
    }
    for _ in from..to {
        let Some(episode) = source.next_episode()? else { break };
        counts.add(&layout, &episode);
        bar.inc(1);
    }
    if to == source.manifest().episodes && from < to {
        source.next_episode()?; // at its end a source compares what it read with the manifest
    }
    bar.finish_and_clear();
    Ok(Part::new(store.display().to_string(), shard, source.manifest().clone(), counts))
}

fn print_tables(s: &Summary) -> anyhow::Result<()> {
    let number = |v: f64| format!("{v:.4}");
    let sd = s.returns.sd.map_or_else(|| "-".to_owned(), number);
    let facts = [
        ("store", s.store.clone()),
        ("schema version", format!("{} (ccmarl {})", s.schema_version, s.ccmarl)),
        ("seed", s.seed.to_string()),
        ("scenario", short(&s.scenario)),
        ("link", short(&s.link)),
        ("policy", short(&s.policy)),
        ("content", s.content.clone()),
        ("files", s.files.to_string()),
        ("episodes", s.episodes.to_string()),
        ("steps", s.steps.to_string()),
        ("terminal episodes", s.terminal_episodes.to_string()),
        ("return mean", number(s.returns.mean)),
        ("return sd", sd),
        ("return min, max", format!("{}, {}", number(s.returns.min), number(s.returns.max))),
    ];
    let rows: Vec<Vec<String>> = facts.into_iter().map(|(k, v)| vec![k.to_owned(), v]).collect();
    ui::print_table(&["fact", "value"], &rows)?;
    ui::print("")?;
    let agent = |a: &AgentSpec| {
        let role = if a.learner { "learner" } else { "-" };
        let widths = [a.observation, a.message, a.action].map(|w| w.to_string());
        let return_ = s.agent_returns.get(&a.name).map_or_else(|| "-".to_owned(), |&r| number(r));
        let mut row = vec![a.name.clone(), a.team.clone(), role.to_owned()];
        row.extend(widths);
        row.push(return_);
        row
    };
    let rows: Vec<Vec<String>> = s.agents.iter().map(agent).collect();
    ui::print_table(&["agent", "team", "role", "observation", "message", "action", "mean return"], &rows)?;
    if s.loss.is_empty() {
        return Ok(());
    }
    ui::print("")?;
    let percent = |rate: Option<f64>| rate.map_or_else(|| "-".to_owned(), |r| format!("{:.2} %", 100.0 * r));
    let link = |l: &Loss| {
        vec![format!("{} → {}", l.sender, l.receiver), l.steps.to_string(), l.lost.to_string(), percent(l.rate)]
    };
    let mut rows: Vec<Vec<String>> = s.loss.iter().map(link).collect();
    rows.push(vec!["all".to_owned(), String::new(), String::new(), percent(s.loss_rate)]);
    ui::print_table(&["sender → receiver", "messages", "lost", "loss rate"], &rows)?;
    ui::print("messages: those of steps; the final rows of episodes, on which nobody acts, are not counted")
}

/// A plugin of the manifest on one line: its name, then what else it says.
fn short(value: &Value) -> String {
    let Value::Object(map) = value else { return value.to_string() };
    let name = map.get("name").and_then(Value::as_str).unwrap_or("-");
    let rest = map.iter().filter(|(k, v)| *k != "name" && !v.is_object() && !v.is_array());
    rest.fold(name.to_owned(), |text, (k, v)| format!("{text} {k}={v}"))
}
