//! # What it is
//! A trained team: the actors of a run directory, with or without exploration noise.
//!
//! # Definition
//! a^i = clamp(π^i(o^i, {ι^{ji} m^j}) + noise, low, 1), low −1, or 0 for decoder `mpe2`; m^j is o^j, or `f_j(o^j)` of a team
//! trained with `maddpg.messages = "encoder"`. Noise is none, Gaussian with standard deviation σ, or the
//! Ornstein–Uhlenbeck process x ← x − θ x + σ z of the training loop, times its scale.
//!
//! # Shapes and units
//! One action row per learner, in \[low, 1\]; one message row per learner: its observation, or what its encoder makes of
//! it, in \[−1, 1\].
//!
//! # Parameters
//! `path` (the run directory, or an actor file), `action_noise` (σ, default 0).
//!
//! # When it fails
//! The directory holds no actors, or they were trained in another world: every constant of the scenario must be the
//! same, and each that is not is named.
//!
//! # Reference
//! Paper, appendix "Parameters Setting"; the noise process is that of the paper's parent code.
//!
//! # Differences from the reference implementation
//! One noise process per component instead of one object shared by all agents and advanced once per agent.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Map, Value};

use super::{Build, Policy, PolicyEpisode, View, Widths, part, part_mut};
use crate::algo::{Actors, EncoderScratch, RunPolicyError, Sight, Team, TeamScratch};
use crate::registry::{Entry, RegistryError};
use crate::rng::{self, Seeds, Stream};
use crate::scenario::{self, Scenario, offsets};
use crate::schema::AgentSpec;

/// The policy's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "run",
    summary: "a trained team: run:DIR, the directory that `ccmarl train --out` wrote",
    reference: "Lowe et al. 2017; arXiv 2512.03528, Algorithm 1",
    value: Some("path"),
    build: |spec, scenario| {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Params {
            path: PathBuf,
            #[serde(default)]
            action_noise: f64,
        }
        let params: Params = spec.params()?;
        super::refuse_discrete(spec, scenario)?;
        if !(0.0..=10.0).contains(&params.action_noise) {
            return Err(spec.invalid(format!("action_noise: expected 0 to 10, found {}", params.action_noise)));
        }
        let noise =
            if params.action_noise > 0.0 { ActionNoise::Gaussian(params.action_noise) } else { ActionNoise::None };
        Ok(Box::new(Trained::load(&params.path, scenario, noise)?))
    },
};

/// What the manifest records: the run's own name and the digest of its actors, so that equal runs at different places
/// give equal stores.
fn described(path: &Path, actors: &Actors, action_noise: f64) -> Map<String, Value> {
    let run = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let fields = [
        ("run", Value::from(run)),
        ("actors_sha256", Value::from(actors.file_sha256.clone())),
        ("action_noise", Value::from(action_noise)),
    ];
    super::resolved(ENTRY.name, &fields)
}

/// Exploration noise on actions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ActionNoise {
    /// None: the policy as it is.
    None,
    /// Independent normal draws with this standard deviation.
    Gaussian(f64),
    /// x ← x − theta x + sigma z per step, from zero in each episode, times a factor that falls linearly from `scale` in
    /// episode 0 to zero in episode number `episodes`.
    OrnsteinUhlenbeck {
        /// Pull towards zero.
        theta: f64,
        /// Standard deviation of a step.
        sigma: f64,
        /// Factor on the process in episode 0.
        scale: f64,
        /// Episodes until there is none.
        episodes: u64,
    },
}

impl ActionNoise {
    /// The factor on the process in episode number `episode`; 1 for noise that does not fall, 0 for none.
    pub fn scale(&self, episode: u64) -> f64 {
        match *self {
            Self::None | Self::OrnsteinUhlenbeck { episodes: 0, .. } => 0.0,
            Self::Gaussian(_) => 1.0,
            Self::OrnsteinUhlenbeck { scale, episodes, .. } => {
                scale * episodes.saturating_sub(episode) as f64 / episodes as f64
            }
        }
    }
}

