//! A run in memory: episodes are rolled out in waves of worlds, and the updates that their steps are due follow.
//!
//! A wave's episodes are played together under one set of actors. In the paper's order, one world, several episodes lie
//! between two updates (four of 25 steps at an update per 100): a wave that ends where the next update is due is the
//! same run, to the bit, in less time. Only `envs` that step beyond an update change the order: their updates come
//! late, all of them, when the wave has ended.

use std::path::{Path, PathBuf};

use super::config::{Shaping, TrainConfig};
use super::dumie::Dumie;
use super::metrics::{self, Means, MetricsRow};
use super::protocol::{EvaluationConfig, Protocol, Tests};
use super::replay::{Replay, Ring};
use super::timings::{Clock, Phase};
use super::{TrainError, checkpoint, finite};
use crate::algo::{Batch, Maddpg, MaddpgConfig, Masks};
use crate::link::Link;
use crate::nn::Activation;
use crate::record::{ActionNoise, Recording, Trained, build_link, check_link, loss_rate};
use crate::rng::{Seeds, Stream};
use crate::scenario::{self, Scenario};
use crate::schema::{Episode, Layout, Manifest};
use crate::storage::EpisodeSink;

/// A training run in memory.
pub struct Trainer {
    /// The resolved configuration.
    pub config: TrainConfig,
    pub(super) dir: PathBuf,
    pub(super) scenario: Box<dyn Scenario>,
    prior: Box<dyn Link>,
    pub(super) layout: Layout,
    seeds: Seeds,
    /// The learner.
    pub learner: Maddpg,
    /// Replay memory.
    pub replay: Replay,
    pub(super) dumie: Option<Dumie>,
    /// The learner's actors as they act, and whether their parameters have changed since.
    team: Trained,
    pub(super) stale: bool,
    pub(super) step: u64,
    pub(super) update: u64,
    pub(super) episode: u64,
    pub(super) means: Means,
    pub(super) metrics: Vec<MetricsRow>,
    pub(super) tests: Tests,
    pub(super) clock: Clock,
    pub(super) batch: Batch,
    /// What encoders make of the minibatch, where shaping asks for it.
    pub(super) sent: Vec<f32>,
    bonus: Vec<f32>,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trainer").field("config", &self.config).field("step", &self.step).finish_non_exhaustive()
    }
}

impl Trainer {
    /// A run at its start. `config` must be resolved; `dir` is where checkpoints go.
    ///
    /// # Errors
    /// [`TrainError`] for a scenario without messages between learners, a prior whose trace is too short, or what candle
    /// refuses.
    pub fn new(config: TrainConfig, dir: &Path) -> Result<Self, TrainError> {
        let scenario = scenario::build(&config.scenario)?;
        Self::in_scenario(config, scenario, dir)
    }

    /// The same in a scenario that need not be registered; `config` must be resolved for it.
    ///
    /// # Errors
    /// As [`Trainer::new`].
    pub fn in_scenario(config: TrainConfig, scenario: Box<dyn Scenario>, dir: &Path) -> Result<Self, TrainError> {
        let prior = config.prior.as_ref().ok_or_else(|| TrainError::Value {
            name: "prior".to_owned(),
            message: "the configuration is not resolved".to_owned(),
        })?;
        let prior = build_link(prior, scenario.as_ref())?;
        let episodes = config.steps.div_ceil(scenario.steps() as u64);
        check_link(prior.as_ref(), episodes.max(config.evaluation.over_prior()))?;
        let mut layout = scenario.layout();
        let seeds = Seeds::new(config.seed).child("train");
        let learners: Vec<_> = scenario.agents().iter().filter(|a| a.learner).collect();
        let output = if scenario.space().decoder.low() < 0.0 { Activation::Tanh } else { Activation::Sigmoid };
        let mut learner = Maddpg::new(&learners, output, config.maddpg.clone(), &seeds)?;
        learner.actors.scenario = scenario.parameters();
        let replay = Replay::new(&layout, scenario.steps(), config.replay, learner.actors.encodes())?;
        if learner.actors.encodes() {
            let sent = layout.agents.iter_mut().filter(|a| a.learner).zip(&learner.actors.message);
            sent.for_each(|(agent, width)| agent.message = *width);
        }
        let weights = config.weights();
        let shaped = weights.iter().any(|&w| w > 0.0) && learners.len() > 1;
        let dumie = if shaped { Some(Dumie::new(&layout, config.dumie.clone(), weights, &seeds)?) } else { None };
        let noise = &config.noise;
        let noise = ActionNoise::OrnsteinUhlenbeck {
            theta: noise.theta,
            sigma: noise.sigma,
            scale: noise.scale,
            episodes: noise.episodes,
        };
        let team = Trained::new(learner.actors.clone(), &learner.params.actors.read(), noise, serde_json::Map::new());
        Ok(Self {
            config,
            dir: dir.to_owned(),
            scenario,
            prior,
            layout,
            seeds,
            learner,
            replay,
            dumie,
            team,
            stale: false,
            step: 0,
            update: 0,
            episode: 0,
            means: Means::default(),
            metrics: Vec::new(),
            tests: Tests::default(),
            clock: Clock::default(),
            batch: Batch::default(),
            sent: Vec::new(),
            bonus: Vec::new(),
        })
    }

