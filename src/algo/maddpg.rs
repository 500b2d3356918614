//! MADDPG with one centralised critic and messages over unreliable links.
//!
//! Definition: critic Q(o^1…o^N, a^1…a^N), one for the team; actor i is π^i(o^i, {ι^{ji} m^{ji}}_{j≠i}) with m = the
//! sender's observation. Per update, on one minibatch of B transitions:
//!
//! 1. y = r̃ + γ Q⁻(o', π⁻(o', M')), no mask at the time limit; r̃ = r + bonus (the Du-MIE's, if any);
//! 2. critic: one Adam step on mean (Q(o, a) − y)², gradient clipped at L2 norm 0.5;
//! 3. actors: one joint Adam step on −mean Q(o, π(o, M)) + 1e−6 mean a², each actor's gradient clipped at 0.5;
//! 4. targets: θ⁻ ← (1 − τ) θ⁻ + τ θ.
//!
//! Source: Lowe et al. 2017; the joint step and the constants are those of the paper's parent code (one critic, one
//! actor loss). Link bits are those drawn at rollout, `ι_t` for o and ι_{t+1} for o'.

use serde::{Deserialize, Serialize};

use super::Actors;
use crate::nn::{Activation, Adam, AdamConfig, Mlp, NnError, Params, Tape, clip_norm, soft_update};
use crate::rng::Seeds;
use crate::schema::AgentSpec;

/// Every constant of the learner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MaddpgConfig {
    /// Widths of the hidden layers of actors and critic.
    pub hidden: Vec<usize>,
    /// Adam's learning rate for all actors.
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
    /// Largest L2 norm of the critic's gradient, and of each actor's.
    pub grad_clip: f32,
    /// Weight of mean a² in the actors' loss.
    pub action_penalty: f32,
    /// Whether messages enter the actors: "observation" (the sender's) or "off".
    pub messages: Messages,
}

/// What a message is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Messages {
    /// The sender's observation.
    Observation,
    /// Actors have no message inputs at all.
    Off,
}

impl MaddpgConfig {
    /// The paper's batch, where nothing else is said.
    pub const BATCH: usize = 1024;
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
        }
    }
}

/// A minibatch of B transitions; O and A are all learners' observation and action widths together.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// B.
    pub rows: usize,
    /// `[B, O]`.
    pub observations: Vec<f32>,
    /// `[B, O]`.
    pub next_observations: Vec<f32>,
    /// `[B, A]`.
    pub actions: Vec<f32>,
    /// `[B, N, N]`, sender by receiver.
    pub link: Vec<bool>,
    /// `[B, N, N]`.
    pub next_link: Vec<bool>,
    /// Raw team reward `[B]`.
    pub reward: Vec<f32>,
    /// Shaping bonus stored at rollout `[B]`; empty when shaping is computed on the minibatch or off.
    pub bonus: Vec<f32>,
}

/// What one update reports.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateMetrics {
    /// Mean squared TD error of the minibatch, before the step.
    pub td_loss: f64,
    /// Mean Q(o, π(o, M)), what the actors climb.
    pub actor_objective: f64,
    /// Mean Q(o, a) of the minibatch.
    pub q_mean: f64,
    /// L2 norm of the critic's gradient before clipping.
    pub critic_grad_norm: f64,
    /// Largest L2 norm of an actor's gradient before clipping.
    pub actor_grad_norm: f64,
}

impl UpdateMetrics {
    /// Whether every value is a finite number.
    pub fn is_finite(&self) -> bool {
        [self.td_loss, self.actor_objective, self.q_mean, self.critic_grad_norm, self.actor_grad_norm]
            .iter()
            .all(|v| v.is_finite())
    }
}

/// The learner: networks, targets, optimisers.
#[derive(Debug)]
pub struct Maddpg {
    /// Constants.
    pub config: MaddpgConfig,
    /// Shapes of the actors.
    pub actors: Actors,
    /// Shape of the critic.
    pub critic: Mlp,
    /// Online and target parameters.
    pub params: Networks,
    /// Optimiser of all actors together.
    pub actor_adam: Adam,
    /// Optimiser of the critic.
    pub critic_adam: Adam,
    scratch: Scratch,
}