/// A team of actors, laid out for acting on the rows of many worlds at once.
#[derive(Clone, Debug)]
pub struct Trained {
    /// Shapes.
    pub actors: Actors,
    /// Exploration.
    pub noise: ActionNoise,
    team: Team,
    parameters: Map<String, Value>,
}

impl Trained {
    /// A team with these parameters of all its networks; `parameters` is what a manifest records.
    pub fn new(actors: Actors, params: &[f32], noise: ActionNoise, parameters: Map<String, Value>) -> Self {
        let mut team = Team::default();
        team.load_forward(&actors, params);
        Self { actors, noise, team, parameters }
    }

    /// The team of a run directory (or an actor file), which must fit `scenario`.
    ///
    /// # Errors
    /// [`RegistryError::Data`] when it cannot be read or does not fit.
    pub fn load(path: &Path, scenario: &dyn Scenario, noise: ActionNoise) -> Result<Self, RegistryError> {
        let data = |e: RunPolicyError| RegistryError::Data(e.to_string());
        let (actors, values) = Actors::load(path).map_err(data)?;
        let sigma = if let ActionNoise::Gaussian(sigma) = noise { sigma } else { 0.0 };
        let parameters = described(path, &actors, sigma);
        let team = Self::new(actors, &values, noise, parameters);
        team.check_fit(scenario, path).map_err(data)?;
        Ok(team)
    }

    /// Takes over changed parameters.
    pub fn set(&mut self, params: &[f32]) {
        self.team.load_forward(&self.actors, params);
    }

    /// Checks that the team can act in `scenario`, and was trained in the same world where it knows which.
    ///
    /// # Errors
    /// [`RunPolicyError::DoesNotFit`] that names what differs; `path` is where the team came from.
    pub fn check_fit(&self, scenario: &dyn Scenario, path: &Path) -> Result<(), RunPolicyError> {
        let differences = scenario::differences(&self.actors.scenario, scenario, "in training");
        if !differences.is_empty() {
            return Err(RunPolicyError::DoesNotFit { message: differences.join(", "), path: path.to_owned() });
        }
        let learners: Vec<&AgentSpec> = scenario.agents().iter().filter(|a| a.learner).collect();
        self.actors.check_fit(&learners, scenario.space().decoder.low(), path)
    }
}

impl Policy for Trained {
    fn parameters(&self) -> Map<String, Value> {
        self.parameters.clone()
    }

    fn message_width(&self, scenario: &dyn Scenario, agent: usize) -> usize {
        let agents = scenario.agents();
        if !self.actors.encodes() || !agents[agent].learner {
            return agents[agent].message;
        }
        self.actors.message[agents[..agent].iter().filter(|a| a.learner).count()]
    }

    fn start<'a>(&'a self, scenario: &'a dyn Scenario, seeds: &Seeds) -> Box<dyn PolicyEpisode + 'a> {
        self.start_together(scenario, 0, std::slice::from_ref(seeds))
    }

    fn start_together<'a>(
        &'a self,
        scenario: &'a dyn Scenario,
        first: u64,
        nodes: &[Seeds],
    ) -> Box<dyn PolicyEpisode + 'a> {
        let agents = scenario.agents();
        let learners = |ends: &[usize]| -> Vec<[usize; 2]> {
            (0..agents.len()).filter(|&a| agents[a].learner).map(|a| [ends[a], ends[a + 1]]).collect()
        };
        let [observed, acted] = [offsets(agents, |a| a.observation), offsets(agents, |a| a.action)];
        let mut sent = vec![0];
        sent.extend(self.message_widths(scenario).iter().scan(0, |end, width| {
            *end += width;
            Some(*end)
        }));
        let action = learners(&acted);
        let components: usize = action.iter().map(|[from, to]| to - from).sum();
        Box::new(Acting {
            trained: self,
            widths: Widths::of(scenario, self.message_widths(scenario)),
            noise: nodes.iter().map(|seeds| seeds.stream("action-noise")).collect(),
            scale: (0..nodes.len() as u64).map(|i| self.noise.scale(first + i)).collect(),
            process: vec![0.0; nodes.len() * components],
            observation: learners(&observed),
            message: learners(&sent),
            action,
            scenario,
            rows: Vec::new(),
            sent: Vec::new(),
            sending: EncoderScratch::default(),
            scratch: TeamScratch::default(),
        })
    }
}

