//! A training run's configuration: the TOML a user writes, checked and with every default filled in.

use serde::{Deserialize, Serialize};

use super::TrainError;
use super::protocol::EvaluationConfig;
use crate::algo::{self, Maddpg, MaddpgConfig, Messages};
use crate::registry::Spec;
use crate::scenario::Scenario;

/// Most hidden layers, and most units in one. What all networks take together has a bound of its own.
const WIDEST: [usize; 2] = [16, 4096];

/// Everything a training run depends on. `config.toml` in the run directory is this, fully resolved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Program version that resolved it.
    #[serde(default)]
    pub ccmarl: String,
    /// Root of the seed tree.
    #[serde(default = "one")]
    pub seed: u64,
    /// Environment steps in all.
    #[serde(default = "four_million")]
    pub steps: u64,
    /// Preset, an id of the published tables.
    pub algorithm: String,
    /// Transitions kept in replay.
    #[serde(default = "hundred_thousand")]
    pub replay: usize,
    /// No update before this many steps.
    #[serde(default = "first_update")]
    pub warmup: u64,
    /// One update per this many environment steps.
    #[serde(default = "hundred")]
    pub update_every: u64,
    /// Worlds stepped together, whole episodes each; as many episodes as lie between two updates when absent, which is
    /// the paper's order (one world) to the bit. Beyond that the updates of a wave come when it has ended, and a run that
    /// is resumed for longer is not the one of that length, whose waves end elsewhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub envs: Option<usize>,
    /// One row of metrics per this many updates.
    #[serde(default = "hundred")]
    pub log_every: u64,
    /// Updates between two checkpoints; changes nothing in the result.
    #[serde(default = "two_thousand")]
    pub checkpoint_every: u64,
    /// The scenario and its parameters.
    pub scenario: Spec,
    /// Link prior in training; the preset's when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prior: Option<Spec>,
    /// The learner.
    #[serde(default)]
    pub maddpg: MaddpgConfig,
    /// Exploration noise.
    #[serde(default)]
    pub noise: NoiseConfig,
    /// The dual mutual-information estimator; α and β of the preset and scenario when absent.
    #[serde(default)]
    pub dumie: DumieConfig,
    /// Tests that belong to the run.
    #[serde(default)]
    pub evaluation: EvaluationConfig,
}

fn one() -> u64 {
    1
}
fn hundred() -> u64 {
    100
}
fn two_thousand() -> u64 {
    2000
}
fn first_update() -> u64 {
    1024
}
fn four_million() -> u64 {
    4_000_000
}
fn hundred_thousand() -> usize {
    100_000
}

/// Ornstein–Uhlenbeck exploration noise, added to the tanh output and clamped to [−1, 1].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NoiseConfig {
    /// Pull towards zero per step.
    pub theta: f64,
    /// Standard deviation of a step.
    pub sigma: f64,
    /// Scale in the first episode.
    pub scale: f64,
    /// Episodes over which the scale falls linearly to zero.
    pub episodes: u64,
}

impl Default for NoiseConfig {
    fn default() -> Self {
        Self { theta: 0.15, sigma: 0.2, scale: 0.3, episodes: 25_000 }
    }
}

/// The Du-MIE: what is estimated, and how it shapes the reward.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DumieConfig {
    /// Weight of the JSD value on delivered messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alpha: Option<f64>,
    /// Weight of the CLUB value on lost messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub beta: Option<f64>,
    /// Adam's learning rate for both estimators.
    pub learning_rate: f32,
    /// Pairs in each ring.
    pub ring: usize,
    /// Pairs per estimator step, drawn with replacement.
    pub batch: usize,
    /// An estimator learns and shapes once its ring holds this many pairs.
    pub start: usize,
    /// Estimator steps per update (k of Algorithm 1).
    pub k: usize,
    /// Actions that stand for "independent of the message": a number of cyclic shifts per minibatch, or "all".
    pub negatives: Negatives,
    /// One estimator of each kind for all links ("shared"), or one per ordered link ("per-link").
    pub estimators: Estimators,
    /// What the estimators learn from: their "rings", or all of "replay" by class.
    pub pairs: PairSource,
    /// Where the shaping is computed.
    pub shaping: Shaping,
    /// What CLUB sees of a lost message.
    pub lost_message: LostMessage,
    /// Whether the JSD value is shifted by 2 ln 2 (design: shifted; the paper prints it unshifted).
    pub jsd_shift: bool,
}

