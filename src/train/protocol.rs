//! Tests that belong to a run: what is tested, when, and on which episodes.
//!
//! `paper`: when the run ends, 100 episodes on each of the eight channels, into `evaluation.parquet`, as
//! `ccmarl evaluate` does. `standard` (Gorsane et al. 2022): 32 episodes over the training prior at even intervals and
//! when the run ends, then ten times as many of the best policy of those, over the prior and on the eight channels, all
//! into `evaluation_standard.parquet`. The best is chosen over the prior: no test channel is looked at. Test episodes
//! come from a tree of their own, so a run learns the same with and without tests.

use polars::prelude::Column;
use serde::{Deserialize, Serialize};

use super::evaluate::{ChannelSummary, EvaluationRow, columns, evaluate, evaluation_seed, summarise, write_evaluation};
use super::{TrainError, Trainer, checkpoint, metrics};
use crate::link::{Channel, suite};
use crate::record::{ActionNoise, Trained};
use crate::rng::Seeds;

/// Which tests belong to a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Protocol {
    /// None: `ccmarl evaluate` afterwards.
    #[default]
    None,
    /// At the end, on the suite.
    Paper,
    /// At even intervals and at the end, and the best again.
    Standard,
}

/// Tests during training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationConfig {
    /// Which tests belong to the run: none, paper, standard.
    pub protocol: Protocol,
    /// Environment steps between two tests of `standard`, which tests at the end besides. Not a share of `steps`: a
    /// longer run tests at the same places.
    pub every: u64,
    /// Episodes per test and channel; 100 (`paper`) or 32 (`standard`) when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub episodes: Option<u64>,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self { protocol: Protocol::None, every: 20_000, episodes: None }
    }
}

impl EvaluationConfig {
    /// Episodes that the largest test over the training prior plays.
    pub(super) fn over_prior(&self) -> u64 {
        if self.protocol == Protocol::Standard { self.episodes().saturating_mul(RETEST) } else { 0 }
    }

    /// Episodes per test and channel.
    pub fn episodes(&self) -> u64 {
        self.episodes.unwrap_or(if self.protocol == Protocol::Paper { 100 } else { 32 })
    }
}

/// How many times as many episodes the best is tested on.
const RETEST: u64 = 10;

/// The channel id of the link that a run trains over.
const PRIOR: &str = "prior";

/// File of protocol `standard`.
pub(super) const STANDARD_FILE: &str = "evaluation_standard.parquet";

/// The columns that `evaluation_standard.parquet` has beside those of `evaluation.parquet`, each with what it says.
pub const STANDARD_COLUMNS: [(&str, &str); 2] = [
    ("step", "environment steps that had trained the policy"),
    ("best", "whether it is the best policy, tested again at the end on ten times as many episodes"),
];

/// One test episode at an interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TestRow {
    step: u64,
    episode: u64,
    episode_return: f64,
    loss_rate: f64,
}

impl TestRow {
    /// Numbers that a row is in a checkpoint.
    pub(super) const NUMBERS: usize = 4;

    pub(super) fn to_numbers(self) -> [f64; Self::NUMBERS] {
        [self.step as f64, self.episode as f64, self.episode_return, self.loss_rate]
    }

    pub(super) fn from_numbers(numbers: &[f64]) -> Self {
        let at = |i: usize| numbers.get(i).copied().unwrap_or(f64::NAN);
        Self { step: at(0) as u64, episode: at(1) as u64, episode_return: at(2), loss_rate: at(3) }
    }
}

/// The policy with the highest mean return of a test over the prior; no parameters where none was tested.
#[derive(Clone, Debug, Default)]
pub(super) struct Best {
    pub(super) params: Vec<f32>,
    pub(super) mean: f64,
    pub(super) step: u64,
}

/// What the tests found that end a run: of the last team (`paper`) or of the best (`standard`).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LastTest {
    /// Environment steps that had trained the team.
    pub trained: u64,
    /// One line per channel; `prior` is the link of training.
    pub channels: Vec<ChannelSummary>,
}

/// What the tests of a run have found so far.
#[derive(Clone, Debug, Default)]
pub(super) struct Tests {
    pub(super) rows: Vec<TestRow>,
    pub(super) best: Best,
}