/// A team in as many worlds as there are streams of noise.
struct Acting<'a> {
    trained: &'a Trained,
    scenario: &'a dyn Scenario,
    widths: Widths,
    noise: Vec<Stream>,
    /// Factor on the noise, per world.
    scale: Vec<f64>,
    /// State of the noise `[worlds, components]`.
    process: Vec<f64>,
    /// Where each learner's observation, message and action lie in a world's row.
    observation: Vec<[usize; 2]>,
    message: Vec<[usize; 2]>,
    action: Vec<[usize; 2]>,
    /// Observations of all learners `[worlds, O]`.
    rows: Vec<f32>,
    /// Messages of all learners `[worlds, M]`, where encoders make them.
    sent: Vec<f32>,
    sending: EncoderScratch,
    scratch: TeamScratch,
}

impl PolicyEpisode for Acting<'_> {
    fn send(&mut self, observations: &[f32], messages: &mut [f32]) {
        let (worlds, w, actors) = (self.noise.len(), self.widths, &self.trained.actors);
        if !actors.encodes() {
            for world in 0..worlds {
                let (seen, sent) = (part(observations, w.observations, world), part_mut(messages, w.messages, world));
                super::send_observations(self.scenario.agents(), seen, sent);
            }
            return;
        }
        gather(&self.observation, observations, w.observations, &mut self.rows);
        self.trained.team.encode(actors, (&self.rows, worlds), &mut self.sending, &mut self.sent);
        let mut sent = &self.sent[..];
        for row in messages.chunks_exact_mut(w.messages) {
            for &[from, to] in &self.message {
                row[from..to].copy_from_slice(&sent[..to - from]);
                sent = &sent[to - from..];
            }
        }
    }

    fn act(&mut self, view: &View<'_>, actions: &mut [f32]) {
        let (worlds, w, actors) = (self.noise.len(), self.widths, &self.trained.actors);
        gather(&self.observation, view.observations, w.observations, &mut self.rows);
        if actors.encodes() {
            gather(&self.message, view.messages, w.messages, &mut self.sent);
        }
        let sight = Sight { observations: &self.rows, messages: &self.sent, link: view.link };
        self.trained.team.act(actors, sight, worlds, &mut self.scratch);
        for (i, &[from, to]) in self.action.iter().enumerate() {
            let chosen = self.scratch.actions(i);
            for (world, action) in chosen.chunks_exact(to - from).enumerate() {
                part_mut(actions, w.actions, world)[from..to].copy_from_slice(action);
            }
        }
        for world in 0..worlds {
            if self.scale[world] != 0.0 {
                self.explore(world, part_mut(actions, w.actions, world));
            }
        }
    }
}

/// The learners' columns of each world's row of `from`, which is `width` wide, side by side.
fn gather(columns: &[[usize; 2]], from: &[f32], width: usize, rows: &mut Vec<f32>) {
    rows.clear();
    for row in from.chunks_exact(width.max(1)) {
        for &[from, to] in columns {
            rows.extend_from_slice(&row[from..to]);
        }
    }
}

impl Acting<'_> {
    /// Adds noise to the actions of one world, learner by learner, component by component.
    fn explore(&mut self, world: usize, actions: &mut [f32]) {
        let components = self.process.len() / self.noise.len();
        let (rng, scale) = (&mut self.noise[world], self.scale[world]);
        let mut process = part_mut(&mut self.process, components, world).iter_mut();
        for &[from, to] in &self.action {
            for (action, x) in actions[from..to].iter_mut().zip(&mut process) {
                let noise = match self.trained.noise {
                    ActionNoise::None => continue,
                    ActionNoise::Gaussian(sigma) => sigma * rng::normal(rng),
                    ActionNoise::OrnsteinUhlenbeck { theta, sigma, .. } => {
                        *x += sigma * rng::normal(rng) - theta * *x;
                        scale * *x
                    }
                };
                *action = (*action + noise as f32).clamp(self.trained.actors.low(), 1.0);
            }
        }
    }
}
