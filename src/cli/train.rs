//! `ccmarl train`: a learner on a scenario over a link prior, into a run directory.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::json;

use super::args::{ScenarioArgs, stop_flag};
use super::evaluate::print_channels;
use super::{Outcome, ui};
use crate::Error;
use crate::link::LINKS;
use crate::registry::Spec;
use crate::train::{self, Given, Options, Protocol, TrainConfig, TrainError};

const EXAMPLES: &str = "\
Examples:
  ccmarl train --scenario simple_spread --algorithm cc-maddpg --steps 400000 --seed 1 --out runs/x
  ccmarl train --scenario simple_tag --agents 6 --algorithm cc-maddpg --prior markov:heavy --out runs/matched
  ccmarl train --config run.toml --out runs/y
  ccmarl train --out runs/x --resume
  ccmarl train --out runs/x --resume --steps 8000000

Without --scenario and --config it is simple_spread with 3 agents. A --config file also sets what has no flag, under the names of
config.toml: messages = \"encoder\" below [maddpg] learns what a message is, in place of the sender's observation.
The run directory holds config.toml (fully resolved), metrics.parquet, timings.parquet, TensorBoard events and checkpoint/,
saved every 2000 updates and at the end (`ccmarl list metric` says what each column means). Ctrl-C saves and exits 4;
--resume reads the run's own config.toml and goes on from its last checkpoint, to the same bytes as a run that was never
stopped; with --steps it goes on for longer. Any other changed setting is refused.
--evaluate paper tests the team at the end, as `ccmarl evaluate` does; --evaluate standard tests it on 32 episodes over the
training link every 20000 steps and at the end, then the best of those on 320, over that link and on the eight channels
(evaluation_standard.parquet). A run that goes on removes its earlier tests.";

/// Arguments of `train`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Configuration file (TOML); flags given beside it win
    #[arg(long)]
    config: Option<PathBuf>,
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// Algorithm: a row of the paper [default: cc-maddpg]
    #[arg(long)]
    algorithm: Option<String>,
    /// Environment steps in all [default: 4000000]
    #[arg(long)]
    steps: Option<u64>,
    /// Seed of everything random [default: 1]
    #[arg(long)]
    seed: Option<u64>,
    /// Link prior in training: name or name:value [default: the algorithm's]
    #[arg(long)]
    prior: Option<String>,
    /// Weight of JSD on delivered messages [default: the algorithm's]
    #[arg(long, allow_negative_numbers = true)]
    alpha: Option<f64>,
    /// Weight of CLUB on lost messages [default: the algorithm's]
    #[arg(long, allow_negative_numbers = true)]
    beta: Option<f64>,
    /// Worlds stepped together [default: the episodes between two updates, the same run as with 1; with more, a run
    /// resumed for longer differs from one of that length]
    #[arg(long)]
    envs: Option<usize>,
    /// Tests that belong to the run: none, paper or standard [default: none]
    #[arg(long, value_enum, value_name = "PROTOCOL")]
    evaluate: Option<Evaluate>,
    /// Environment steps between two tests of --evaluate standard [default: 20000]
    #[arg(long, value_name = "STEPS")]
    evaluate_every: Option<u64>,
    /// Run directory to write
    #[arg(long)]
    out: PathBuf,
    /// Store whose episodes fill replay and rings before the first step; messages that encoders make are made anew
    #[arg(long, value_name = "STORE", conflicts_with = "resume")]
    warm_start: Option<PathBuf>,
    /// Store that takes the run's own rollouts; it must not exist, --force does not replace it
    #[arg(long, value_name = "STORE", conflicts_with = "resume")]
    record: Option<PathBuf>,
    /// Go on from the checkpoint in --out, under its own configuration
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    /// Replace the run if it exists
    #[arg(long)]
    force: bool,
    /// How the closing summary is printed
    #[arg(long, value_enum, default_value_t)]
    format: ui::Format,
}

/// The protocols, as words of the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Evaluate {
    /// No test: `ccmarl evaluate` afterwards
    None,
    /// 100 episodes on each of the eight channels at the end
    Paper,
    /// 32 episodes at even intervals, the best team again on 320
    Standard,
}

impl From<Evaluate> for Protocol {
    fn from(word: Evaluate) -> Self {
        match word {
            Evaluate::None => Self::None,
            Evaluate::Paper => Self::Paper,
            Evaluate::Standard => Self::Standard,
        }
    }
}

