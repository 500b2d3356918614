//! `ccmarl record`: scenario × policy × link → a store.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde_json::json;

use super::args::{ScenarioArgs, stop_flag};
use super::{Outcome, ui};
use crate::link::LINKS;
use crate::record::{Options, POLICIES, RecordError, Recording, loss_rate};
use crate::registry::{RegistryError, Spec};
use crate::schema::Episode;
use crate::{Error, record, scenario, storage};

const EXAMPLES: &str = "\
Examples:
  ccmarl record --scenario simple_tag --agents 3 --policy random --link dropout:0.2 --episodes 1000 --seed 1 --out data/tag
  ccmarl record --scenario simple_spread --agents 2 --policy probe:0.75 --link markov:heavy --out data/probe.parquet
  ccmarl record --scenario simple_spread --policy run:runs/x --action-noise 0.3 --link dropout:0.2 --out data/x
  ccmarl record --scenario simple_spread --policy scripted --link distance:3 --set view_radius=0.5 --out data/spread.mcap

The same seed gives the same bytes for any number of threads. Interrupted (Ctrl-C), it seals what is done and exits 4.
`ccmarl list` shows all scenarios, policies and links.";

/// Arguments of `record`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// Policy: name or name:value
    #[arg(long, default_value = "random")]
    policy: String,
    /// Exploration noise of a trained policy (run:DIR): standard deviation
    #[arg(long, value_name = "SIGMA")]
    action_noise: Option<f64>,
    /// Link: name or name:value
    #[arg(long, default_value = "perfect")]
    link: String,
    /// Episodes
    #[arg(long, default_value_t = 1000)]
    episodes: u64,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Store to write: a directory, or a file ending in .parquet or .mcap
    #[arg(long)]
    out: PathBuf,
    /// Threads; 0 is one per core. Does not change the result
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
    /// Replace the store if it exists
    #[arg(long)]
    force: bool,
    /// Leave out what viewers draw (topics /scene and /poses of an .mcap)
    #[arg(long)]
    no_viewer: bool,
    /// How the summary is printed
    #[arg(long, value_enum, default_value_t)]
    format: ui::Format,
}

/// Running mean and standard deviation of returns, and the mean loss rate.
#[derive(Default)]
struct Summary {
    episodes: u64,
    steps: usize,
    mean: f64,
    /// Sum of squared deviations from the mean (Welford).
    squares: f64,
    losses: f64,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let spec = args.scenario.spec(None)?.ok_or_else(|| RegistryError::Params {
        name: "record".to_owned(),
        message: "give --scenario NAME (`ccmarl list` shows all)".to_owned(),
    });
    let scenario = scenario::build(&spec.map_err(Error::from)?).map_err(Error::from)?;
    let link_spec = Spec::parse("link", LINKS, &args.link).map_err(Error::from)?;
    let link = record::build_link(&link_spec, &*scenario).map_err(Error::from)?;
    let mut policy_spec = Spec::parse("policy", POLICIES, &args.policy).map_err(Error::from)?;
    if let Some(sigma) = args.action_noise {
        policy_spec = policy_spec.with("action_noise", sigma);
    }
    let policy = record::build_policy(&policy_spec, &*scenario).map_err(Error::from)?;
    let recording =
        Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: args.seed, episodes: args.episodes };
    if args.episodes == 0 {
        return Err(Error::from(RecordError::NoEpisodes).into());
    }
    record::check_link(&*link, args.episodes).map_err(Error::from)?;
    let stop = stop_flag()?;
    let options = storage::Options { force: args.force, viewer: !args.no_viewer };
    let mut sink = storage::create_with(&args.out, &recording.manifest(), options).map_err(Error::from)?;
    let communicators = recording.layout().communicators().len();
    let bar = ui::progress(args.episodes, "episodes");
    let (mut summary, mut said) = (Summary::default(), Instant::now());
    let mut committed = |episode: &Episode| {
        summary.add(episode, loss_rate(episode, communicators));
        bar.inc(1);
        if said.elapsed() > Duration::from_millis(900) {
            said = Instant::now();
            bar.suspend(|| ui::say(&format!("committed {} episodes", episode.index + 1)));
        }
    };
    let options = Options { threads: args.threads.into(), block: 0 };
    let recorded = recording.record(&mut *sink, options, &mut committed, stop).map_err(Error::from)?;
    bar.finish_and_clear();
    if recorded.episodes == 0 {
        ui::say("interrupted before the first episode: nothing was written");
        return Ok(Outcome::Interrupted);
    }
    sink.finish().map_err(Error::from)?;
    ui::say(&format!("committed {} episodes", recorded.episodes));
    summary.print(args, &recording)?;
    if recorded.interrupted {
        let (k, n) = (recorded.episodes, args.episodes);
        ui::say(&format!("interrupted: sealed {k} of {n} episodes; the same command with --force starts again"));
        return Ok(Outcome::Interrupted);
    }
    Ok(Outcome::Done)
}

impl Summary {
    fn add(&mut self, episode: &Episode, loss_rate: f64) {
        self.episodes += 1;
        self.steps += episode.steps;
        let deviation = episode.episode_return() - self.mean;
        self.mean += deviation / self.episodes as f64;
        self.squares += deviation * (episode.episode_return() - self.mean);
        self.losses += loss_rate;
    }

    fn print(&self, args: &Args, recording: &Recording<'_>) -> anyhow::Result<()> {
        let n = self.episodes as f64;
        let (mean, std, loss) = (self.mean, (self.squares / (n - 1.0).max(1.0)).sqrt(), self.losses / n);
        let out = args.out.display().to_string();
        let manifest = recording.manifest();
        match args.format {
            ui::Format::Json => ui::print_json(&json!({
                "out": out, "episodes": self.episodes, "steps": self.steps, "seed": args.seed,
                "scenario": manifest.scenario, "link": manifest.link, "policy": manifest.policy,
                "return_mean": mean, "return_std": std, "loss_rate": loss,
            })),
            ui::Format::Table => {
                let rows = [
                    ("store", out),
                    ("episodes", self.episodes.to_string()),
                    ("steps", self.steps.to_string()),
                    ("return", format!("{mean:.2} ± {std:.2} (std over episodes)")),
                    ("return counts", recording.scenario.reward_convention().to_owned()),
                    ("loss rate", format!("{:.2} %", 100.0 * loss)),
                ];
                ui::print_table(&["recorded", ""], &rows.map(|(k, v)| vec![k.to_owned(), v]))
            }
        }
    }
}
