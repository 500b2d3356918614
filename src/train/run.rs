//! The training loop: an episode, then the updates that its steps are due, until the steps are used up.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::config::{Shaping, TrainConfig};
use super::dumie::Dumie;
use super::metrics::{self, Means, MetricsRow};
use super::replay::{Replay, Ring};
use super::{TrainError, checkpoint};
use crate::algo::{Batch, Maddpg, MaddpgConfig, Masks};
use crate::link::Link;
use crate::nn::Activation;
use crate::record::{ActionNoise, Recording, Trained, build_link, check_link, loss_rate};
use crate::rng::Seeds;
use crate::scenario::{self, Scenario};
use crate::schema::{Episode, Layout, Manifest};
use crate::storage::{EpisodeSink, EpisodeSource};

/// Updates between two checkpoints.
const CHECKPOINT_EVERY: u64 = 2000;

/// How a run is started.
#[derive(Debug, Default)]
pub struct Options<'a> {
    /// Store whose episodes fill replay and rings before the first step.
    pub warm_start: Option<&'a Path>,
    /// Store that takes the run's own rollouts.
    pub record: Option<&'a Path>,
    /// Go on from the checkpoint in the run directory.
    pub resume: bool,
    /// Replace what is at the output paths, if it was made by this program.
    pub force: bool,
}

/// Where a run stands, for a progress line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Environment steps so far.
    pub step: u64,
    /// Mean training return of the last logging interval.
    pub return_mean: Option<f64>,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Report {
    /// Environment steps.
    pub steps: u64,
    /// Updates.
    pub updates: u64,
    /// Episodes.
    pub episodes: u64,
    /// Mean training return of the last logging interval, with exploration noise.
    pub return_mean: Option<f64>,
    /// Critic loss of the minibatch that the next update would draw.
    pub next_critic_loss: Option<f64>,
    /// Whether it was stopped before its last step.
    pub interrupted: bool,
}