impl Args {
    /// The configuration: the file's, then the flags'.
    fn config(&self) -> Result<TrainConfig, Error> {
        let own = self.resume.then(|| self.out.join("config.toml"));
        if own.as_ref().is_some_and(|own| !own.exists()) {
            let message = "there is no run to go on with; start it without --resume".to_owned();
            return Err(TrainError::Resume { message, path: self.out.clone() }.into());
        }
        // the file may leave out what a flag says
        let scenario = self.scenario.spec(None)?;
        let given = Given { algorithm: self.algorithm.as_deref(), scenario: scenario.as_ref() };
        let path = self.config.as_deref().or(own.as_deref());
        let file = path.map(|path| TrainConfig::read(path, given)).transpose()?;
        let read = file.clone();
        let mut config = file.unwrap_or_else(|| TrainConfig::new(Spec::new("simple_spread"), "cc-maddpg"));
        if let Some(spec) = self.scenario.spec(Some(config.scenario.clone()))? {
            config.scenario = spec;
        }
        if let Some(algorithm) = &self.algorithm {
            config.algorithm.clone_from(algorithm);
        }
        if let Some(prior) = &self.prior {
            config.prior = Some(Spec::parse("link", LINKS, prior)?);
        }
        config.steps = self.steps.unwrap_or(config.steps);
        config.seed = self.seed.unwrap_or(config.seed);
        config.envs = self.envs.or(config.envs);
        if let Some(protocol) = self.evaluate.map(Protocol::from).filter(|p| *p != config.evaluation.protocol) {
            config.evaluation.protocol = protocol;
            config.evaluation.episodes = None; // each protocol has its own number
        }
        config.evaluation.every = self.evaluate_every.unwrap_or(config.evaluation.every);
        config.dumie.alpha = self.alpha.or(config.dumie.alpha);
        config.dumie.beta = self.beta.or(config.dumie.beta);
        // not before the flags: a prior is of the scenario's agents
        if let (Some(path), Some(read)) = (path, &read) {
            config.check_plugins(path, read)?;
        }
        Ok(config)
    }
}

/// Refuses a store inside the run directory, or around it: each would replace the other.
fn refuse_overlap(out: &Path, record: &Path) -> anyhow::Result<()> {
    let [run, store] = [std::path::absolute(out)?, std::path::absolute(record)?];
    if run.starts_with(&store) || store.starts_with(&run) {
        let message = format!("--record and --out need places of their own, found {}", record.display());
        return Err(Error::Usage(message).into());
    }
    Ok(())
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    crate::storage::refuse_within_store(&args.out).map_err(Error::from)?;
    if let Some(record) = &args.record {
        refuse_overlap(&args.out, record)?;
    }
    let config = args.config()?;
    let log_every = config.log_every;
    let protocol = config.evaluation.protocol;
    if args.evaluate_every.is_some() && protocol != Protocol::Standard {
        let message = "--evaluate-every needs --evaluate standard: no other protocol tests during training";
        return Err(Error::Usage(message.to_owned()).into());
    }
    let stop = stop_flag()?;
    let mut live = ui::Live::new(config.steps, "training");
    let options = Options {
        warm_start: args.warm_start.as_deref(),
        record: args.record.as_deref(),
        resume: args.resume,
        force: args.force,
    };
    let mut progress = |p: train::Progress| live.at(p.step, p.return_mean);
    let report = train::train(config, &args.out, &options, &mut progress, stop).map_err(Error::from)?;
    live.finish();
    let out = args.out.display().to_string();
    match args.format {
        ui::Format::Json => ui::print_json(&json!({"out": out, "report": report}))?,
        ui::Format::Table => {
            let number = |v: Option<f64>| v.map_or_else(|| "none yet".to_owned(), |v| format!("{v:.4}"));
            let rows = [
                ("run", out.clone()),
                ("steps", report.steps.to_string()),
                ("updates", report.updates.to_string()),
                (&*format!("training return, last logged {log_every} updates"), number(report.return_mean)),
                ("loss of next batch", number(report.next_critic_loss)),
            ];
            ui::print_table(&["trained", ""], &rows.map(|(k, v)| vec![k.to_owned(), v]))?;
            if let Some(test) = &report.test {
                let team = if protocol == Protocol::Standard { "best" } else { "last" };
                ui::print(&format!("test of the {team} team, that of step {}", test.trained))?;
                print_channels(&test.channels)?;
            }
        }
    }
    if report.was_finished {
        let (steps, longer) = (report.steps, 2 * report.steps);
        ui::say(&format!(
            "the run was finished, at {steps} steps; to go on for longer: ccmarl train --out {out} --resume --steps {longer}"
        ));
    }
    for name in &report.removed {
        ui::say(&format!("removed {name}: it was of the team before this run went on"));
    }
    if report.interrupted {
        ui::say(&format!("interrupted and saved; go on with: ccmarl train --out {out} --resume"));
        if let Some(store) = &args.record {
            let episodes = report.episodes;
            ui::say(&format!(
                "the store ends here, at {episodes} episodes; what follows is not recorded: {}",
                store.display()
            ));
        }
        return Ok(Outcome::Interrupted);
    }
    if protocol == Protocol::None {
        ui::say(&format!("next: ccmarl evaluate {out} --suite paper"));
    } else {
        ui::say(&format!("next: ccmarl report {out} --out reports/first"));
    }
    Ok(Outcome::Done)
}