/// Parameters of a learner.
#[derive(Debug)]
pub struct Networks {
    /// All actors, flat.
    pub actors: Params,
    /// The critic.
    pub critic: Params,
    /// Target of the actors.
    pub target_actors: Params,
    /// Target of the critic.
    pub target_critic: Params,
}

/// Buffers that updates reuse.
#[derive(Debug, Default)]
struct Scratch {
    joint: Vec<f32>,
    team: Team,
    critic_tape: Tape,
    grad_q: Vec<f32>,
    grad_joint: Vec<f32>,
    grad_action: Vec<f32>,
    actor_grads: Vec<f32>,
    critic_grads: Vec<f32>,
    target: Vec<f32>,
}

impl Maddpg {
    /// A learner with fresh networks for these agents; `output` bounds their actions.
    ///
    /// # Errors
    /// [`NnError`] when candle refuses the allocation.
    pub fn new(
        learners: &[&AgentSpec],
        output: Activation,
        config: MaddpgConfig,
        seeds: &Seeds,
    ) -> Result<Self, NnError> {
        let actors = Actors::new(learners, &config.hidden, output, config.messages == Messages::Observation);
        let joint: usize = learners.iter().map(|a| a.observation + a.action).sum();
        let widths: Vec<usize> = [joint].into_iter().chain(config.hidden.iter().copied()).chain([1]).collect();
        let critic = Mlp::new(&widths, Activation::Relu, Activation::Identity);
        let actor_params = Params::new(actors.init(&mut seeds.stream("actors")))?;
        let mut critic_params = Vec::new();
        critic.init(&mut seeds.stream("critic"), &mut critic_params);
        let critic_params = Params::new(critic_params)?;
        Ok(Self {
            actor_adam: Adam::new(AdamConfig::new(config.actor_learning_rate), actor_params.len()),
            critic_adam: Adam::new(AdamConfig::new(config.critic_learning_rate), critic_params.len()),
            params: Networks {
                target_actors: actor_params.duplicate()?,
                target_critic: critic_params.duplicate()?,
                actors: actor_params,
                critic: critic_params,
            },
            config,
            actors,
            critic,
            scratch: Scratch::default(),
        })
    }

    /// One update on a minibatch. `bonus` `[B]` is added to the reward; empty means none.
    ///
    /// # Errors
    /// [`NnError`] when candle refuses.
    pub fn update(&mut self, batch: &Batch, bonus: &[f32]) -> Result<UpdateMetrics, NnError> {
        let (rows, widths) = (batch.rows, Widths::of(&self.actors));

        // 1. and 2. target and critic
        let [td_loss, q_mean] = self.td_errors(batch, bonus);
        let Scratch { joint, critic_tape, grad_q, critic_grads, .. } = &mut self.scratch;
        for error in grad_q.iter_mut() {
            *error *= 2.0 / rows as f32;
        }
        let critic_params = self.params.critic.read();
        critic_grads.clear();
        critic_grads.resize(critic_params.len(), 0.0);
        self.critic.backward(&critic_params, joint, critic_tape, grad_q, critic_grads, None);
        drop(critic_params);
        let critic_grad_norm = clip_norm(critic_grads, self.config.grad_clip);
        let adam = &mut self.critic_adam;
        self.params.critic.update(|p| adam.step(p, critic_grads))?;

        // 3. actors, jointly, through the critic just updated
        let (actor_objective, actor_grad_norm) = self.actor_step(batch, widths)?;

        // 4. targets
        let tau = self.config.tau;
        let (actors, critic) = (self.params.actors.read(), self.params.critic.read());
        self.params.target_actors.update(|t| soft_update(t, &actors, tau))?;
        self.params.target_critic.update(|t| soft_update(t, &critic, tau))?;
        Ok(UpdateMetrics {
            td_loss,
            actor_objective,
            q_mean,
            critic_grad_norm: f64::from(critic_grad_norm),
            actor_grad_norm: f64::from(actor_grad_norm),
        })
    }

