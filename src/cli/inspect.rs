//! `ccmarl inspect STORE`: what a store holds, how it was made, its returns, sums and realised loss rates.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Serialize;
use serde_json::Value;

use super::{Outcome, ui};
use crate::Error;
use crate::schema::{AgentSpec, Episode, Layout, Manifest, Matrix};
use crate::storage;

/// Show what a recorded store holds
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// A directory, .parquet or .mcap file that `ccmarl record` made
    store: PathBuf,
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

/// Counts that grow by one episode at a time.
struct Counter {
    layout: Layout,
    communicators: Vec<usize>,
    returns: Vec<f64>,
    agent_returns: Vec<f64>,
    terminal: u64,
    steps: u64,
    sums: BTreeMap<String, f64>,
    lost: Vec<u64>,
}

impl Counter {
    fn new(layout: Layout) -> Self {
        let communicators = layout.communicators();
        let n = communicators.len();
        let agent_returns = vec![0.0; layout.agents.len()];
        let (returns, sums, lost) = (Vec::new(), BTreeMap::new(), vec![0; n * n]);
        Self { layout, communicators, returns, agent_returns, terminal: 0, steps: 0, sums, lost }
    }

    fn add(&mut self, e: &Episode) {
        let (n, t) = (self.communicators.len(), e.steps);
        self.returns.push(e.episode_return());
        self.terminal += u64::from(e.terminal);
        self.steps += t as u64;
        let mut sum = |column: String, value: f64| *self.sums.entry(column).or_default() += value;
        let total = |data: &[f32]| data.iter().map(|&v| f64::from(v)).sum::<f64>();
        sum("episode".to_owned(), e.index as f64 * e.rows() as f64);
        sum("step".to_owned(), (t * (t + 1)) as f64 / 2.0);
        sum("reward".to_owned(), total(&e.reward));
        if !self.layout.state_fields.is_empty() {
            sum("state".to_owned(), e.state.iter().sum());
        }
        if n > 0 {
            sum("link".to_owned(), e.link.iter().filter(|&&b| b).count() as f64);
        }
        for (i, agent) in self.layout.agents.iter().enumerate() {
            let mut matrix = |kind: &str, m: &Matrix| {
                if m.width > 0 {
                    sum(format!("{kind}.{}", agent.name), total(&m.data));
                }
            };
            matrix("observation", &e.observations[i]);
            matrix("message", &e.messages[i]);
            matrix("action", &e.actions[i]);
            let reward = total(&e.rewards[i]);
            sum(format!("reward.{}", agent.name), reward);
            self.agent_returns[i] += reward;
        }
        for bits in e.link[..t * n * n].chunks_exact((n * n).max(1)) {
            self.lost.iter_mut().zip(bits).for_each(|(lost, &delivered)| *lost += u64::from(!delivered));
        }
    }

    fn summary(self, store: String, manifest: &Manifest) -> Summary {
        let (n, episodes) = (self.communicators.len(), self.returns.len() as f64);
        let name = |c: usize| self.layout.agents[self.communicators[c]].name.clone();
        let pairs = (0..n).flat_map(|s| (0..n).filter(move |&r| r != s).map(move |r| (s, r)));
        let rate = |lost: u64, steps: u64| (steps > 0).then(|| lost as f64 / steps as f64);
        let loss: Vec<Loss> = pairs
            .map(|(s, r)| {
                let lost = self.lost[s * n + r];
                Loss { sender: name(s), receiver: name(r), steps: self.steps, lost, rate: rate(lost, self.steps) }
            })
            .collect();
        let mean = self.returns.iter().sum::<f64>() / episodes;
        let squares: f64 = self.returns.iter().map(|r| (r - mean) * (r - mean)).sum();
        let returns = Spread {
            mean,
            sd: (episodes > 1.0).then(|| (squares / (episodes - 1.0)).sqrt()),
            min: self.returns.iter().copied().fold(f64::INFINITY, f64::min),
            max: self.returns.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        };
        let agents = self.layout.agents.iter().map(|a| a.name.clone());
        Summary {
            store,
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
            terminal_episodes: self.terminal,
            returns,
            agent_returns: agents.zip(self.agent_returns.iter().map(|r| r / episodes)).collect(),
            sums: self.sums,
            loss_rate: rate(loss.iter().map(|l| l.lost).sum(), loss.iter().map(|l| l.steps).sum()),
            loss,
        }
    }
}

/// Runs the command. Memory is one episode and one number per episode.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let mut source = storage::open(&args.store).map_err(Error::from)?;
    let mut counter = Counter::new(source.manifest().layout());
    let bar = ui::progress(source.manifest().episodes, "reading");
    while let Some(episode) = source.next_episode().map_err(Error::from)? {
        counter.add(&episode);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let summary = counter.summary(args.store.display().to_string(), source.manifest());
    match args.format {
        ui::Format::Json => ui::print_json(&summary)?,
        ui::Format::Table => print_tables(&summary)?,
    }
    Ok(Outcome::Done)
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
    ui::print_table(&["sender → receiver", "messages", "lost", "loss rate"], &rows)
}

/// A plugin of the manifest on one line: its name, then what else it says.
fn short(value: &Value) -> String {
    let Value::Object(map) = value else { return value.to_string() };
    let name = map.get("name").and_then(Value::as_str).unwrap_or("-");
    let rest = map.iter().filter(|(k, v)| *k != "name" && !v.is_object() && !v.is_array());
    rest.fold(name.to_owned(), |text, (k, v)| format!("{text} {k}={v}"))
}