/// A training run in memory.
pub struct Trainer {
    /// The resolved configuration.
    pub config: TrainConfig,
    pub(super) dir: PathBuf,
    scenario: Box<dyn Scenario>,
    prior: Box<dyn Link>,
    layout: Layout,
    seeds: Seeds,
    /// The learner.
    pub learner: Maddpg,
    /// Replay memory.
    pub replay: Replay,
    pub(super) dumie: Option<Dumie>,
    pub(super) step: u64,
    pub(super) update: u64,
    pub(super) episode: u64,
    pub(super) means: Means,
    pub(super) metrics: Vec<MetricsRow>,
    batch: Batch,
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
        let prior = config.prior.as_ref().ok_or_else(|| TrainError::Value {
            name: "prior".to_owned(),
            message: "the configuration is not resolved".to_owned(),
        })?;
        let prior = build_link(prior, scenario.as_ref())?;
        check_link(prior.as_ref(), config.steps.div_ceil(scenario.steps() as u64))?;
        let layout = scenario.layout();
        let seeds = Seeds::new(config.seed).child("train");
        let learners: Vec<_> = layout.agents.iter().filter(|a| a.learner).collect();
        let output = if scenario.space().decoder.low() < 0.0 { Activation::Tanh } else { Activation::Sigmoid };
        let learner = Maddpg::new(&learners, output, config.maddpg.clone(), &seeds)?;
        let replay = Replay::new(&layout, scenario.steps(), config.replay)?;
        let weights = config.weights();
        let shaped = weights.iter().any(|&w| w > 0.0) && learners.len() > 1;
        let dumie = if shaped { Some(Dumie::new(&layout, config.dumie.clone(), weights, &seeds)?) } else { None };
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
            step: 0,
            update: 0,
            episode: 0,
            means: Means::default(),
            metrics: Vec::new(),
            batch: Batch::default(),
            bonus: Vec::new(),
        })
    }

    /// The manifest of a store of this run's rollouts.
    pub fn manifest(&self) -> Manifest {
        let policy =
            serde_json::json!({"name": "training", "algorithm": self.config.algorithm, "steps": self.config.steps});
        let (scenario, link) = (self.scenario.parameters().into(), self.prior.parameters().into());
        Manifest::new(self.config.seed, scenario, link, policy, &self.layout)
    }

    /// Puts an episode into replay and rings, as if it had been rolled out here.
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

    /// Fills replay and rings from a store, oldest episode first.
    ///
    /// # Errors
    /// [`TrainError::Store`] when its agents or lengths do not fit, [`TrainError::Storage`] when it cannot be read.
    pub fn warm_start(&mut self, source: &mut dyn EpisodeSource) -> Result<u64, TrainError> {
        let (own, other) = (&self.layout.agents, &source.manifest().agents);
        if own != other {
            let at = own.iter().zip(other).position(|(a, b)| a != b).unwrap_or(own.len().min(other.len()));
            let name = |agents: &[crate::schema::AgentSpec]| {
                agents.get(at).map_or_else(
                    || "nobody".to_owned(),
                    |a| {
                        format!(
                            "{} (observation {}, message {}, action {})",
                            a.name, a.observation, a.message, a.action
                        )
                    },
                )
            };
            return Err(TrainError::Store(format!(
                "agent {at} is {} here and {} in the store",
                name(own),
                name(other)
            )));
        }
        if self.dumie.is_none() {
            return self.replay.fill(source); // rings need episodes, replay does not
        }
        let mut episodes = 0;
        while let Some(episode) = source.next_episode()? {
            self.observe(&episode)?;
            episodes += 1;
        }
        Ok(episodes)
    }

    /// Scale of the exploration noise in the episode to come.
    fn noise_scale(&self) -> f64 {
        let noise = &self.config.noise;
        let left = noise.episodes.saturating_sub(self.episode) as f64;
        if noise.episodes == 0 { 0.0 } else { noise.scale * left / noise.episodes as f64 }
    }

    /// Rolls out the next episode with the current actors and exploration noise.
    fn rollout(&self) -> Episode {
        let noise = &self.config.noise;
        let policy = Trained {
            actors: self.learner.actors.clone(),
            params: self.learner.params.actors.read().to_vec(),
            noise: ActionNoise::OrnsteinUhlenbeck { theta: noise.theta, sigma: noise.sigma, scale: self.noise_scale() },
            parameters: serde_json::Map::new(),
        };
        let recording = Recording {
            scenario: self.scenario.as_ref(),
            link: self.prior.as_ref(),
            policy: &policy,
            seed: self.seeds.child("rollout").seed(),
            episodes: 0,
        };
        recording.episode(self.episode)
    }

    /// Draws the minibatch of update number `update`.
    fn draw(&mut self, update: u64) -> crate::rng::Stream {
        let mut rng = self.seeds.indexed_stream("update", update);
        let rows = self.config.maddpg.batch.unwrap_or(MaddpgConfig::BATCH);
        self.replay.sample(&mut rng, rows, &mut self.batch);
        if self.config.maddpg.masks == Masks::Redrawn {
            self.replay.redraw_links(&mut rng, &mut self.batch);
        }
        rng
    }

    /// Critic loss of the minibatch that the next update will draw, on the raw reward; nothing changes.
    pub fn next_critic_loss(&mut self) -> Option<f64> {
        if self.replay.is_empty() {
            return None;
        }
        self.draw(self.update);
        Some(self.learner.td_loss(&self.batch))
    }

    /// One update of estimators, critic and actors.
    fn learn(&mut self) -> Result<(), TrainError> {
        let mut rng = self.draw(self.update);
        let report = (self.update + 1).is_multiple_of(self.config.log_every);
        self.bonus.clear();
        if let Some(dumie) = &mut self.dumie {
            let mut heldout = report.then(|| self.seeds.indexed_stream("heldout", self.update));
            let found = dumie.train(&self.replay, &mut rng, heldout.as_mut())?;
            for (name, value) in [
                ("jsd", found.jsd),
                ("jsd_heldout", found.jsd_heldout),
                ("club", found.club),
                ("club_heldout", found.club_heldout),
            ] {
                self.means.add(name, value);
            }
            match self.config.dumie.shaping {
                Shaping::Minibatch => dumie.bonus(&self.batch, &mut rng, &mut self.bonus),
                Shaping::AtRollout => self.bonus.clone_from(&self.batch.bonus),
            }
            let rows = self.bonus.len() as f64;
            let mean = self.bonus.iter().map(|&b| f64::from(b)).sum::<f64>() / rows;
            let variance = self.bonus.iter().map(|&b| (f64::from(b) - mean).powi(2)).sum::<f64>() / rows;
            self.means.add("shaping_mean", mean);
            self.means.add("shaping_std", variance.sqrt());
        }
        let found = self.learner.update(&self.batch, &self.bonus)?;
        if !found.is_finite() {
            let what = format!("{found:?}");
            return Err(TrainError::Diverged { step: self.step, what, path: self.dir.clone() });
        }
        self.means.add("td_loss", found.td_loss);
        self.means.add("actor_objective", found.actor_objective);
        self.means.add("q_mean", found.q_mean);
        self.means.add("critic_grad_norm", found.critic_grad_norm);
        self.means.add("actor_grad_norm", found.actor_grad_norm);
        self.update += 1;
        if report {
            self.means.add("noise_scale", self.noise_scale());
            let values = self.means.take();
            self.metrics.push(MetricsRow { step: self.step, update: self.update, episode: self.episode, values });
        }
        Ok(())
    }

    /// One episode, and the updates that its steps are due.
    ///
    /// # Errors
    /// [`TrainError`].
    pub fn advance(&mut self, sink: Option<&mut (dyn EpisodeSink + '_)>) -> Result<(), TrainError> {
        let episode = self.rollout();
        if let Some(sink) = sink {
            sink.append(&episode)?;
        }
        self.observe(&episode)?;
        self.means.add("return_mean", episode.episode_return());
        self.means.add("loss_rate", loss_rate(&episode, self.learner.actors.len()));
        let before = self.step / self.config.update_every;
        self.step += episode.steps as u64;
        self.episode += 1;
        if self.step > self.config.warmup {
            for _ in before..self.step / self.config.update_every {
                self.learn()?;
            }
        }
        Ok(())
    }

    /// Writes checkpoint, metrics and `TensorBoard` events.
    ///
    /// # Errors
    /// [`TrainError`].
    pub fn save(&self) -> Result<(), TrainError> {
        let params = &self.learner.params;
        for (what, params) in [("an actor's parameter", &params.actors), ("a critic's parameter", &params.critic)] {
            if !params.read().iter().all(|p| p.is_finite()) {
                let (step, what, path) = (self.step, what.to_owned(), self.dir.clone());
                return Err(TrainError::Diverged { step, what, path });
            }
        }
        metrics::write(&self.dir, &self.metrics)?;
        checkpoint::save(self)
    }

    /// Goes to where the checkpoint in the run directory stands.
    ///
    /// # Errors
    /// [`TrainError::Resume`].
    pub fn resume(&mut self) -> Result<(), TrainError> {
        checkpoint::load(self)
    }

    /// The rings of the estimators, those of delivered messages first, where the run has any.
    pub fn rings(&self) -> Option<Vec<&Ring>> {
        self.dumie.as_ref().map(|dumie| dumie.jsd.iter().chain(&dumie.club).map(|e| &e.ring).collect())
    }

    fn return_mean(&self) -> Option<f64> {
        self.metrics.last().and_then(|row| row.values[0])
    }
}