    /// Environment steps so far.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// The manifest of a store of this run's rollouts.
    pub fn manifest(&self) -> Manifest {
        let policy =
            serde_json::json!({"name": "training", "algorithm": self.config.algorithm, "steps": self.config.steps});
        let (scenario, link) = (self.scenario.parameters().into(), self.prior.parameters().into());
        let planned = self.config.steps.div_ceil(self.scenario.steps() as u64);
        Manifest { planned, ..Manifest::new(self.config.seed, scenario, link, policy, &self.layout) }
    }

    /// Puts an episode into replay and rings, as if it had been rolled out here: the messages in it are those that this
    /// run sends.
    ///
    /// # Errors
    /// [`TrainError::Store`] when it does not fit.
    pub fn observe(&mut self, episode: &Episode) -> Result<(), TrainError> {
        let mut bonus = Vec::new();
        if let Some(dumie) = &mut self.dumie {
            let mut rng = self.seeds.indexed_stream("bonus", self.replay.pushed);
            bonus = dumie.bonus_at_rollout(episode, &mut rng);
            dumie.observe(episode);
        }
        self.replay.push(episode, &bonus)
    }

    /// Episodes that are played before the next update or test may come: at most `envs`, and none beyond the last step.
    fn wave(&self) -> usize {
        let (steps, every) = (self.scenario.steps() as u64, self.config.update_every);
        let envs = self.config.envs() as u64;
        let to_next = |every: u64| (every - self.step % every).div_ceil(steps);
        let EvaluationConfig { protocol, every: tests, .. } = self.config.evaluation;
        let to_test = if protocol == Protocol::Standard { to_next(tests) } else { u64::MAX };
        let until = if envs.saturating_mul(steps) <= every { to_next(every).min(to_test) } else { envs };
        let left = self.config.steps.saturating_sub(self.step).div_ceil(steps).max(1);
        envs.min(until).min(left) as usize
    }

    /// Rolls out the next episodes with the current actors and exploration noise.
    fn rollout(&mut self) -> Vec<Episode> {
        if std::mem::take(&mut self.stale) {
            self.team.set(&self.learner.params.actors.read());
        }
        let recording = Recording {
            scenario: self.scenario.as_ref(),
            link: self.prior.as_ref(),
            policy: &self.team,
            seed: self.seeds.child("rollout").seed(),
            episodes: 0,
        };
        recording.together(&self.layout, self.episode, self.wave())
    }

