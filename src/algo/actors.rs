//! The actors of a team: one network per learner, over its own observation and the messages it received.
//!
//! Input of actor i: `[o_i, ι^{1i} m^{1i}, …]` over the other learners in order; a lost message is zeros. The message
//! is the sender's observation (Message-Dropout's convention), or `m^j = f_j(o^j)` of the sender's encoder, whose tanh
//! keeps it in [−1, 1].

use std::ops::Range;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::config::{MaddpgConfig, Messages};
use crate::nn::{Activation, Mlp, Tape};
use crate::rng::Stream;
use crate::schema::AgentSpec;

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

/// One actor network per learner, and one encoder where messages are encoded; all parameters in one flat vector, the
/// actors' first.
#[derive(Clone, Debug)]
pub struct Actors {
    /// Names of the learners, in order.
    pub names: Vec<String>,
    /// Width of each learner's observation.
    pub observation: Vec<usize>,
    /// Width of what each learner sends: its observation, or its encoder's output.
    pub message: Vec<usize>,
    /// What bounds the actions: tanh or sigmoid.
    pub output: Activation,
    /// What a message is, and whether messages enter the networks at all.
    pub messages: Messages,
    /// One network per learner.
    pub networks: Vec<Mlp>,
    /// One encoder per learner, or none.
    pub encoders: Vec<Mlp>,
    /// Where each network, then each encoder, starts in the flat parameters; the total is last.
    pub(super) offsets: Vec<usize>,
    /// Environment steps that trained the parameters these shapes were read with; 0 for fresh ones.
    pub steps: u64,
    /// The scenario that they are trained in, every constant; empty where it is not known.
    pub scenario: Map<String, Value>,
    /// SHA-256 of the file that they were read from; empty for fresh ones.
    pub file_sha256: String,
}

impl Actors {
    /// Actors for these learners, hidden layers and messages as `config` says. `output` is tanh for actions in [-1, 1],
    /// sigmoid for [0, 1].
    pub fn new(learners: &[&AgentSpec], output: Activation, config: &MaddpgConfig) -> Self {
        let observation: Vec<usize> = learners.iter().map(|a| a.observation).collect();
        let network = |input: usize, hidden: &[usize], outputs: usize, output| {
            let widths: Vec<usize> = [input].into_iter().chain(hidden.iter().copied()).chain([outputs]).collect();
            Mlp::new(&widths, Activation::Relu, output)
        };
        let mut encoders = Vec::new();
        if config.messages == Messages::Encoder {
            let hidden = config.encoder_hidden.as_deref().unwrap_or(&MaddpgConfig::ENCODER_HIDDEN);
            let width = config.message_width.unwrap_or(MaddpgConfig::MESSAGE_WIDTH);
            encoders = observation.iter().map(|&input| network(input, hidden, width, Activation::Tanh)).collect();
        }
        let names = learners.iter().map(|a| a.name.clone()).collect();
        let mut actors = Self::assemble(names, observation, output, config.messages, [Vec::new(), encoders]);
        let networks = learners.iter().enumerate();
        let networks = networks.map(|(i, a)| network(actors.input(i), &config.hidden, a.action, output)).collect();
        let encoders = std::mem::take(&mut actors.encoders);
        Self::assemble(actors.names, actors.observation, output, config.messages, [networks, encoders])
    }

    /// Actors of these networks and encoders, fresh, in no scenario.
    pub(super) fn assemble(
        names: Vec<String>,
        observation: Vec<usize>,
        output: Activation,
        messages: Messages,
        [networks, encoders]: [Vec<Mlp>; 2],
    ) -> Self {
        let mut offsets = vec![0];
        for network in networks.iter().chain(&encoders) {
            offsets.push(offsets[offsets.len() - 1] + network.parameters());
        }
        let sent = encoders.iter().map(Mlp::outputs).collect();
        Self {
            names,
            message: if encoders.is_empty() { observation.clone() } else { sent },
            observation,
            output,
            messages,
            networks,
            encoders,
            offsets,
            steps: 0,
            scenario: Map::new(),
            file_sha256: String::new(),
        }
    }

    /// Width of actor `i`'s input.
    pub(super) fn input(&self, i: usize) -> usize {
        self.observation[i] + self.heard(i)
    }

    /// Width of what actor `i` hears, of all others together.
    pub(super) fn heard(&self, i: usize) -> usize {
        let others = self.message.iter().enumerate().filter(|(j, _)| *j != i);
        if self.messages == Messages::Off { 0 } else { others.map(|(_, width)| width).sum() }
    }

    /// Whether messages are made by encoders.
    pub fn encodes(&self) -> bool {
        !self.encoders.is_empty()
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
        self.offsets[self.offsets.len() - 1]
    }

