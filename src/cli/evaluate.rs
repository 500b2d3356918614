//! `ccmarl evaluate`: a trained team on every channel of a suite.

use std::path::PathBuf;

use serde_json::json;

use super::args::end_on_signals;
use super::{Outcome, ui};
use crate::Error;
use crate::io::IoError;
use crate::link::suite;
use crate::record::{ActionNoise, Trained};
use crate::scenario;
use crate::train::{ChannelSummary, TrainConfig, evaluate, evaluation_seed, summarise, write_evaluation};

const EXAMPLES: &str = "\
Examples:
  ccmarl evaluate runs/x --suite paper --episodes 100
  ccmarl evaluate runs/x --episodes 1000 --format json

Actions carry no exploration noise. Every policy of one seed meets the same episodes. Writes evaluation.parquet (one row
per test episode) into the run directory; an older one is replaced.";

/// Arguments of `evaluate`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Run directory that `ccmarl train` wrote
    run: PathBuf,
    /// Test channels
    #[arg(long, default_value = "paper")]
    suite: String,
    /// Test episodes per channel
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// How results are printed
    #[arg(long, value_enum, default_value_t)]
    format: ui::Format,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    let file = args.run.join("config.toml");
    if args.run.exists() && !file.exists() {
        let message = "not a run directory (it holds no config.toml); give what `ccmarl train --out` wrote";
        anyhow::bail!("{message}: {}", args.run.display());
    }
    if !file.exists() {
        return Err(Error::from(IoError::Missing(args.run.clone())).into());
    }
    // the prior is not built: the tests need none, and the trace of one may have moved
    let config = TrainConfig::parse(&file).map_err(Error::from)?;
    let scenario = scenario::build(&config.scenario).map_err(Error::from)?;
    let team = Trained::load(&args.run, &*scenario, ActionNoise::None).map_err(Error::from)?;
    let trained = team.actors.steps;
    if trained < config.steps {
        ui::say(&format!(
            "warning: trained for {trained} of {} steps; go on with `ccmarl train --resume`",
            config.steps
        ));
    }
    let channels = suite(&args.suite).map_err(Error::from)?;
    let bar = ui::progress(channels.len() as u64, "channels");
    let seed = evaluation_seed(&config);
    let rows = evaluate(&*scenario, &team, &channels, args.episodes, seed, &mut |_| bar.inc(1)).map_err(Error::from)?;
    bar.finish_and_clear();
    write_evaluation(&args.run, &config, team.actors.len(), &rows).map_err(Error::from)?;

    let channels = summarise(&rows);
    match args.format {
        ui::Format::Json => {
            ui::print_json(&json!({"run": args.run.display().to_string(), "algorithm": config.algorithm,
                "scenario": config.scenario, "seed": config.seed, "channels": channels}))?;
        }
        ui::Format::Table => {
            print_channels(&channels)?;
            ui::say(&format!("return: {}", scenario.reward_convention()));
        }
    }
    Ok(Outcome::Done)
}

/// Prints one line per channel.
pub(super) fn print_channels(channels: &[ChannelSummary]) -> anyhow::Result<()> {
    let line = |c: &ChannelSummary| {
        vec![
            c.channel.clone(),
            format!("{:.1}", c.return_mean),
            if c.episodes > 1 { format!("{:.1}", c.return_std) } else { "one episode".to_owned() },
            format!("{:.1} %", 100.0 * c.loss_rate),
            c.episodes.to_string(),
        ]
    };
    let rows: Vec<Vec<String>> = channels.iter().map(line).collect();
    ui::print_table(&["channel", "return", "± over episodes", "messages lost", "episodes"], &rows)
}