/// Actions that stand for "independent of the message".
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "NegativesText", into = "NegativesText")]
pub enum Negatives {
    /// This many derangements of the minibatch's actions, as cyclic shifts.
    Count(usize),
    /// Every action of the minibatch, the parent code's N × N; its own among them for CLUB, not for JSD, as there.
    All,
}

/// How [`Negatives`] are written.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum NegativesText {
    Count(usize),
    Word(String),
}

impl TryFrom<NegativesText> for Negatives {
    type Error = String;

    fn try_from(text: NegativesText) -> Result<Self, String> {
        match text {
            NegativesText::Count(count) => Ok(Self::Count(count)),
            NegativesText::Word(word) if word == "all" => Ok(Self::All),
            NegativesText::Word(word) => Err(format!("expected a number or \"all\", found {word:?}")),
        }
    }
}

impl From<Negatives> for NegativesText {
    fn from(negatives: Negatives) -> Self {
        match negatives {
            Negatives::Count(count) => Self::Count(count),
            Negatives::All => Self::Word("all".to_owned()),
        }
    }
}

/// Who shares an estimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Estimators {
    /// All ordered links: one JSD and one CLUB, messages padded to the longest (the paper's θ₁ and θ₂).
    Shared,
    /// Nobody: each ordered link has its own two, its own rings, and its own minibatches.
    PerLink,
}

/// What the estimators learn from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PairSource {
    /// The newest pairs of either class (the parent code's two buffers).
    Rings,
    /// Pairs of either class drawn from the whole replay (the paper's §3.2.2).
    Replay,
}

/// Where the shaping is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Shaping {
    /// On every minibatch, with the current estimators.
    Minibatch,
    /// Once, when the episode ends, and stored (Algorithm 1 to the letter). Negatives are then actions of the same
    /// episode.
    AtRollout,
}

/// What CLUB sees of a lost message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LostMessage {
    /// The message that was sent (Eq. 4 of the paper).
    Sent,
    /// The zero vector that was received.
    Zero,
}

impl Default for DumieConfig {
    fn default() -> Self {
        Self {
            alpha: None,
            beta: None,
            learning_rate: 1e-4,
            ring: 1000,
            batch: 1024,
            start: 500,
            k: 1,
            negatives: Negatives::Count(16),
            estimators: Estimators::Shared,
            pairs: PairSource::Rings,
            shaping: Shaping::Minibatch,
            lost_message: LostMessage::Sent,
            jsd_shift: true,
        }
    }
}

impl TrainConfig {
    /// A run of `algorithm` on `scenario` with every default.
    pub fn new(scenario: Spec, algorithm: &str) -> Self {
        Self {
            ccmarl: String::new(),
            seed: one(),
            steps: four_million(),
            algorithm: algorithm.to_owned(),
            replay: hundred_thousand(),
            warmup: first_update(),
            update_every: hundred(),
            envs: None,
            log_every: hundred(),
            checkpoint_every: two_thousand(),
            scenario,
            prior: None,
            maddpg: MaddpgConfig::default(),
            noise: NoiseConfig::default(),
            dumie: DumieConfig::default(),
            evaluation: EvaluationConfig::default(),
        }
    }

    /// Fills in what preset and scenario decide, and checks every range.
    ///
    /// # Errors
    /// [`TrainError::Registry`] for unknown names, [`TrainError::Value`] for a value out of its range.
    pub fn resolve(self) -> Result<Self, TrainError> {
        let scenario = crate::scenario::build(&self.scenario)?;
        self.resolve_for(scenario.as_ref())
    }