    /// The mean squared TD error that [`Maddpg::update`] would report for this minibatch and no bonus; learns nothing.
    pub fn td_loss(&mut self, batch: &Batch) -> f64 {
        self.td_errors(batch, &[])[0]
    }

    /// Q(o, a) − y per row into `scratch.grad_q`, the critic's input and tape left as a backward pass needs them.
    /// Returns the mean squared error and the mean Q.
    fn td_errors(&mut self, batch: &Batch, bonus: &[f32]) -> [f64; 2] {
        let (rows, widths) = (batch.rows, Widths::of(&self.actors));
        let Scratch { joint, team, critic_tape, grad_q, target, .. } = &mut self.scratch;
        // y = r + bonus + γ Q⁻(o', π⁻(o', M'))
        joint_rows(joint, &batch.next_observations, rows, widths);
        let (observations, link) = (&batch.next_observations, &batch.next_link);
        team.act(&self.actors, &self.params.target_actors.read(), (observations, link), rows, joint);
        let next_q = self.critic.forward(&self.params.target_critic.read(), joint, rows, critic_tape);
        target.clear();
        target.extend(batch.reward.iter().zip(next_q).map(|(r, q)| r + self.config.gamma * q));
        target.iter_mut().zip(bonus).for_each(|(y, b)| *y += b);

        joint_rows(joint, &batch.observations, rows, widths);
        put_actions(joint, &batch.actions, widths, widths.actions, widths.observations);
        let q = self.critic.forward(&self.params.critic.read(), joint, rows, critic_tape);
        grad_q.clear();
        grad_q.extend(q.iter().zip(target.iter()).map(|(q, y)| q - y));
        let squares: f64 = grad_q.iter().map(|&error| f64::from(error) * f64::from(error)).sum();
        [squares / rows as f64, mean(q)]
    }

    /// One joint Adam step of all actors; returns mean Q(o, π(o, M)) and the largest gradient norm.
    fn actor_step(&mut self, batch: &Batch, widths: Widths) -> Result<(f64, f32), NnError> {
        let rows = batch.rows;
        let Scratch { joint, team, critic_tape, grad_q, grad_joint, grad_action, actor_grads, .. } = &mut self.scratch;
        let actor_params = self.params.actors.read();
        team.act(&self.actors, &actor_params, (&batch.observations, &batch.link), rows, joint);
        let critic_params = self.params.critic.read();
        let objective = mean(self.critic.forward(&critic_params, joint, rows, critic_tape));
        grad_q.clear();
        grad_q.resize(rows, -1.0 / rows as f32);
        grad_joint.resize(rows * widths.joint(), 0.0);
        self.critic.backward(&critic_params, joint, critic_tape, grad_q, &mut [], Some(grad_joint));
        drop(critic_params);
        actor_grads.clear();
        actor_grads.resize(actor_params.len(), 0.0);
        let penalty = 2.0 * self.config.action_penalty / (rows * widths.actions) as f32;
        let mut norm = 0.0f32;
        for i in 0..self.actors.len() {
            let width = self.actors.networks[i].outputs();
            let at = widths.action_offset(&self.actors, i);
            grad_action.clear();
            for (grad, row) in grad_joint.chunks_exact(widths.joint()).zip(team.tapes[i].output().chunks_exact(width)) {
                grad_action.extend(grad[at..at + width].iter().zip(row).map(|(g, a)| g + penalty * a));
            }
            let grads = &mut actor_grads[self.actors.offsets[i]..self.actors.offsets[i + 1]];
            let params = self.actors.slice(&actor_params, i);
            self.actors.networks[i].backward(params, &team.inputs[i], &mut team.tapes[i], grad_action, grads, None);
            norm = norm.max(clip_norm(grads, self.config.grad_clip));
        }
        drop(actor_params);
        let adam = &mut self.actor_adam;
        self.params.actors.update(|p| adam.step(p, actor_grads))?;
        Ok((objective, norm))
    }
}

