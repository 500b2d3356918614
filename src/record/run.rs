//! # What it is
//! A trained team: the actors of a run directory, with or without exploration noise.
//!
//! # Definition
//! a^i = clamp(π^i(o^i, {ι^{ji} o^j}) + noise, low, 1), low −1, or 0 for decoder `mpe2`; noise is none, Gaussian with standard deviation σ, or the
//! Ornstein–Uhlenbeck process x ← x − θ x + σ z of the training loop, times its scale.
//!
//! # Shapes and units
//! One action row per learner, in \[low, 1\]; the message is the sender's observation.
//!
//! # Parameters
//! `path` (the run directory), `action_noise` (σ, default 0).
//!
//! # When it fails
//! The directory holds no actors, or they were trained for other agents.
//!
//! # Reference
//! Paper, appendix "Parameters Setting"; the noise process is that of the paper's parent code.
//!
//! # Differences from the reference implementation
//! One noise process per component instead of one object shared by all agents and advanced once per agent.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Map, Value};

use super::{Build, Policy, PolicyEpisode, View};
use crate::algo::Actors;
use crate::io::IoError;
use crate::nn::Tape;
use crate::registry::{Entry, RegistryError};
use crate::rng::{self, Seeds, Stream};
use crate::scenario::{Scenario, offsets};
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
        let (actors, values) = Actors::load(&params.path).map_err(|e| RegistryError::Data(e.to_string()))?;
        let low = scenario.space().decoder.low();
        actors.check_fit(&learners(scenario), low, &params.path).map_err(|e| RegistryError::Data(e.to_string()))?;
        let noise =
            if params.action_noise > 0.0 { ActionNoise::Gaussian(params.action_noise) } else { ActionNoise::None };
        let parameters =
            described(&params.path, params.action_noise).map_err(|e| RegistryError::Data(e.to_string()))?;
        Ok(Box::new(Trained { actors, params: values, noise, parameters }))
    },
};

/// What the manifest records: the run's own name and the digest of its actors, so that equal runs at different places
/// give equal stores.
fn described(path: &Path, action_noise: f64) -> Result<Map<String, Value>, IoError> {
    let (sha256, _) = crate::io::sha256_file(&Actors::file(path))?;
    let run = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let fields = [
        ("run", Value::from(run)),
        ("actors_sha256", Value::from(sha256)),
        ("action_noise", Value::from(action_noise)),
    ];
    Ok(super::resolved(ENTRY.name, &fields))
}

fn learners(scenario: &dyn Scenario) -> Vec<&AgentSpec> {
    scenario.agents().iter().filter(|a| a.learner).collect()
}

/// Exploration noise on actions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ActionNoise {
    /// None: the policy as it is.
    None,
    /// Independent normal draws with this standard deviation.
    Gaussian(f64),
    /// x ← x − theta x + sigma z per step, reset each episode, times `scale`.
    OrnsteinUhlenbeck {
        /// Pull towards zero.
        theta: f64,
        /// Standard deviation of a step.
        sigma: f64,
        /// Factor on the process.
        scale: f64,
    },
}

/// A team of actors with their parameters.
#[derive(Clone, Debug)]
pub struct Trained {
    /// Shapes.
    pub actors: Actors,
    /// All actors' parameters, flat.
    pub params: Vec<f32>,
    /// Exploration.
    pub noise: ActionNoise,
    /// What the manifest records.
    pub parameters: Map<String, Value>,
}

impl Policy for Trained {
    fn parameters(&self) -> Map<String, Value> {
        self.parameters.clone()
    }

    fn start<'a>(&'a self, scenario: &'a dyn Scenario, seeds: &Seeds) -> Box<dyn PolicyEpisode + 'a> {
        let agents = scenario.agents();
        let observation_offsets = offsets(agents, |a| a.observation);
        let action_offsets = offsets(agents, |a| a.action);
        let learners: Vec<usize> = (0..agents.len()).filter(|&a| agents[a].learner).collect();
        Box::new(Acting {
            team: self,
            noise: seeds.stream("action-noise"),
            process: vec![0.0; learners.iter().map(|&a| agents[a].action).sum()],
            observation: learners.iter().map(|&a| [observation_offsets[a], observation_offsets[a + 1]]).collect(),
            action: learners.iter().map(|&a| [action_offsets[a], action_offsets[a + 1]]).collect(),
            scenario,
            row: Vec::new(),
            input: Vec::new(),
            tape: Tape::default(),
        })
    }
}

struct Acting<'a> {
    team: &'a Trained,
    scenario: &'a dyn Scenario,
    noise: Stream,
    process: Vec<f64>,
    observation: Vec<[usize; 2]>,
    action: Vec<[usize; 2]>,
    row: Vec<f32>,
    input: Vec<f32>,
    tape: Tape,
}

impl PolicyEpisode for Acting<'_> {
    fn send(&mut self, observations: &[f32], messages: &mut [f32]) {
        super::send_observations(self.scenario.agents(), observations, messages);
    }

    fn act(&mut self, view: &View<'_>, actions: &mut [f32]) {
        self.row.clear();
        for &[from, to] in &self.observation {
            self.row.extend_from_slice(&view.observations[from..to]);
        }
        let mut component = 0;
        for (i, &[from, to]) in self.action.iter().enumerate() {
            self.input.clear();
            self.team.actors.push_input(i, &self.row, view.link, &mut self.input);
            let action = self.team.actors.act(&self.team.params, i, &self.input, 1, &mut self.tape);
            actions[from..to].copy_from_slice(action);
            for action in &mut actions[from..to] {
                let noise = match self.team.noise {
                    ActionNoise::Gaussian(sigma) => sigma * rng::normal(&mut self.noise),
                    ActionNoise::None | ActionNoise::OrnsteinUhlenbeck { scale: 0.0, .. } => continue,
                    ActionNoise::OrnsteinUhlenbeck { theta, sigma, scale } => {
                        let x = &mut self.process[component];
                        *x += sigma * rng::normal(&mut self.noise) - theta * *x;
                        component += 1;
                        scale * *x
                    }
                };
                *action = (*action + noise as f32).clamp(self.team.actors.low(), 1.0);
            }
        }
    }
}