/// Trains as `config` says into the run directory `dir`, which gets `config.toml`, `metrics.parquet`, `TensorBoard`
/// events and `checkpoint/`. When `stop` turns true the run is saved after the episode at hand and ends.
///
/// # Errors
/// [`TrainError`].
pub fn train(
    config: TrainConfig,
    dir: &Path,
    options: &Options<'_>,
    progress: &mut dyn FnMut(Progress),
    stop: &AtomicBool,
) -> Result<Report, TrainError> {
    let config = config.resolve()?;
    if !options.resume {
        refuse_foreign(dir, options.force)?;
    }
    let mut trainer = Trainer::new(config, dir)?;
    if options.resume {
        trainer.resume()?;
    }
    if let Some(path) = options.warm_start {
        trainer.warm_start(crate::storage::open(path)?.as_mut())?;
    }
    let mut sink = match options.record {
        Some(path) => Some(crate::storage::create(path, &trainer.manifest(), options.force)?),
        None => None,
    };
    // nothing that was there is touched before everything that can be refused has been
    if !options.resume && dir.exists() {
        std::fs::remove_dir_all(dir).map_err(crate::io::IoError::os("replace", dir))?;
    }
    crate::io::write_atomic(&dir.join("config.toml"), trainer.config.to_toml()?.as_bytes())?;
    trainer.save()?;
    let mut saved = trainer.update;
    while trainer.step < trainer.config.steps && !stop.load(Ordering::Relaxed) {
        trainer.advance(sink.as_deref_mut())?;
        if trainer.update - saved >= CHECKPOINT_EVERY {
            trainer.save()?;
            if let Some(sink) = &mut sink {
                sink.commit()?;
            }
            saved = trainer.update;
        }
        progress(Progress { step: trainer.step, return_mean: trainer.return_mean() });
    }
    trainer.save()?;
    if let Some(sink) = sink {
        sink.finish()?;
    }
    Ok(Report {
        steps: trainer.step,
        updates: trainer.update,
        episodes: trainer.episode,
        return_mean: trainer.return_mean(),
        next_critic_loss: trainer.next_critic_loss(),
        interrupted: trainer.step < trainer.config.steps,
    })
}

/// What a run directory may hold; anything else in it is somebody's own.
const RUN_FILES: [&str; 7] = [
    "config.toml",
    "metrics.parquet",
    "timings.parquet",
    "evaluation.parquet",
    "mi.parquet",
    "events.out.tfevents.ccmarl",
    "checkpoint",
];

/// Refuses an output directory that exists, or with `force` one that is not just a run.
fn refuse_foreign(dir: &Path, force: bool) -> Result<(), TrainError> {
    use crate::io::IoError;
    crate::io::refuse_existing(dir, force)?;
    if !dir.exists() {
        return Ok(());
    }
    let mut names = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(IoError::os("list", dir))? {
        names.push(entry.map_err(IoError::os("list", dir))?.file_name());
    }
    let known = names.iter().all(|name| RUN_FILES.iter().any(|file| name == file));
    let run = names.is_empty() || TrainConfig::read(&dir.join("config.toml")).is_ok();
    if known && run { Ok(()) } else { Err(IoError::Foreign(dir.to_owned()).into()) }
}
