//! The actors of a team: one network per learner, over its own observation and the messages it received.
//!
//! Input of actor i: `[o_i, ι^{1i} m^{1i}, …]` over the other learners in order; a lost message is zeros. The message
//! is the sender's observation (Message-Dropout's convention).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device};
use candle_nn::VarBuilder;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use sha2::{Digest as _, Sha256};

use crate::nn::{Activation, Mlp, NnError, Tape, from_tensors, to_tensors};
use crate::rng::Stream;
use crate::schema::{AgentSpec, hex};

/// Version of the actor file.
const FILE_VERSION: u32 = 1;

/// Metadata key that holds the [`Header`] as JSON.
const HEADER: &str = "ccmarl.actors";

/// What a reader of the actor file must know beside the tensors.
#[derive(Serialize, Deserialize)]
struct Header {
    version: u32,
    learners: Vec<String>,
    observation: Vec<usize>,
    messages: bool,
    hidden_activation: String,
    output_activation: String,
    /// Environment steps that trained them.
    steps: u64,
    /// The scenario that they were trained in, every constant.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    scenario: Map<String, Value>,
    /// SHA-256 of all parameters in order, little-endian.
    sha256: String,
}

impl Header {
    fn to_json(&self) -> Result<String, NnError> {
        serde_json::to_string(self).map_err(|e| candle_core::Error::Msg(e.to_string()).into())
    }
}

/// What goes wrong with a trained policy on disk.
#[derive(Debug, thiserror::Error)]
pub enum RunPolicyError {
    /// The file is not there, or cannot be read.
    #[error("could not read the trained actors: {message}: {}", path.display())]
    Unreadable {
        /// What is wrong and what to do.
        message: String,
        /// Where.
        path: PathBuf,
    },
    /// The actors were trained for agents of other shapes.
    #[error("the run does not fit this scenario: {message}: {}", path.display())]
    DoesNotFit {
        /// What was expected and found.
        message: String,
        /// Where.
        path: PathBuf,
    },
}

/// SHA-256 of parameters, little-endian, 64 hex digits.
fn digest(params: &[f32]) -> String {
    let mut hash = Sha256::new();
    for value in params {
        hash.update(value.to_le_bytes());
    }
    hex(&hash.finalize())
}

/// One actor network per learner, all parameters in one flat vector.
#[derive(Clone, Debug)]
pub struct Actors {
    /// Names of the learners, in order.
    pub names: Vec<String>,
    /// Width of each learner's observation (and so of its message).
    pub observation: Vec<usize>,
    /// What bounds the actions: tanh or sigmoid.
    pub output: Activation,
    /// Whether messages enter the networks at all.
    pub messages: bool,
    /// One network per learner.
    pub networks: Vec<Mlp>,
    /// Where each network starts in the flat parameters; the total is last.
    pub offsets: Vec<usize>,
    /// Environment steps that trained the parameters these shapes were read with; 0 for fresh ones.
    pub steps: u64,
    /// The scenario that they are trained in, every constant; empty where it is not known.
    pub scenario: Map<String, Value>,
    /// SHA-256 of the file that they were read from; empty for fresh ones.
    pub file_sha256: String,
}

impl Actors {
    /// Actors with hidden `ReLU` layers for these learners. `output` is tanh for actions in [-1, 1], sigmoid for [0, 1].
    pub fn new(learners: &[&AgentSpec], hidden: &[usize], output: Activation, messages: bool) -> Self {
        let observation: Vec<usize> = learners.iter().map(|a| a.observation).collect();
        let all: usize = observation.iter().sum();
        let networks: Vec<Mlp> = learners
            .iter()
            .map(|agent| {
                let input = if messages { all } else { agent.observation };
                let widths: Vec<usize> =
                    std::iter::once(input).chain(hidden.iter().copied()).chain([agent.action]).collect();
                Mlp::new(&widths, Activation::Relu, output)
            })
            .collect();
        let names = learners.iter().map(|a| a.name.clone()).collect();
        Self::assemble(names, observation, output, messages, networks)
    }

    fn assemble(
        names: Vec<String>,
        observation: Vec<usize>,
        output: Activation,
        messages: bool,
        networks: Vec<Mlp>,
    ) -> Self {
        let mut offsets = vec![0];
        for network in &networks {
            offsets.push(offsets[offsets.len() - 1] + network.parameters());
        }
        Self {
            names,
            observation,
            output,
            messages,
            networks,
            offsets,
            steps: 0,
            scenario: Map::new(),
            file_sha256: String::new(),
        }
    }

    /// Learners.
    pub fn len(&self) -> usize {
        self.networks.len()
    }

    /// Whether there is nobody.
    pub fn is_empty(&self) -> bool {
        self.networks.is_empty()
    }

    /// Parameters of all networks together.
    pub fn parameters(&self) -> usize {
        self.offsets[self.len()]
    }

