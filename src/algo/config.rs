//! Constants and options of the MADDPG learner, as `config.toml` names them.

use serde::{Deserialize, Serialize};

/// Every constant of the learner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MaddpgConfig {
    /// Widths of the hidden layers of actors and critic.
    pub hidden: Vec<usize>,
    /// Adam's learning rate for all actors and their encoders.
    pub actor_learning_rate: f32,
    /// Adam's learning rate for the critic.
    pub critic_learning_rate: f32,
    /// Discount per step.
    pub gamma: f32,
    /// Share of the online network that enters the target per update.
    pub tau: f32,
    /// Transitions per update, drawn with replacement; 1024, or 512 on `simple_tag` with six learners or more.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch: Option<usize>,
    /// Largest L2 norm of the critic's gradient, of each actor's, and of each encoder's.
    pub grad_clip: f32,
    /// Weight of mean a² in the actors' loss.
    pub action_penalty: f32,
    /// What a message is: "observation" (the sender's), "encoder" (what a network makes of it), or "off".
    pub messages: Messages,
    /// Width of an encoder's message; 8 where there are encoders (the latent width of MAIC).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub message_width: Option<usize>,
    /// Widths of an encoder's hidden layers, none for a linear one; one of 64 where there are encoders (as MAIC's).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub encoder_hidden: Option<Vec<usize>>,
    /// Whose actions are fresh in the actors' loss: "joint" or "per-agent".
    pub actor_step: ActorStep,
    /// Which link bits a minibatch sees: "kept" from the rollout, or "redrawn".
    pub masks: Masks,
}

/// What a message is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Messages {
    /// The sender's observation.
    Observation,
    /// What the sender's encoder makes of its observation; it learns through the actors that receive it.
    Encoder,
    /// Actors have no message inputs at all.
    Off,
}

/// Whose actions are fresh in the actors' loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ActorStep {
    /// Everybody's: one pass through the critic (the paper's parent code).
    Joint,
    /// Only that of the actor at hand, the others' come from replay: one pass through the critic per actor (Lowe et
    /// al. 2017).
    PerAgent,
}

/// Which link bits a minibatch sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Masks {
    /// Those drawn at rollout, `ι_t` for o and ι_{t+1} for o'.
    Kept,
    /// Those of another transition drawn from replay, the same for o and o' (as in Message-Dropout, for any prior):
    /// the prior's law, but independent of where the agents are. Shaping goes by the rollout's bits all the same.
    Redrawn,
}

impl MaddpgConfig {
    /// The paper's batch, where nothing else is said.
    pub const BATCH: usize = 1024;

    /// The paper's batch for this many learners in a scenario, where nothing else is said.
    pub fn batch_of(scenario: &str, learners: usize) -> usize {
        if scenario == "simple_tag" && learners >= 6 { 512 } else { Self::BATCH }
    }

    /// Most parameters that a learner's networks may have together. Each takes 20 bytes (online, target, two moments,
    /// gradient), so that the largest learner takes 5 GiB.
    pub const MOST_PARAMETERS: usize = 1 << 28;

    /// Width of an encoder's message, where nothing else is said.
    pub const MESSAGE_WIDTH: usize = 8;

    /// Hidden layers of an encoder, where nothing else is said.
    pub const ENCODER_HIDDEN: [usize; 1] = [64];
}

impl Default for MaddpgConfig {
    fn default() -> Self {
        Self {
            hidden: vec![64, 64],
            actor_learning_rate: 1e-4,
            critic_learning_rate: 1e-3,
            gamma: 0.95,
            tau: 0.01,
            batch: None,
            grad_clip: 0.5,
            action_penalty: 1e-6,
            messages: Messages::Observation,
            message_width: None,
            encoder_hidden: None,
            actor_step: ActorStep::Joint,
            masks: Masks::Kept,
        }
    }
}