/// Buffers in which a team acts on a whole batch: each actor's inputs and tape stay for a backward pass.
#[derive(Debug, Default)]
struct Team {
    inputs: Vec<Vec<f32>>,
    tapes: Vec<Tape>,
}

impl Team {
    /// Lays the actions of all actors on `[rows, O]` observations under `[rows, N²]` link bits into the critic's input.
    fn act(
        &mut self,
        actors: &Actors,
        params: &[f32],
        (observations, link): (&[f32], &[bool]),
        rows: usize,
        joint: &mut [f32],
    ) {
        let widths = Widths::of(actors);
        self.inputs.resize_with(actors.len(), Vec::new);
        self.tapes.resize_with(actors.len(), Tape::default);
        for (i, (input, tape)) in self.inputs.iter_mut().zip(self.tapes.iter_mut()).enumerate() {
            actor_inputs(actors, i, observations, link, rows, input);
            let actions = actors.act(params, i, input, rows, tape);
            put_actions(joint, actions, widths, actors.networks[i].outputs(), widths.action_offset(actors, i));
        }
    }
}

/// Widths of the critic's input: all observations, then all actions.
#[derive(Clone, Copy)]
struct Widths {
    observations: usize,
    actions: usize,
}

impl Widths {
    fn of(actors: &Actors) -> Self {
        Self { observations: actors.observation.iter().sum(), actions: actors.networks.iter().map(Mlp::outputs).sum() }
    }

    fn joint(self) -> usize {
        self.observations + self.actions
    }

    fn action_offset(self, actors: &Actors, i: usize) -> usize {
        self.observations + actors.networks[..i].iter().map(Mlp::outputs).sum::<usize>()
    }
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64
}

/// Lays the observations into the critic's input rows; actions follow by [`put_actions`].
fn joint_rows(joint: &mut Vec<f32>, observations: &[f32], rows: usize, widths: Widths) {
    joint.resize(rows * widths.joint(), 0.0);
    for (row, o) in joint.chunks_exact_mut(widths.joint()).zip(observations.chunks_exact(widths.observations)) {
        row[..widths.observations].copy_from_slice(o);
    }
}

/// Lays `[rows, width]` actions into the critic's input rows, from column `at`.
fn put_actions(joint: &mut [f32], actions: &[f32], widths: Widths, width: usize, at: usize) {
    for (row, a) in joint.chunks_exact_mut(widths.joint()).zip(actions.chunks_exact(width)) {
        row[at..at + width].copy_from_slice(a);
    }
}