impl Trainer {
    /// Tests the policy where the steps since `before` passed a multiple of the interval.
    pub(super) fn test_if_due(&mut self, before: u64) -> Result<(), TrainError> {
        let EvaluationConfig { protocol, every, .. } = self.config.evaluation;
        if protocol != Protocol::Standard || before / every == self.step / every {
            return Ok(());
        }
        let interval = Seeds::new(evaluation_seed(&self.config)).indexed("interval", self.step / every);
        let mut tests = std::mem::take(&mut self.tests);
        let mean = self.test_over_prior(&mut tests, interval.seed());
        self.tests = tests;
        self.means.add("evaluation_return", mean?);
        Ok(())
    }

    /// Tests the policy over the training prior on the episodes of `seed`, and adds what it found; the mean return.
    fn test_over_prior(&self, tests: &mut Tests, seed: u64) -> Result<f64, TrainError> {
        let params = self.learner.params.actors.read().to_vec();
        let found = self.test(&params, &[self.prior_channel()?], self.config.evaluation.episodes(), seed)?;
        let mean = found.iter().map(|r| r.episode_return).sum::<f64>() / found.len() as f64;
        let step = self.step;
        tests.rows.extend(found.iter().map(|r| TestRow {
            step,
            episode: r.episode,
            episode_return: r.episode_return,
            loss_rate: r.loss_rate,
        }));
        if tests.best.params.is_empty() || mean > tests.best.mean {
            tests.best = Best { params, mean, step };
        }
        Ok(mean)
    }

    /// The tests that end a run, into its directory; what they found, where its protocol has any.
    ///
    /// # Errors
    /// [`TrainError`].
    pub fn test_at_end(&self) -> Result<Option<LastTest>, TrainError> {
        let episodes = self.config.evaluation.episodes();
        match self.config.evaluation.protocol {
            Protocol::None => Ok(None),
            Protocol::Paper => {
                let (params, seed) = (self.learner.params.actors.read().to_vec(), evaluation_seed(&self.config));
                let rows = self.test(&params, &suite("paper")?, episodes, seed)?;
                write_evaluation(&self.dir, &self.config, self.learner.actors.len(), &rows)?;
                Ok(Some(LastTest { trained: self.step, channels: summarise(&rows) }))
            }
            Protocol::Standard => {
                let seeds = Seeds::new(evaluation_seed(&self.config));
                // not kept in the checkpoint: a run that goes on from here has no test at this step
                let mut tests = self.tests.clone();
                if tests.rows.last().is_none_or(|row| row.step != self.step) {
                    self.test_over_prior(&mut tests, seeds.child("final").seed())?;
                }
                let mut channels = vec![self.prior_channel()?];
                channels.extend(suite("paper")?);
                let last = self.test(
                    &tests.best.params,
                    &channels,
                    episodes.saturating_mul(RETEST),
                    seeds.child("absolute").seed(),
                )?;
                checkpoint::save_best(self, &tests.best)?;
                self.write_standard(&tests, &last)?;
                Ok(Some(LastTest { trained: tests.best.step, channels: summarise(&last) }))
            }
        }
    }

    fn write_standard(&self, tests: &Tests, last: &[EvaluationRow]) -> Result<(), TrainError> {
        let interval = |r: &TestRow| EvaluationRow {
            channel: PRIOR.to_owned(),
            episode: r.episode,
            episode_return: r.episode_return,
            loss_rate: r.loss_rate,
        };
        let rows: Vec<EvaluationRow> = tests.rows.iter().map(interval).chain(last.iter().cloned()).collect();
        let mut steps: Vec<i64> = tests.rows.iter().map(|r| r.step as i64).collect();
        let intervals = steps.len();
        steps.resize(rows.len(), tests.best.step as i64);
        let mut table = columns(&self.config, self.learner.actors.len(), &rows);
        table.push(Column::new(STANDARD_COLUMNS[0].0.into(), steps));
        let best: Vec<bool> = (0..rows.len()).map(|row| row >= intervals).collect();
        table.push(Column::new(STANDARD_COLUMNS[1].0.into(), best));
        metrics::write_parquet(&self.dir.join(STANDARD_FILE), table)
    }

    fn prior_channel(&self) -> Result<Channel, TrainError> {
        let unresolved = || TrainError::Value { name: "prior".to_owned(), message: "not resolved".to_owned() };
        Ok(Channel { id: PRIOR, spec: self.config.prior.clone().ok_or_else(unresolved)? })
    }

    fn test(
        &self,
        params: &[f32],
        channels: &[Channel],
        episodes: u64,
        seed: u64,
    ) -> Result<Vec<EvaluationRow>, TrainError> {
        let actors = self.learner.actors.clone();
        let team = Trained::new(actors, params, ActionNoise::None, serde_json::Map::new());
        evaluate(self.scenario.as_ref(), &team, channels, episodes, seed, &mut |_| {})
    }
}
