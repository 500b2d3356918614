//! Evaluation: a team on every channel of a suite, without exploration noise; and the table of what it earned.

use std::path::Path;

use polars::prelude::Column;

use super::config::TrainConfig;
use super::{TrainError, metrics};
use crate::link;
use crate::record::{self, Policy, Recording, returns};
use crate::rng::Seeds;
use crate::scenario::Scenario;
use crate::stats::{mean, sd};

/// File of the tests that `ccmarl evaluate` and protocol `paper` make.
pub(super) const EVALUATION_FILE: &str = "evaluation.parquet";

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

/// What the test episodes on one channel say.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ChannelSummary {
    /// Channel id.
    pub channel: String,
    /// Mean return.
    pub return_mean: f64,
    /// Standard deviation of the return over episodes.
    pub return_std: f64,
    /// Mean share of lost messages.
    pub loss_rate: f64,
    /// Episodes.
    pub episodes: usize,
}

/// One line per channel, in the order in which they were tested.
pub fn summarise(rows: &[EvaluationRow]) -> Vec<ChannelSummary> {
    let same = rows.chunk_by(|a, b| a.channel == b.channel);
    same.map(|rows| {
        let of = |value: fn(&EvaluationRow) -> f64| rows.iter().map(value).collect::<Vec<f64>>();
        let returns = of(|r| r.episode_return);
        ChannelSummary {
            channel: rows[0].channel.clone(),
            return_mean: mean(&returns),
            return_std: sd(&returns),
            loss_rate: mean(&of(|r| r.loss_rate)),
            episodes: rows.len(),
        }
    })
    .collect()
}

/// The seed of a run's test episodes: a tree of its own, so that tests disturb no training. All policies of one seed
/// meet the same episodes.
pub fn evaluation_seed(config: &TrainConfig) -> u64 {
    Seeds::new(config.seed).child("evaluate").seed()
}

/// Plays `episodes` episodes per channel, those of `seed`. `progress` is told of each finished channel.
///
/// # Errors
/// [`TrainError::Registry`] when a channel cannot be built, [`TrainError::Record`] when its trace is too short.
pub fn evaluate(
    scenario: &dyn Scenario,
    policy: &dyn Policy,
    channels: &[link::Channel],
    episodes: u64,
    seed: u64,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<EvaluationRow>, TrainError> {
    let mut rows = Vec::new();
    for channel in channels {
        let link = record::build_link(&channel.spec, scenario)?;
        record::check_link(link.as_ref(), episodes)?;
        let recording = Recording { scenario, link: link.as_ref(), policy, seed, episodes };
        rows.extend(returns(&recording, 0, episodes).into_iter().zip(0..).map(|(r, episode)| EvaluationRow {
            channel: channel.id.to_owned(),
            episode,
            episode_return: r.episode_return,
            loss_rate: r.loss_rate,
        }));
        progress(channel.id);
    }
    Ok(rows)
}

/// Writes `evaluation.parquet` into the run directory; `learners` is how many agents learned.
///
/// # Errors
/// [`TrainError`].
pub fn write_evaluation(
    dir: &Path,
    config: &TrainConfig,
    learners: usize,
    rows: &[EvaluationRow],
) -> Result<(), TrainError> {
    metrics::write_parquet(&dir.join(EVALUATION_FILE), columns(config, learners, rows))
}

/// [`EVALUATION_COLUMNS`] of these rows.
pub(super) fn columns(config: &TrainConfig, learners: usize, rows: &[EvaluationRow]) -> Vec<Column> {
    let n = rows.len();
    let prior = config.prior.as_ref().map(ToString::to_string).unwrap_or_default();
    let text = |name: &str, value: &str| Column::new(name.into(), vec![value; n]);
    vec![
        text("scenario", &config.scenario.name),
        Column::new("agents".into(), vec![learners as i64; n]),
        text("algorithm", &config.algorithm),
        text("prior", &prior),
        Column::new("seed".into(), vec![config.seed as i64; n]),
        Column::new("channel".into(), rows.iter().map(|r| r.channel.as_str()).collect::<Vec<_>>()),
        Column::new("episode".into(), rows.iter().map(|r| r.episode as i64).collect::<Vec<_>>()),
        Column::new("return".into(), rows.iter().map(|r| r.episode_return).collect::<Vec<_>>()),
        Column::new("loss_rate".into(), rows.iter().map(|r| r.loss_rate).collect::<Vec<_>>()),
    ]
}
