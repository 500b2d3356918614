//! `ccmarl train`: a learner on a scenario over a link prior, into a run directory.

use std::path::PathBuf;

use serde_json::json;

use super::args::{ScenarioArgs, stop_flag};
use super::{Outcome, ui};
use crate::Error;
use crate::link::LINKS;
use crate::registry::Spec;
use crate::train::{self, Options, TrainConfig};

const EXAMPLES: &str = "\
Examples:
  ccmarl train --scenario simple_spread --algorithm cc-maddpg --steps 400000 --seed 1 --out runs/x
  ccmarl train --scenario simple_tag --agents 6 --algorithm cc-maddpg --prior markov:heavy --out runs/matched
  ccmarl train --config run.toml --out runs/y
  ccmarl train --out runs/x --resume

Without --scenario and --config it is simple_spread with 3 agents.
The run directory holds config.toml (fully resolved), metrics.parquet, TensorBoard events and checkpoint/, saved every
2000 updates and at the end. Ctrl-C saves and exits 4; --resume reads the run's own config.toml and goes on from its last
checkpoint, to the same bytes as a run that was never stopped.";

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
    #[arg(long)]
    alpha: Option<f64>,
    /// Weight of CLUB on lost messages [default: the algorithm's]
    #[arg(long)]
    beta: Option<f64>,
    /// Run directory to write
    #[arg(long)]
    out: PathBuf,
    /// Store whose episodes fill replay and rings before the first step
    #[arg(long, value_name = "STORE", conflicts_with = "resume")]
    warm_start: Option<PathBuf>,
    /// Store that takes the run's own rollouts
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

impl Args {
    /// The configuration: the file's, then the flags'.
    fn config(&self) -> Result<TrainConfig, Error> {
        let own = self.resume.then(|| self.out.join("config.toml"));
        let file = self.config.as_deref().or(own.as_deref()).map(TrainConfig::read).transpose()?;
        let spec = self.scenario.spec(file.as_ref().map(|c| c.scenario.clone()))?;
        let spec = spec.unwrap_or_else(|| Spec::new("simple_spread"));
        let mut config = file.unwrap_or_else(|| TrainConfig::new(spec.clone(), "cc-maddpg"));
        config.scenario = spec;
        if let Some(algorithm) = &self.algorithm {
            config.algorithm.clone_from(algorithm);
        }
        if let Some(prior) = &self.prior {
            config.prior = Some(Spec::parse("link", LINKS, prior)?);
        }
        config.steps = self.steps.unwrap_or(config.steps);
        config.seed = self.seed.unwrap_or(config.seed);
        config.dumie.alpha = self.alpha.or(config.dumie.alpha);
        config.dumie.beta = self.beta.or(config.dumie.beta);
        Ok(config)
    }
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let config = args.config()?;
    let stop = stop_flag()?;
    let bar = ui::progress(config.steps, "training");
    let options = Options {
        warm_start: args.warm_start.as_deref(),
        record: args.record.as_deref(),
        resume: args.resume,
        force: args.force,
    };
    let mut progress = |p: train::Progress| {
        bar.set_position(p.step);
        if let Some(mean) = p.return_mean {
            bar.set_message(format!("return {mean:8.1}"));
        }
    };
    let report = train::train(config, &args.out, &options, &mut progress, stop).map_err(Error::from)?;
    bar.finish_and_clear();
    let out = args.out.display().to_string();
    match args.format {
        ui::Format::Json => ui::print_json(&json!({"out": out, "report": report}))?,
        ui::Format::Table => {
            let number = |v: Option<f64>| v.map_or_else(|| "none yet".to_owned(), |v| format!("{v:.4}"));
            let rows = [
                ("run", out.clone()),
                ("steps", report.steps.to_string()),
                ("updates", report.updates.to_string()),
                ("training return", number(report.return_mean)),
                ("loss of next batch", number(report.next_critic_loss)),
            ];
            ui::print_table(&["trained", ""], &rows.map(|(k, v)| vec![k.to_owned(), v]))?;
        }
    }
    if report.interrupted {
        ui::say(&format!("interrupted and saved; go on with: ccmarl train --out {out} --resume"));
        return Ok(Outcome::Interrupted);
    }
    ui::say(&format!("next: ccmarl evaluate {out} --suite paper"));
    Ok(Outcome::Done)
}