    /// The same for a scenario that need not be registered.
    ///
    /// # Errors
    /// As [`TrainConfig::resolve`].
    pub fn resolve_for(mut self, scenario: &dyn Scenario) -> Result<Self, TrainError> {
        let preset = algo::preset(&self.algorithm)?;
        env!("CARGO_PKG_VERSION").clone_into(&mut self.ccmarl);
        self.scenario = resolved(scenario.parameters());
        if scenario.space().discrete {
            let message = "this learner's actions are continuous: set it to false".to_owned();
            return Err(TrainError::Value { name: "scenario.discrete".to_owned(), message });
        }
        let prior = self.prior.take().unwrap_or(preset.prior);
        self.prior = Some(resolved(crate::record::build_link(&prior, scenario)?.parameters()));
        let tag = self.scenario.name == "simple_tag";
        let [alpha, beta] = if preset.shaped { [0.01, if tag { 0.001 } else { 0.01 }] } else { [0.0, 0.0] };
        let team: Vec<_> = scenario.agents().iter().filter(|a| a.learner).collect();
        let learners = team.len();
        self.maddpg.batch.get_or_insert(MaddpgConfig::batch_of(&self.scenario.name, learners));
        self.dumie.alpha.get_or_insert(alpha);
        self.dumie.beta.get_or_insert(beta);
        for (name, weight) in ["dumie.alpha", "dumie.beta"].into_iter().zip(self.weights()) {
            if !preset.shaped && weight > 0.0 {
                let prior = self.prior.as_ref().map(ToString::to_string).unwrap_or_default();
                let message = format!(
                    "{} is not shaped, found {weight}: take cc-maddpg with --prior {prior}, so that no table calls a \
                     shaped run {0}",
                    self.algorithm
                );
                return Err(TrainError::Value { name: name.to_owned(), message });
            }
        }
        let between = self.update_every / (scenario.steps() as u64).max(1);
        self.envs.get_or_insert(between.clamp(1, 64) as usize);
        self.evaluation.episodes = Some(self.evaluation.episodes());
        self.resolve_encoders(learners)?;
        self.check()?;
        let (parameters, most) = (Maddpg::parameters(&team, &self.maddpg), MaddpgConfig::MOST_PARAMETERS);
        if parameters > most {
            let message =
                format!("expected at most {most} parameters in all networks, found {parameters}: make layers narrower");
            return Err(TrainError::Value { name: "maddpg.hidden".to_owned(), message });
        }
        Ok(self)
    }

    /// Fills in the shape of the encoders, or refuses one where there are none.
    fn resolve_encoders(&mut self, learners: usize) -> Result<(), TrainError> {
        let m = &mut self.maddpg;
        let fail = |name: &str, message: String| Err(TrainError::Value { name: format!("maddpg.{name}"), message });
        if m.messages == Messages::Encoder {
            if learners < 2 {
                let message =
                    format!("an encoder learns through who hears it, found {learners} learner: set \"observation\"");
                return fail("messages", message);
            }
            m.message_width.get_or_insert(MaddpgConfig::MESSAGE_WIDTH);
            m.encoder_hidden.get_or_insert_with(|| MaddpgConfig::ENCODER_HIDDEN.to_vec());
            return Ok(());
        }
        let shapes = [("message_width", m.message_width.is_some()), ("encoder_hidden", m.encoder_hidden.is_some())];
        match shapes.into_iter().find(|(_, given)| *given) {
            None => Ok(()),
            Some((name, _)) => fail(name, "it shapes encoders: set messages = \"encoder\", or leave it out".to_owned()),
        }
    }

    /// Worlds stepped together; 1 before [`TrainConfig::resolve`] where not given.
    pub fn envs(&self) -> usize {
        self.envs.unwrap_or(1)
    }

    /// α and β; zero before [`TrainConfig::resolve`] where not given.
    pub fn weights(&self) -> [f64; 2] {
        [self.dumie.alpha.unwrap_or(0.0), self.dumie.beta.unwrap_or(0.0)]
    }