/// Inputs of actor `i` for all rows of a batch.
fn actor_inputs(actors: &Actors, i: usize, observations: &[f32], link: &[bool], rows: usize, out: &mut Vec<f32>) {
    let (width, n) = (actors.observation.iter().sum::<usize>(), actors.len());
    out.clear();
    for row in 0..rows {
        let bits = &link[row * n * n..(row + 1) * n * n];
        actors.push_input(i, &observations[row * width..(row + 1) * width], bits, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;
    use crate::schema::Controller;

    fn agents(n: usize) -> Vec<AgentSpec> {
        (0..n)
            .map(|i| AgentSpec {
                name: format!("agent_{i}"),
                team: "team".to_owned(),
                controller: Controller::Policy,
                learner: true,
                communicator: true,
                observation: 3 + i,
                message: 3 + i,
                action: 2,
            })
            .collect()
    }

    fn batch(rows: usize) -> Batch {
        let mut rng = Seeds::new(9).stream("batch");
        let mut draw = |n: usize| (0..n).map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32).collect::<Vec<_>>();
        let mut rng2 = Seeds::new(9).stream("bits");
        let mut bits = || (0..rows * 4).map(|i| i % 4 % 3 == 0 || rng::bernoulli(&mut rng2, 0.5)).collect::<Vec<_>>();
        Batch {
            rows,
            observations: draw(rows * 7),
            next_observations: draw(rows * 7),
            actions: draw(rows * 4),
            link: bits(),
            next_link: bits(),
            reward: draw(rows),
            bonus: Vec::new(),
        }
    }

    #[test]
    fn the_actors_move_up_the_critic_and_the_critic_towards_its_target() {
        let agents = agents(2);
        let config = MaddpgConfig { actor_learning_rate: 1e-3, tau: 0.0, ..MaddpgConfig::default() };
        let mut learner =
            Maddpg::new(&agents.iter().collect::<Vec<_>>(), Activation::Tanh, config, &Seeds::new(1)).unwrap();
        let batch = batch(256);
        let before = learner.td_loss(&batch);
        let first = learner.update(&batch, &[]).unwrap();
        assert!((first.td_loss - before).abs() < 1e-9);
        for _ in 0..200 {
            learner.update(&batch, &[]).unwrap();
        }
        let last = learner.update(&batch, &[]).unwrap();
        assert!(last.td_loss < 0.5 * first.td_loss, "{last:?} after {first:?}");
        assert!(last.actor_objective > last.q_mean, "{last:?}");
    }

    #[test]
    fn a_constant_bonus_raises_the_target_by_itself() {
        let agents = agents(2);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let batch = batch(64);
        let mut plain = Maddpg::new(&agents, Activation::Tanh, MaddpgConfig::default(), &Seeds::new(1)).unwrap();
        let mut shaped = Maddpg::new(&agents, Activation::Tanh, MaddpgConfig::default(), &Seeds::new(1)).unwrap();
        let richer = Batch { reward: batch.reward.iter().map(|r| r + 3.0).collect(), ..batch.clone() };
        let a = plain.update(&richer, &[]).unwrap();
        let b = shaped.update(&batch, &vec![3.0; 64]).unwrap();
        assert!((a.td_loss - b.td_loss).abs() < 1e-4 && a.td_loss > 1.0);
    }

    #[test]
    fn the_joint_actor_gradient_equals_finite_differences() {
        let agents = agents(2);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let config = MaddpgConfig { grad_clip: f32::INFINITY, action_penalty: 0.0, ..MaddpgConfig::default() };
        let mut learner = Maddpg::new(&agents, Activation::Sigmoid, config, &Seeds::new(4)).unwrap();
        let batch = batch(32);
        let widths = Widths::of(&learner.actors);
        let objective = |learner: &Maddpg| {
            let (mut joint, mut input, mut tape) = (Vec::new(), Vec::new(), Tape::default());
            joint_rows(&mut joint, &batch.observations, 32, widths);
            for i in 0..2 {
                actor_inputs(&learner.actors, i, &batch.observations, &batch.link, 32, &mut input);
                let a = learner.actors.act(&learner.params.actors.read(), i, &input, 32, &mut tape);
                put_actions(&mut joint, a, widths, 2, widths.action_offset(&learner.actors, i));
            }
            mean(learner.critic.forward(&learner.params.critic.read(), &joint, 32, &mut tape))
        };
        joint_rows(&mut learner.scratch.joint, &batch.observations, 32, widths);
        let start = learner.params.actors.read().to_vec();
        learner.actor_step(&batch, widths).unwrap();
        let grads = learner.scratch.actor_grads.clone();
        // both actors' first weights and last biases, and the steepest coordinate
        let steepest = (0..grads.len()).max_by(|&a, &b| grads[a].abs().total_cmp(&grads[b].abs())).unwrap();
        for at in [0, learner.actors.offsets[1], learner.actors.offsets[1] - 1, grads.len() - 1, steepest] {
            let mut values = [0.0; 2];
            for (value, step) in values.iter_mut().zip([1e-3f32, -1e-3]) {
                learner
                    .params
                    .actors
                    .update(|p| {
                        p.copy_from_slice(&start);
                        p[at] += step;
                    })
                    .unwrap();
                *value = objective(&learner);
            }
            let slope = -(values[0] - values[1]) / 2e-3;
            let error = (slope - f64::from(grads[at])).abs();
            assert!(error < 1e-5 + 0.02 * slope.abs(), "{at}: {slope} against {}", grads[at]);
        }
    }
}