    /// Fresh parameters of all networks.
    pub fn init(&self, rng: &mut Stream) -> Vec<f32> {
        let mut params = Vec::with_capacity(self.parameters());
        for network in self.networks.iter().chain(&self.encoders) {
            network.init(rng, &mut params);
        }
        params
    }

    /// Where actor `i` lies in the flat parameters.
    pub fn range(&self, i: usize) -> Range<usize> {
        self.offsets[i]..self.offsets[i + 1]
    }

    /// Where learner `j`'s encoder lies in the flat parameters.
    pub fn encoder_range(&self, j: usize) -> Range<usize> {
        self.range(self.len() + j)
    }

    /// The slice of the flat parameters that belongs to actor `i`.
    pub fn slice<'a>(&self, params: &'a [f32], i: usize) -> &'a [f32] {
        &params[self.range(i)]
    }

    /// Where the observation of learner `j` starts in a row of all observations.
    pub fn observation_offset(&self, j: usize) -> usize {
        self.observation[..j].iter().sum()
    }

    /// Appends the input of actor `i` for one row: `observations` `[Σ observation]` and `messages` `[Σ message]` of all
    /// learners (their observations where those are the messages), `link` the bits `[sender][receiver]` of that row.
    pub fn push_input(&self, i: usize, observations: &[f32], messages: &[f32], link: &[bool], out: &mut Vec<f32>) {
        let own = self.observation_offset(i);
        out.extend_from_slice(&observations[own..own + self.observation[i]]);
        if self.messages == Messages::Off {
            return;
        }
        let mut at = 0;
        for (j, &width) in self.message.iter().enumerate() {
            if j != i {
                if link[j * self.len() + i] {
                    out.extend_from_slice(&messages[at..at + width]);
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
        for (i, agent) in learners.iter().enumerate() {
            let expected = [agent.observation, agent.action];
            let found = [self.observation[i], self.networks[i].outputs()];
            let name = &agent.name;
            if expected != found {
                return fail(format!(
                    "{name} has observation and action widths {expected:?}, the trained actor {found:?}"
                ));
            }
            let [sent, heard] =
                [self.input(i), self.networks[i].inputs()].map(|all| all.saturating_sub(self.observation[i]));
            if sent != heard {
                return fail(format!("the others send {name} {sent} numbers, its trained actor hears {heard}"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::algo::agent;

    #[test]
    fn a_lost_message_enters_as_zeros_and_the_own_observation_comes_first() {
        let agents = [agent("a", 2, 2), agent("b", 1, 2), agent("c", 2, 2)];
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let mut link = [true; 9];
        link[3] = false; // b -> a is lost
        let observations = [1.0, 2.0, 3.0, 4.0, 5.0];
        let input = |messages, sent: &[f32], i: usize| {
            let config = MaddpgConfig { messages, message_width: Some(1), ..MaddpgConfig::default() };
            let actors = Actors::new(&agents, Activation::Tanh, &config);
            let mut input = Vec::new();
            actors.push_input(i, &observations, sent, &link, &mut input);
            assert_eq!(input.len(), actors.networks[i].inputs());
            input
        };
        let observed = |i| input(Messages::Observation, &observations, i);
        assert_eq!(observed(0), [1.0, 2.0, 0.0, 4.0, 5.0]);
        assert_eq!(observed(1), [3.0, 1.0, 2.0, 4.0, 5.0]);
        let encoded = |i| input(Messages::Encoder, &[0.1, 0.2, 0.3], i);
        assert_eq!([encoded(0), encoded(2)], [[1.0, 2.0, 0.0, 0.3], [4.0, 5.0, 0.1, 0.2]]);
        assert_eq!(input(Messages::Off, &[], 2), [4.0, 5.0]);
    }

    #[test]
    fn actors_of_other_widths_do_not_fit_and_who_differs_is_named() {
        let agents = [agent("a", 3, 2), agent("b", 4, 2)];
        let actors = Actors::new(&agents.iter().collect::<Vec<_>>(), Activation::Sigmoid, &MaddpgConfig::default());
        let other = [agent("a", 3, 2), agent("b", 5, 2)];
        let error =
            actors.check_fit(&other.iter().collect::<Vec<_>>(), 0.0, Path::new("runs/x")).unwrap_err().to_string();
        assert!(error.contains("b has observation and action widths [5, 2]"), "{error}");
        let mut deaf = actors;
        deaf.networks[1] = Mlp::new(&[4, 64, 2], Activation::Relu, Activation::Sigmoid);
        let error = deaf.check_fit(&agents.iter().collect::<Vec<_>>(), 0.0, Path::new("runs/x")).unwrap_err();
        assert!(error.to_string().contains("the others send b 3 numbers, its trained actor hears 0"), "{error}");
    }
}