    fn check(&self) -> Result<(), TrainError> {
        let (m, d, n) = (&self.maddpg, &self.dumie, &self.noise);
        let positive =
            |name: &'static str, value: usize| (name, value > 0, format!("expected at least 1, found {value}"));
        let unit = |name: &'static str, value: f32| {
            (name, (0.0..=1.0).contains(&value), format!("expected a value in [0, 1], found {value}"))
        };
        let rate = |name: &'static str, value: f32| {
            (name, value > 0.0 && value.is_finite(), format!("expected a positive number, found {value}"))
        };
        let weight = |name: &'static str, value: f64| {
            (name, value >= 0.0 && value.is_finite(), format!("expected a number ≥ 0, found {value}"))
        };
        let [alpha, beta] = self.weights();
        let layers = |name: &'static str, widths: &[usize]| {
            let fits = widths.len() <= WIDEST[0] && widths.iter().all(|w| (1..=WIDEST[1]).contains(w));
            (name, fits, format!("expected at most {} layers of 1 to {} units, found {widths:?}", WIDEST[0], WIDEST[1]))
        };
        let rules = [
            layers("maddpg.encoder_hidden", m.encoder_hidden.as_deref().unwrap_or(&[])),
            (
                "maddpg.message_width",
                m.message_width.is_none_or(|w| (1..=WIDEST[1]).contains(&w)),
                format!("expected 1 to {}, found {}", WIDEST[1], m.message_width.unwrap_or(0)),
            ),
            positive("steps", self.steps as usize),
            positive("replay", self.replay),
            positive("update_every", self.update_every as usize),
            positive("log_every", self.log_every as usize),
            positive("checkpoint_every", self.checkpoint_every as usize),
            ("envs", (1..=4096).contains(&self.envs()), format!("expected 1 to 4096, found {}", self.envs())),
            positive("evaluation.every", self.evaluation.every as usize),
            positive("evaluation.episodes", self.evaluation.episodes() as usize),
            positive("maddpg.batch", m.batch.unwrap_or(0)),
            positive("maddpg.hidden", m.hidden.iter().copied().min().unwrap_or(0)),
            layers("maddpg.hidden", &m.hidden),
            unit("maddpg.gamma", m.gamma),
            unit("maddpg.tau", m.tau),
            rate("maddpg.actor_learning_rate", m.actor_learning_rate),
            rate("maddpg.critic_learning_rate", m.critic_learning_rate),
            rate("maddpg.grad_clip", m.grad_clip),
            weight("maddpg.action_penalty", f64::from(m.action_penalty)),
            weight("noise.theta", n.theta),
            weight("noise.sigma", n.sigma),
            weight("noise.scale", n.scale),
            weight("dumie.alpha", alpha),
            weight("dumie.beta", beta),
            rate("dumie.learning_rate", d.learning_rate),
            positive("dumie.ring", d.ring),
            positive("dumie.negatives", if let Negatives::Count(count) = d.negatives { count } else { 1 }),
            positive("dumie.k", d.k),
            ("dumie.batch", d.batch > 1, format!("expected at least 2, found {}", d.batch)),
            (
                "dumie.start",
                (2..=d.ring).contains(&d.start),
                format!("expected 2 to ring ({}), found {}", d.ring, d.start),
            ),
        ];
        match rules.into_iter().find(|(_, ok, _)| !ok) {
            None => Ok(()),
            Some((name, _, message)) => Err(TrainError::Value { name: name.to_owned(), message }),
        }
    }

    /// The resolved configuration as TOML.
    ///
    /// # Errors
    /// [`TrainError::Value`] when it cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String, TrainError> {
        toml::to_string(self).map_err(|e| TrainError::Value { name: "config".to_owned(), message: e.to_string() })
    }
}

/// A plugin's resolved parameters, which carry its name, as a spec.
fn resolved(mut parameters: serde_json::Map<String, serde_json::Value>) -> Spec {
    let name = match parameters.shift_remove("name") {
        Some(serde_json::Value::String(name)) => name,
        _ => String::new(),
    };
    parameters.retain(|_, value| !value.is_null());
    Spec { name, params: parameters }
}