    /// A wave of episodes, the updates that their steps are due, and the test that is due.
    ///
    /// # Errors
    /// [`TrainError`].
    pub fn advance(&mut self, mut sink: Option<&mut (dyn EpisodeSink + '_)>) -> Result<(), TrainError> {
        self.clock.start();
        let (before, mut due) = (self.step, 0);
        for episode in self.rollout() {
            if let Some(sink) = &mut sink {
                sink.append(&episode)?;
            }
            self.observe(&episode)?;
            self.means.add("return_mean", episode.episode_return());
            self.means.add("loss_rate", loss_rate(&episode, self.learner.actors.len()));
            let updates = self.step / self.config.update_every;
            self.step += episode.steps as u64;
            self.episode += 1;
            if self.step > self.config.warmup {
                due += self.step / self.config.update_every - updates;
            }
        }
        self.clock.stop(Phase::Rollout);
        for _ in 0..due {
            self.learn()?;
        }
        self.clock.stop(Phase::Update);
        self.test_if_due(before)?;
        self.clock.stop(Phase::Evaluation);
        Ok(())
    }

    /// Draws the minibatch of update number `update`.
    fn draw(&mut self, update: u64) -> Stream {
        let mut rng = self.seeds.indexed_stream("update", update);
        let rows = self.config.maddpg.batch.unwrap_or(MaddpgConfig::BATCH);
        self.replay.sample(&mut rng, rows, &mut self.batch);
        rng
    }

    /// Gives the learner the link bits that it is to see, where those are not the rollout's. The Du-MIE has read the
    /// minibatch by then: what a message tells, and whether it arrived, are of the rollout.
    fn redraw_masks(&mut self, update: u64) {
        if self.config.maddpg.masks == Masks::Redrawn {
            self.replay.redraw_links(&mut self.seeds.indexed_stream("masks", update), &mut self.batch);
        }
    }

    /// Critic loss of the minibatch that the next update will draw, on the raw reward; nothing changes.
    pub fn next_critic_loss(&mut self) -> Option<f64> {
        if self.replay.is_empty() {
            return None;
        }
        self.draw(self.update);
        self.redraw_masks(self.update);
        Some(self.learner.td_loss(&self.batch))
    }

    /// Trains the estimators, and makes the bonus of the minibatch at hand.
    fn shape(&mut self, rng: &mut Stream, report: bool) -> Result<(), TrainError> {
        self.bonus.clear();
        self.sent.clear();
        if let Some(dumie) = &mut self.dumie {
            let mut heldout = report.then(|| self.seeds.indexed_stream("heldout", self.update));
            let mut senders = self.learner.senders();
            let found = dumie.train(&self.replay, senders.as_mut(), rng, heldout.as_mut())?;
            for (name, value) in [
                ("jsd", found.jsd),
                ("jsd_heldout", found.jsd_heldout),
                ("club", found.club),
                ("club_heldout", found.club_heldout),
            ] {
                self.means.add(name, value);
            }
            match self.config.dumie.shaping {
                Shaping::Minibatch => {
                    let messages = senders.map_or(&self.batch.observations, |mut senders| {
                        senders.encode(&self.batch.observations, self.batch.rows, &mut self.sent);
                        &self.sent
                    });
                    dumie.bonus(&self.batch, messages, rng, &mut self.bonus);
                }
                Shaping::AtRollout => self.bonus.clone_from(&self.batch.bonus),
            }
            let rows = self.bonus.len() as f64;
            let mean = self.bonus.iter().map(|&b| f64::from(b)).sum::<f64>() / rows;
            let variance = self.bonus.iter().map(|&b| (f64::from(b) - mean).powi(2)).sum::<f64>() / rows;
            self.means.add("shaping_mean", mean);
            self.means.add("shaping_std", variance.sqrt());
        }
        Ok(())
    }

    /// One update of estimators, critic and actors.
    fn learn(&mut self) -> Result<(), TrainError> {
        let mut rng = self.draw(self.update);
        let report = (self.update + 1).is_multiple_of(self.config.log_every);
        self.shape(&mut rng, report)?;
        self.redraw_masks(self.update);
        let found = self.learner.update(&self.batch, &self.bonus)?;
        self.stale = true;
        if !found.is_finite() || !self.bonus.iter().all(|b| b.is_finite()) {
            return Err(self.diverged(format!("{found:?}")));
        }
        self.means.add("td_loss", found.td_loss);
        self.means.add("actor_objective", found.actor_objective);
        self.means.add("q_mean", found.q_mean);
        self.means.add("critic_grad_norm", found.critic_grad_norm);
        self.means.add("actor_grad_norm", found.actor_grad_norm);
        self.means.add("encoder_grad_norm", found.encoder_grad_norm);
        self.update += 1;
        if report {
            let noise = self.team.noise.scale(self.episode);
            self.means.add("noise_scale", noise);
            let values = self.means.take();
            self.metrics.push(MetricsRow { step: self.step, update: self.update, episode: self.episode, values });
            self.clock.log(self.step, self.update);
        }
        Ok(())
    }

    /// The error that ends a run whose numbers are no numbers: the first tensor that holds one, or `otherwise`.
    fn diverged(&self, otherwise: String) -> TrainError {
        let what = finite::first_not_finite(self).unwrap_or(otherwise);
        TrainError::Diverged { step: self.step, update: self.update, what, path: self.dir.clone() }
    }

    /// Writes checkpoint, metrics, timings and `TensorBoard` events.
    ///
    /// # Errors
    /// [`TrainError`].
    pub fn save(&mut self) -> Result<(), TrainError> {
        if finite::first_not_finite(self).is_some() {
            return Err(self.diverged(String::new()));
        }
        self.clock.start();
        metrics::write(&self.dir, &self.metrics)?;
        checkpoint::save(self)?;
        self.clock.stop(Phase::Checkpoint);
        self.clock.write(&self.dir)
    }

    /// Goes to where the checkpoint in the run directory stands.
    ///
    /// # Errors
    /// [`TrainError::Resume`].
    pub fn resume(&mut self) -> Result<(), TrainError> {
        checkpoint::load(self)?;
        self.stale = true;
        self.clock.resume(&self.dir, self.step, self.update);
        Ok(())
    }

    /// The rings of the estimators, those of delivered messages first, where the run has any.
    pub fn rings(&self) -> Option<Vec<&Ring>> {
        self.dumie.as_ref().map(|dumie| dumie.jsd.iter().chain(&dumie.club).map(|e| &e.ring).collect())
    }

    /// The rows of metrics so far.
    pub fn metrics(&self) -> &[MetricsRow] {
        &self.metrics
    }

    /// Mean training return of the last logging interval.
    pub(super) fn return_mean(&self) -> Option<f64> {
        self.metrics.last().and_then(|row| row.values[0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::algo::Messages;
    use crate::registry::Spec;

    /// A run with encoders, up to where its estimators shape.
    fn shaped() -> Trainer {
        let mut config = TrainConfig::new(Spec::new("simple_spread").with("agents", 2), "cc-maddpg");
        (config.maddpg.messages, config.maddpg.message_width, config.maddpg.batch) =
            (Messages::Encoder, Some(3), Some(64));
        (config.dumie.batch, config.dumie.start, config.steps) = (64, 200, 4000);
        let mut trainer = Trainer::new(config.resolve().unwrap(), Path::new("unused")).unwrap();
        while trainer.update < 20 {
            trainer.advance(None).unwrap();
        }
        trainer
    }

    fn bonus(trainer: &mut Trainer) -> Vec<f32> {
        let mut rng = trainer.draw(trainer.update);
        trainer.shape(&mut rng, false).unwrap();
        trainer.bonus.clone()
    }

    #[test]
    fn the_bonus_of_a_minibatch_goes_by_what_the_encoders_of_now_send() {
        let [mut one, mut same, mut other] = [(); 3].map(|()| shaped());
        let encoders = other.learner.actors.encoder_range(0).start..;
        let faster = |params: &mut [f32]| params[encoders].iter_mut().for_each(|p| *p *= 1.5);
        other.learner.params.actors.update(faster).unwrap();
        let [a, b, c] = [&mut one, &mut same, &mut other].map(bonus);
        assert!(a.len() == 64 && a == b && a.iter().any(|&v| v != 0.0), "{a:?}");
        assert!(a.iter().zip(&c).filter(|(a, c)| a != c).count() > 32, "{a:?} and {c:?}");
        // nothing but the messages differs, and they are the encoders'
        let learner = |t: &Trainer| t.dumie.as_ref().unwrap().jsd[0].params.read().to_vec();
        assert_eq!((&one.batch.observations, learner(&one)), (&other.batch.observations, learner(&other)));
        let mut exact = Vec::new();
        other.learner.senders().unwrap().encode(&one.batch.observations, 64, &mut exact);
        assert!(other.sent == exact && one.sent != exact && exact.len() == 64 * 6);
        other.sent[7] = f32::NAN;
        assert_eq!(finite::first_not_finite(&other).unwrap(), "minibatch.messages");
    }
}