    /// Fresh parameters of all networks.
    pub fn init(&self, rng: &mut Stream) -> Vec<f32> {
        let mut params = Vec::with_capacity(self.parameters());
        for network in &self.networks {
            network.init(rng, &mut params);
        }
        params
    }

    /// The slice of the flat parameters that belongs to actor `i`.
    pub fn slice<'a>(&self, params: &'a [f32], i: usize) -> &'a [f32] {
        &params[self.offsets[i]..self.offsets[i + 1]]
    }

    /// Where the observation of learner `j` starts in a row of all observations.
    pub fn observation_offset(&self, j: usize) -> usize {
        self.observation[..j].iter().sum()
    }

    /// Appends the input of actor `i` for one row: `observations` `[Σ observation]` of all learners, `link` the bits
    /// `[sender][receiver]` of that row.
    pub fn push_input(&self, i: usize, observations: &[f32], link: &[bool], out: &mut Vec<f32>) {
        let own = self.observation_offset(i);
        out.extend_from_slice(&observations[own..own + self.observation[i]]);
        if !self.messages {
            return;
        }
        let mut at = 0;
        for (j, &width) in self.observation.iter().enumerate() {
            if j != i {
                if link[j * self.len() + i] {
                    out.extend_from_slice(&observations[at..at + width]);
                } else {
                    out.resize(out.len() + width, 0.0);
                }
            }
            at += width;
        }
    }

    /// Actions of actor `i` for `rows` inputs, `[rows, action]`, each in (−1, 1); they stay in the tape.
    pub fn act<'t>(&self, params: &[f32], i: usize, input: &[f32], rows: usize, tape: &'t mut Tape) -> &'t [f32] {
        self.networks[i].forward(self.slice(params, i), input, rows, tape)
    }

    /// Writes the actors as safetensors: `actor.<name>.<layer>.weight` `[outputs, inputs]`, `….bias`, and what a
    /// reader must know as metadata; `steps` environment steps trained them.
    ///
    /// # Errors
    /// [`NnError`].
    pub fn to_bytes(&self, params: &[f32], steps: u64) -> Result<Vec<u8>, NnError> {
        let mut tensors = BTreeMap::new();
        for (i, network) in self.networks.iter().enumerate() {
            to_tensors(&format!("actor.{}", self.names[i]), network, self.slice(params, i), &mut tensors)?;
        }
        let header = Header {
            version: FILE_VERSION,
            learners: self.names.clone(),
            observation: self.observation.clone(),
            messages: self.messages,
            hidden_activation: "relu".to_owned(),
            output_activation: if self.low() < 0.0 { "tanh" } else { "sigmoid" }.to_owned(),
            steps,
            scenario: self.scenario.clone(),
            sha256: digest(params),
        };
        // one key only: the crate keeps metadata in a hash map, whose order would change the bytes
        let metadata = [(HEADER.to_owned(), header.to_json()?)];
        Ok(safetensors::serialize(tensors, Some(metadata.into_iter().collect()))?)
    }

    /// The actor file of a run directory; `path` itself when it is a file.
    pub fn file(path: &Path) -> PathBuf {
        if path.is_dir() { path.join("checkpoint").join("actors.safetensors") } else { path.to_owned() }
    }

    /// Reads the actors of a run directory (or an actor file) and their parameters.
    ///
    /// # Errors
    /// [`RunPolicyError::Unreadable`].
    pub fn load(path: &Path) -> Result<(Self, Vec<f32>), RunPolicyError> {
        let file = Self::file(path);
        let fail = |message: String| RunPolicyError::Unreadable { message, path: file.clone() };
        let bytes = std::fs::read(&file)
            .map_err(|e| fail(format!("{e} (give the directory that `ccmarl train --out` wrote)")))?;
        Self::from_bytes(bytes).map_err(fail)
    }

    fn from_bytes(bytes: Vec<u8>) -> Result<(Self, Vec<f32>), String> {
        let file_sha256 = hex(&Sha256::digest(&bytes));
        let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).map_err(|e| e.to_string())?;
        let metadata = header.metadata().clone().unwrap_or_default();
        let json = metadata.get(HEADER).ok_or_else(|| format!("the metadata key {HEADER:?} is missing"))?;
        let Header {
            version, learners: names, observation, messages, output_activation, steps, scenario, sha256, ..
        } = serde_json::from_str(json).map_err(|e| format!("the metadata key {HEADER:?}: {e}"))?;
        let output = match output_activation.as_str() {
            "tanh" => Activation::Tanh,
            "sigmoid" => Activation::Sigmoid,
            other => return Err(format!("output activation must be tanh or sigmoid, found {other:?}")),
        };
        if version != FILE_VERSION {
            return Err(format!("actor file version {version} is not {FILE_VERSION}"));
        }
        if names.len() != observation.len() {
            return Err("as many observation widths as learners are needed".to_owned());
        }
        let mut networks = Vec::new();
        for name in &names {
            let mut widths = Vec::new();
            while let Some(info) = header.info(&format!("actor.{name}.{}.weight", widths.len().saturating_sub(1))) {
                let [outputs, inputs] = info.shape[..] else { return Err("a weight must have two axes".to_owned()) };
                if outputs == 0 || inputs == 0 {
                    return Err("a weight has an empty axis".to_owned());
                }
                if widths.is_empty() {
                    widths.push(inputs);
                }
                widths.push(outputs);
            }
            if widths.len() < 2 {
                return Err(format!("the network of {name:?} is missing"));
            }
            networks.push(Mlp::new(&widths, Activation::Relu, output));
        }
        let builder =
            VarBuilder::from_buffered_safetensors(bytes, DType::F32, &Device::Cpu).map_err(|e| e.to_string())?;
        let mut params = Vec::new();
        for (name, network) in names.iter().zip(&networks) {
            from_tensors(&builder, &format!("actor.{name}"), network, &mut params).map_err(|e| e.to_string())?;
        }
        if digest(&params) != sha256 {
            return Err("its parameters do not match their digest: the file was changed or damaged".to_owned());
        }
        Ok((
            Self { steps, scenario, file_sha256, ..Self::assemble(names, observation, output, messages, networks) },
            params,
        ))
    }

    /// Least value of an action component; the largest is 1.
    pub fn low(&self) -> f32 {
        if self.output == Activation::Sigmoid { 0.0 } else { -1.0 }
    }

    /// Checks that these actors fit the learners of a scenario whose actions are in [`low`, 1].
    ///
    /// # Errors
    /// [`RunPolicyError::DoesNotFit`] that names the first difference.
    pub fn check_fit(&self, learners: &[&AgentSpec], low: f32, path: &Path) -> Result<(), RunPolicyError> {
        let fail = |message: String| Err(RunPolicyError::DoesNotFit { message, path: path.to_owned() });
        if self.low() != low {
            let found = self.low();
            return fail(format!("trained for actions in [{found}, 1], the scenario's decoder takes [{low}, 1]"));
        }
        if learners.len() != self.len() {
            return fail(format!("trained for {} learners, the scenario has {}", self.len(), learners.len()));
        }
        let all: usize = self.observation.iter().sum();
        for (i, agent) in learners.iter().enumerate() {
            let expected = [agent.observation, agent.action];
            let found = [self.observation[i], self.networks[i].outputs()];
            if expected != found || self.networks[i].inputs() != if self.messages { all } else { found[0] } {
                return fail(format!(
                    "{} has observation and action widths {expected:?}, the trained actor {found:?}",
                    agent.name
                ));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;
    use crate::schema::Controller;

    fn agent(name: &str, observation: usize) -> AgentSpec {
        AgentSpec {
            name: name.to_owned(),
            team: "team".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation,
            message: observation,
            action: 2,
        }
    }

    #[test]
    fn a_lost_message_enters_as_zeros_and_the_own_observation_comes_first() {
        let agents = [agent("a", 2), agent("b", 1), agent("c", 2)];
        let actors = Actors::new(&agents.iter().collect::<Vec<_>>(), &[4], Activation::Tanh, true);
        let mut link = [true; 9];
        link[3] = false; // b -> a is lost
        let mut input = Vec::new();
        actors.push_input(0, &[1.0, 2.0, 3.0, 4.0, 5.0], &link, &mut input);
        actors.push_input(1, &[1.0, 2.0, 3.0, 4.0, 5.0], &link, &mut input);
        assert_eq!(input, [1.0, 2.0, 0.0, 4.0, 5.0, 3.0, 1.0, 2.0, 4.0, 5.0]);
    }

    #[test]
    fn actors_survive_their_file_and_damage_is_an_error() {
        let agents = [agent("a", 3), agent("b", 4)];
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let actors = Actors::new(&agents, &[8, 8], Activation::Sigmoid, true);
        let params = actors.init(&mut Seeds::new(1).stream("actors"));
        let bytes = actors.to_bytes(&params, 25).unwrap();
        assert!(bytes == actors.to_bytes(&params, 25).unwrap());
        let (read, again) = Actors::from_bytes(bytes.clone()).unwrap();
        assert_eq!((&again, &read.networks), (&params, &actors.networks));
        assert_eq!((read.steps, read.low()), (25, 0.0));
        for bit in (bytes.len() * 8 - params.len() * 32..bytes.len() * 8).step_by(37) {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(Actors::from_bytes(flipped).is_err_and(|e| e.contains("digest")), "bit {bit}");
        }
        for cut in [0, 7, 8, 100, bytes.len() - 1] {
            assert!(Actors::from_bytes(bytes[..cut].to_vec()).is_err());
        }
        let other = [agent("a", 3), agent("b", 5)];
        let error =
            actors.check_fit(&other.iter().collect::<Vec<_>>(), 0.0, Path::new("runs/x")).unwrap_err().to_string();
        assert!(error.contains("b has observation and action widths [5, 2]"), "{error}");
    }
}
