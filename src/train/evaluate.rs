//! Evaluation: a trained team on every channel of a suite, without exploration noise.

use std::path::Path;

use polars::prelude::Column;

use super::config::TrainConfig;
use super::{TrainError, metrics};
use crate::link;
use crate::record::{self, Recording, returns};
use crate::registry::Spec;
use crate::rng::Seeds;
use crate::scenario;

/// Columns of `evaluation.parquet`, one row per test episode.
pub const EVALUATION_COLUMNS: [&str; 9] =
    ["scenario", "agents", "algorithm", "prior", "seed", "channel", "episode", "return", "loss_rate"];

/// One test episode.
#[derive(Clone, Debug, PartialEq)]
pub struct EvaluationRow {
    /// Channel id of the suite.
    pub channel: String,
    /// 0-based.
    pub episode: u64,
    /// Sum of the team reward.
    pub episode_return: f64,
    /// Realised share of lost messages.
    pub loss_rate: f64,
}

/// Plays `episodes` episodes per channel with the policy `policy` in the scenario of `config`; all policies of one
/// seed meet the same episodes. `progress` is told of each finished channel.
///
/// # Errors
/// [`TrainError::Registry`] when policy, scenario or a channel cannot be built, [`TrainError::Record`] when a channel's
/// trace is too short.
pub fn evaluate(
    config: &TrainConfig,
    policy: &Spec,
    channels: &[link::Channel],
    episodes: u64,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<EvaluationRow>, TrainError> {
    let scenario = scenario::build(&config.scenario)?;
    let policy = record::build_policy(policy, scenario.as_ref())?;
    let seed = Seeds::new(config.seed).child("evaluate").seed();
    let mut rows = Vec::new();
    for channel in channels {
        let link = record::build_link(&channel.spec, scenario.as_ref())?;
        record::check_link(link.as_ref(), episodes)?;
        let recording =
            Recording { scenario: scenario.as_ref(), link: link.as_ref(), policy: policy.as_ref(), seed, episodes };
        rows.extend(returns(&recording, 0, episodes).into_iter().enumerate().map(|(i, r)| EvaluationRow {
            channel: channel.id.to_owned(),
            episode: i as u64,
            episode_return: r.episode_return,
            loss_rate: r.loss_rate,
        }));
        progress(channel.id);
    }
    Ok(rows)
}

/// Writes `evaluation.parquet` into the run directory.
///
/// # Errors
/// [`TrainError`].
pub fn write_evaluation(dir: &Path, config: &TrainConfig, rows: &[EvaluationRow]) -> Result<(), TrainError> {
    let n = rows.len();
    let agents = scenario::build(&config.scenario)?.agents().iter().filter(|a| a.learner).count();
    let prior = config.prior.as_ref().map(ToString::to_string).unwrap_or_default();
    let text = |name: &str, value: &str| Column::new(name.into(), vec![value; n]);
    let columns = vec![
        text("scenario", &config.scenario.name),
        Column::new("agents".into(), vec![agents as i64; n]),
        text("algorithm", &config.algorithm),
        text("prior", &prior),
        Column::new("seed".into(), vec![config.seed as i64; n]),
        Column::new("channel".into(), rows.iter().map(|r| r.channel.as_str()).collect::<Vec<_>>()),
        Column::new("episode".into(), rows.iter().map(|r| r.episode as i64).collect::<Vec<_>>()),
        Column::new("return".into(), rows.iter().map(|r| r.episode_return).collect::<Vec<_>>()),
        Column::new("loss_rate".into(), rows.iter().map(|r| r.loss_rate).collect::<Vec<_>>()),
    ];
    metrics::write_parquet(&dir.join("evaluation.parquet"), columns)
}
