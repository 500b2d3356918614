//! MADDPG with one centralised critic and messages over unreliable links.
//!
//! Definition: critic Q(o^1…o^N, a^1…a^N), one for the team; actor i is π^i(o^i, {ι^{ji} m^{ji}}_{j≠i}) with m = the
//! sender's observation, or `m^j = f_j(o^j)` of its encoder. Per update, on one minibatch of B transitions:
//!
//! 1. y = r̃ + γ Q⁻(o', π⁻(o', M')), no mask at the time limit; r̃ = r + bonus (the Du-MIE's, if any);
//! 2. critic: one Adam step on mean (Q(o, a) − y)², gradient clipped at L2 norm 0.5;
//! 3. actors: one joint Adam step on −mean Q(o, π(o, M)) + 1e−6 mean a², each actor's gradient clipped at 0.5;
//! 4. targets: θ⁻ ← (1 − τ) θ⁻ + τ θ.
//!
//! Encoders are part of 3 and 4: M is computed anew from o (with the target encoders in 1), the loss of every actor that
//! received m^j flows into `f_j`, and what was lost gives no gradient. Each encoder's gradient is clipped by itself, so
//! that it does not shrink an actor's step; learning rate and τ are the actors'. The critic sees observations and
//! actions alone: messages are functions of those.
//!
//! Source: Lowe et al. 2017; the joint step and the constants are those of the paper's parent code (one critic, one
//! actor loss). Lowe's own step, actor i's action alone from its policy and the others' from replay, is
//! [`ActorStep::PerAgent`]. Link bits are as drawn at rollout, `ι_t` for o and ι_{t+1} for o', or
//! redrawn ([`Masks`](super::Masks)).
//!
//! The batch goes through in tiles of 128 rows, each through every network before the next, so that activations stay
//! in the second-level cache.

use super::batch::{Batch, Tile, Widths};
use super::config::{ActorStep, MaddpgConfig};
use super::{Actors, EncoderScratch, Senders, Sight, Team, TeamScratch};
use crate::nn::{Activation, Adam, AdamConfig, Mlp, NnError, Packed, Params, Passes, TILE, clip_norm};
use crate::rng::Seeds;
use crate::schema::AgentSpec;

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
    /// Largest L2 norm of an encoder's gradient before clipping; `None` without encoders.
    pub encoder_grad_norm: Option<f64>,
}

impl UpdateMetrics {
    /// Whether every value is a finite number.
    pub fn is_finite(&self) -> bool {
        [self.td_loss, self.actor_objective, self.q_mean, self.critic_grad_norm, self.actor_grad_norm]
            .iter()
            .chain(&self.encoder_grad_norm)
            .all(|v| v.is_finite())
    }
}

/// The learner: networks, targets, optimisers.
#[derive(Debug)]
pub struct Maddpg {
    /// Constants.
    pub config: MaddpgConfig,
    /// Shapes of the actors and their encoders.
    pub actors: Actors,
    /// Shape of the critic.
    pub critic: Mlp,
    /// Online and target parameters.
    pub params: Networks,
    /// Optimiser of all actors and encoders together.
    pub actor_adam: Adam,
    /// Optimiser of the critic.
    pub critic_adam: Adam,
    scratch: Scratch,
}

/// Parameters of a learner.
#[derive(Debug)]
pub struct Networks {
    /// All actors, then their encoders, flat.
    pub actors: Params,
    /// The critic.
    pub critic: Params,
    /// Target of the actors and encoders.
    pub target_actors: Params,
    /// Target of the critic.
    pub target_critic: Params,
}

/// Networks laid out for the kernels, and buffers; reused, so that updates allocate nothing once they are warm.
#[derive(Debug, Default)]
struct Scratch {
    team: Team,
    target_team: Team,
    acting: TeamScratch,
    sending: EncoderScratch,
    messages: Vec<f32>,
    critic: Packed,
    target_critic: Packed,
    critic_packed_grads: Packed,
    passes: Passes,
    joint: Vec<f32>,
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
        let (actors, critic) = shapes(learners, output, &config);
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

    /// Parameters that the networks of such a learner have together; none is made.
    pub fn parameters(learners: &[&AgentSpec], config: &MaddpgConfig) -> usize {
        let (actors, critic) = shapes(learners, Activation::Tanh, config);
        actors.parameters() + critic.parameters()
    }

    /// One update on a minibatch. `bonus` `[B]` is added to the reward; empty means none.
    ///
    /// # Errors
    /// [`NnError`] when candle refuses.
    pub fn update(&mut self, batch: &Batch, bonus: &[f32]) -> Result<UpdateMetrics, NnError> {
        // 1. and 2. target and critic; its target follows at once, since nothing reads it before the next update
        let [td_loss, q_mean] = self.td_pass(batch, bonus, true);
        let grads = &mut self.scratch.critic_grads;
        grads.clear();
        grads.resize(self.critic.parameters(), 0.0);
        self.critic.unpack_grads(&self.scratch.critic_packed_grads, grads);
        let critic_grad_norm = clip_norm(grads, self.config.grad_clip);
        follow(&mut self.critic_adam, &self.params.critic, &self.params.target_critic, grads, self.config.tau)?;

        // 3. actors, through the critic just updated, and 4. their targets
        let (actor_objective, [actor_grad_norm, encoder_grad_norm]) = self.actor_pass(batch);
        let grads = &self.scratch.actor_grads;
        follow(&mut self.actor_adam, &self.params.actors, &self.params.target_actors, grads, self.config.tau)?;
        Ok(UpdateMetrics {
            td_loss,
            actor_objective,
            q_mean,
            critic_grad_norm: f64::from(critic_grad_norm),
            actor_grad_norm: f64::from(actor_grad_norm),
            encoder_grad_norm: self.actors.encodes().then_some(f64::from(encoder_grad_norm)),
        })
    }

    /// The encoders as they are now, laid out for sending; `None` where a message is the observation.
    pub fn senders(&mut self) -> Option<Senders<'_>> {
        if !self.actors.encodes() {
            return None;
        }
        let Scratch { team, sending, .. } = &mut self.scratch;
        team.load_encoders(&self.actors, &self.params.actors.read());
        Some(Senders { actors: &self.actors, team, scratch: sending })
    }

    /// The mean squared TD error that [`Maddpg::update`] would report for this minibatch and no bonus; learns nothing.
    pub fn td_loss(&mut self, batch: &Batch) -> f64 {
        self.td_pass(batch, &[], false)[0]
    }

    /// Mean (Q(o, a) − y)² and mean Q; with `learn`, the gradient of the former in `scratch.critic_packed_grads`.
    fn td_pass(&mut self, batch: &Batch, bonus: &[f32], learn: bool) -> [f64; 2] {
        let widths = Widths::of(&self.actors);
        let (actors, critic, gamma) = (&self.actors, &self.critic, self.config.gamma);
        let Scratch {
            joint,
            target_team,
            acting,
            sending,
            messages,
            passes,
            grad_q,
            target,
            critic_packed_grads,
            critic: packed,
            target_critic: target_packed,
            ..
        } = &mut self.scratch;
        target_team.load_forward(actors, &self.params.target_actors.read());
        critic.pack(&self.params.target_critic.read(), target_packed);
        packed.wanted = widths.observations..widths.joint();
        critic.pack(&self.params.critic.read(), packed);
        critic.clear_grads(critic_packed_grads);
        let (mut squares, mut values) = (0.0, 0.0);
        for start in (0..batch.rows).step_by(TILE) {
            let rows = TILE.min(batch.rows - start);
            let tile = Tile::of(batch, start, rows, widths, actors.len());
            // y = r + bonus + γ Q⁻(o', π⁻(o', M'))
            joint.resize(rows * widths.joint(), 0.0);
            widths.put(joint, tile.next_observations, 0);
            target_team.encode(actors, (tile.next_observations, rows), sending, messages);
            let sight = Sight { observations: tile.next_observations, messages, link: tile.next_link };
            target_team.act(actors, sight, rows, acting);
            (0..actors.len()).for_each(|i| widths.put(joint, acting.actions(i), widths.action(actors, i).start));
            let q = critic.forward_packed(target_packed, widths.input(joint), rows, passes);
            target.clear();
            target.extend(tile.reward.iter().zip(q).map(|(r, q)| r + gamma * q));
            target.iter_mut().zip(bonus.iter().skip(start)).for_each(|(y, b)| *y += b);

            widths.put(joint, tile.observations, 0);
            widths.put(joint, tile.actions, widths.observations);
            let q = critic.forward_packed(packed, widths.input(joint), rows, passes);
            grad_q.clear();
            for (q, y) in q.iter().zip(&*target) {
                let error = q - y;
                squares += f64::from(error) * f64::from(error);
                values += f64::from(*q);
                grad_q.push(error * 2.0 / batch.rows as f32);
            }
            if learn {
                let grads = Some(&mut *critic_packed_grads);
                critic.backward_packed(packed, widths.input(joint), rows, passes, grad_q, grads, None);
            }
        }
        [squares / batch.rows as f64, values / batch.rows as f64]
    }

    /// Mean Q(o, π(o, M)) and the largest gradient norms of an actor and of an encoder; clipped gradients in
    /// `scratch.actor_grads`.
    fn actor_pass(&mut self, batch: &Batch) -> (f64, [f32; 2]) {
        let widths = Widths::of(&self.actors);
        let (actors, critic) = (&self.actors, &self.critic);
        let Scratch {
            joint,
            team,
            acting,
            sending,
            messages,
            passes,
            grad_q,
            grad_joint,
            grad_action,
            actor_grads,
            critic: packed,
            ..
        } = &mut self.scratch;
        team.load(actors, &self.params.actors.read());
        team.clear_grads(actors);
        critic.pack(&self.params.critic.read(), packed);
        // whose actions are fresh, in each pass through the critic
        let n = actors.len();
        let (passes_needed, fresh_in_each) = match self.config.actor_step {
            ActorStep::Joint => (1, n),
            ActorStep::PerAgent => (n, 1),
        };
        let mut objective = 0.0;
        for start in (0..batch.rows).step_by(TILE) {
            let rows = TILE.min(batch.rows - start);
            let tile = Tile::of(batch, start, rows, widths, n);
            team.encode(actors, (tile.observations, rows), sending, messages);
            sending.clear_grads(actors, rows);
            let sight = Sight { observations: tile.observations, messages, link: tile.link };
            team.act(actors, sight, rows, acting);
            joint.resize(rows * widths.joint(), 0.0);
            widths.put(joint, tile.observations, 0);
            grad_q.clear();
            grad_q.resize(rows, -1.0 / batch.rows as f32);
            grad_joint.resize(rows * widths.actions, 0.0);
            for pass in 0..passes_needed {
                let fresh = pass..pass + fresh_in_each;
                if fresh.len() < n {
                    widths.put(joint, tile.actions, widths.observations);
                }
                for i in fresh.clone() {
                    widths.put(joint, acting.actions(i), widths.action(actors, i).start);
                }
                let input = widths.input(joint);
                let q = critic.forward_packed(packed, input, rows, passes);
                objective += q.iter().map(|&q| f64::from(q)).sum::<f64>();
                critic.backward_packed(packed, input, rows, passes, grad_q, None, Some(grad_joint));
                for i in fresh {
                    let columns = widths.action(actors, i);
                    let (from, width) = (columns.start - widths.observations, columns.len());
                    let penalised = if fresh_in_each == n { widths.actions } else { width };
                    let penalty = 2.0 * self.config.action_penalty / (batch.rows * penalised) as f32;
                    grad_action.clear();
                    let own = grad_joint.chunks_exact(widths.actions).zip(acting.actions(i).chunks_exact(width));
                    for (grad, a) in own {
                        grad_action.extend(grad[from..from + width].iter().zip(a).map(|(g, a)| g + penalty * a));
                    }
                    team.backward(actors, i, (sight, rows), grad_action, (acting, sending));
                }
            }
            team.backward_encoders(actors, (tile.observations, rows), sending);
        }
        actor_grads.resize(actors.parameters(), 0.0);
        let mut norms = [0.0f32; 2];
        for i in 0..n {
            let grads = &mut actor_grads[actors.range(i)];
            team.grads(actors, i, grads);
            norms[0] = larger(norms[0], clip_norm(grads, self.config.grad_clip));
        }
        for j in 0..actors.encoders.len() {
            let grads = &mut actor_grads[actors.encoder_range(j)];
            team.encoder_grads(actors, j, grads);
            norms[1] = larger(norms[1], clip_norm(grads, self.config.grad_clip));
        }
        (objective / (batch.rows * passes_needed) as f64, norms)
    }
}

/// The shapes of actors and critic.
fn shapes(learners: &[&AgentSpec], output: Activation, config: &MaddpgConfig) -> (Actors, Mlp) {
    let joint: usize = learners.iter().map(|a| a.observation + a.action).sum();
    let widths: Vec<usize> = [joint].into_iter().chain(config.hidden.iter().copied()).chain([1]).collect();
    (Actors::new(learners, output, config), Mlp::new(&widths, Activation::Relu, Activation::Identity))
}

/// The larger of two numbers, or the one that is none: a gradient that is no number must not pass for a small one.
fn larger(a: f32, b: f32) -> f32 {
    if b > a || b.is_nan() { b } else { a }
}

/// One Adam step of `online`, and `target`'s step towards it.
fn follow(adam: &mut Adam, online: &Params, target: &Params, grads: &[f32], tau: f32) -> Result<(), NnError> {
    let mut moved = Ok(());
    online.update(|params| moved = target.update(|target| adam.step_and_follow(params, grads, target, tau)))?;
    moved
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Tensor, Var};

    use super::*;
    use crate::algo::{Messages, agent};
    use crate::rng;

    fn agents(n: usize) -> Vec<AgentSpec> {
        (0..n).map(|i| agent(&format!("agent_{i}"), 3 + i, 2)).collect()
    }

    /// Transitions of `n` of these agents.
    fn batch(rows: usize, n: usize) -> Batch {
        let mut rng = Seeds::new(9).stream("batch");
        let mut draw = |n: usize| (0..n).map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32).collect::<Vec<_>>();
        let mut rng2 = Seeds::new(9).stream("bits");
        let links = n * n;
        let mut bit = |i: usize| (i % links).is_multiple_of(n + 1) || rng::bernoulli(&mut rng2, 0.5);
        let mut bits = || (0..rows * links).map(&mut bit).collect::<Vec<_>>();
        let observed: usize = agents(n).iter().map(|a| a.observation).sum();
        Batch {
            rows,
            observations: draw(rows * observed),
            next_observations: draw(rows * observed),
            actions: draw(rows * 2 * n),
            link: bits(),
            next_link: bits(),
            reward: draw(rows),
            ..Batch::default()
        }
    }

    #[test]
    fn the_actors_move_up_the_critic_and_the_critic_towards_its_target() {
        let agents = agents(2);
        let config = MaddpgConfig { actor_learning_rate: 1e-3, tau: 0.0, ..MaddpgConfig::default() };
        let mut learner =
            Maddpg::new(&agents.iter().collect::<Vec<_>>(), Activation::Tanh, config, &Seeds::new(1)).unwrap();
        let batch = batch(256, 2);
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
        let batch = batch(64, 2);
        let mut plain = Maddpg::new(&agents, Activation::Tanh, MaddpgConfig::default(), &Seeds::new(1)).unwrap();
        let mut shaped = Maddpg::new(&agents, Activation::Tanh, MaddpgConfig::default(), &Seeds::new(1)).unwrap();
        let richer = Batch { reward: batch.reward.iter().map(|r| r + 3.0).collect(), ..batch.clone() };
        let a = plain.update(&richer, &[]).unwrap();
        let b = shaped.update(&batch, &vec![3.0; 64]).unwrap();
        assert!((a.td_loss - b.td_loss).abs() < 1e-4 && a.td_loss > 1.0);
    }

    /// What the actors climb, from the definition and one network at a time: mean Q with the actions of `fresh` actors
    /// from their policies and the others' from the batch.
    fn objective(learner: &Maddpg, batch: &Batch, fresh: &[usize]) -> f64 {
        let (mut joint, mut input, mut sent) = (Vec::new(), Vec::new(), Vec::new());
        let mut tape = crate::nn::Tape::default();
        let (actors, params) = (&learner.actors, learner.params.actors.read());
        for row in 0..batch.rows {
            let observations = &batch.observations[row * 7..(row + 1) * 7];
            joint.extend_from_slice(observations);
            sent.clear();
            for (j, encoder) in actors.encoders.iter().enumerate() {
                let seen = &observations[actors.observation_offset(j)..];
                sent.extend_from_slice(encoder.forward(&params[actors.encoder_range(j)], seen, 1, &mut tape));
            }
            let messages = if actors.encodes() { &sent[..] } else { observations };
            for i in 0..2 {
                if fresh.contains(&i) {
                    input.clear();
                    actors.push_input(i, observations, messages, &batch.link[row * 4..], &mut input);
                    joint.extend_from_slice(actors.act(&params, i, &input, 1, &mut tape));
                } else {
                    joint.extend_from_slice(&batch.actions[row * 4 + 2 * i..row * 4 + 2 * i + 2]);
                }
            }
        }
        let q = learner.critic.forward(&learner.params.critic.read(), &joint, batch.rows, &mut tape);
        q.iter().map(|&q| f64::from(q)).sum::<f64>() / batch.rows as f64
    }

    #[test]
    fn actor_gradients_equal_finite_differences_jointly_and_one_by_one() {
        let agents = agents(2);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let batch = batch(150, 2);
        for (actor_step, messages) in [
            (ActorStep::Joint, Messages::Observation),
            (ActorStep::PerAgent, Messages::Observation),
            (ActorStep::Joint, Messages::Encoder),
            (ActorStep::PerAgent, Messages::Encoder),
        ] {
            let config = MaddpgConfig {
                grad_clip: f32::INFINITY,
                action_penalty: 0.0,
                actor_step,
                messages,
                ..MaddpgConfig::default()
            };
            let mut learner = Maddpg::new(&agents, Activation::Sigmoid, config, &Seeds::new(4)).unwrap();
            learner.td_pass(&batch, &[], false);
            let (found, _) = learner.actor_pass(&batch);
            let groups: &[&[usize]] = if actor_step == ActorStep::Joint { &[&[0, 1], &[0, 1]] } else { &[&[0], &[1]] };
            let mean = groups.iter().map(|fresh| objective(&learner, &batch, fresh)).sum::<f64>() / 2.0;
            assert!((found - mean).abs() < 1e-6, "{found} and {mean}");
            let start = learner.params.actors.read().to_vec();
            let grads = learner.scratch.actor_grads.clone();
            let steepest = |range: std::ops::Range<usize>| {
                range.max_by(|&a, &b| grads[a].abs().total_cmp(&grads[b].abs())).unwrap()
            };
            // each with whose objective it moves: both actors' first weights and last biases, a weight of a received
            // message, the steepest coordinate; an encoder moves what its receiver does
            let actors = &learner.actors;
            let [first, second] = [0, 1].map(|i| actors.range(i));
            let mut places: Vec<_> = [0, 5, second.start - 1, steepest(first)].map(|at| (at, 0)).to_vec();
            places.extend([second.start, second.start + 6, second.end - 1, steepest(second)].map(|at| (at, 1)));
            for j in 0..actors.encoders.len() {
                let own = actors.encoder_range(j);
                places.extend([own.start, own.end - 1, steepest(own)].map(|at| (at, 1 - j)));
            }
            for (at, moved) in places {
                let mut values = [0.0; 2];
                for (value, step) in values.iter_mut().zip([1e-2f32, -1e-2]) {
                    let move_one = |p: &mut [f32]| {
                        p.copy_from_slice(&start);
                        p[at] += step;
                    };
                    learner.params.actors.update(move_one).unwrap();
                    *value = objective(&learner, &batch, groups[moved]);
                }
                let slope = -(values[0] - values[1]) / 2e-2;
                let error = (slope - f64::from(grads[at])).abs();
                assert!(error < 1e-5 + 0.02 * slope.abs(), "{at}: {slope} against {}, {actor_step:?}", grads[at]);
            }
        }
    }

    /// The gradient of the actors' loss by candle's autograd, from the definition.
    fn by_candle(learner: &Maddpg, batch: &Batch) -> Vec<f32> {
        let (actors, n, rows) = (&learner.actors, learner.actors.len(), batch.rows);
        let flat = |data: &[f32]| Tensor::from_slice(data, data.len(), &Device::Cpu).unwrap();
        let table = |data: &[f32]| flat(data).reshape((rows, data.len() / rows)).unwrap();
        let cat = |parts: &[&Tensor]| Tensor::cat(parts, 1).unwrap();
        let params = Var::from_tensor(&flat(&learner.params.actors.read())).unwrap();
        let critic = flat(&learner.params.critic.read());
        let (observations, replayed) = (table(&batch.observations), table(&batch.actions));
        let seen = |j: usize| observations.narrow(1, actors.observation_offset(j), actors.observation[j]).unwrap();
        let arrived = |j: usize, i: usize| {
            let bits = batch.link.chunks_exact(n * n).map(|bits| f32::from(u8::from(bits[j * n + i])));
            let bits = table(&bits.collect::<Vec<_>>());
            let sent = match actors.encoders.get(j) {
                Some(encoder) => encoder.by_candle(&params, actors.encoder_range(j).start, &seen(j)),
                None => seen(j),
            };
            sent.broadcast_mul(&bits).unwrap()
        };
        let acted: Vec<Tensor> = (0..n)
            .map(|i| {
                let others = (0..n).filter(|&j| j != i && actors.messages != Messages::Off);
                let input: Vec<Tensor> = [seen(i)].into_iter().chain(others.map(|j| arrived(j, i))).collect();
                actors.networks[i].by_candle(&params, actors.range(i).start, &cat(&input.iter().collect::<Vec<_>>()))
            })
            .collect();
        let groups: Vec<Vec<usize>> = match learner.config.actor_step {
            ActorStep::Joint => vec![(0..n).collect()],
            ActorStep::PerAgent => (0..n).map(|i| vec![i]).collect(),
        };
        let mut loss = Tensor::new(0.0f32, &Device::Cpu).unwrap();
        for fresh in groups {
            let others: Vec<Tensor> = (0..n).map(|i| replayed.narrow(1, 2 * i, 2).unwrap()).collect();
            let actions = (0..n).map(|i| if fresh.contains(&i) { &acted[i] } else { &others[i] });
            let joint: Vec<&Tensor> = [&observations].into_iter().chain(actions).collect();
            let q = learner.critic.by_candle(&critic, 0, &cat(&joint)).mean_all().unwrap();
            let squares = cat(&fresh.iter().map(|&i| &acted[i]).collect::<Vec<_>>()).sqr().unwrap().mean_all().unwrap();
            let penalty = (squares * f64::from(learner.config.action_penalty)).unwrap();
            loss = ((loss - q).unwrap() + penalty).unwrap();
        }
        loss.backward().unwrap().get(&params).unwrap().to_vec1().unwrap()
    }

    #[test]
    fn gradients_of_actors_and_encoders_equal_candles_autograd() {
        let agents = agents(3);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let batch = batch(300, 3);
        for actor_step in [ActorStep::Joint, ActorStep::PerAgent] {
            for (messages, encoder_hidden) in [
                (Messages::Observation, None),
                (Messages::Off, None),
                (Messages::Encoder, None),
                (Messages::Encoder, Some(vec![])),
                (Messages::Encoder, Some(vec![20, 7])),
            ] {
                let (grad_clip, action_penalty) = (f32::INFINITY, 0.1);
                let base = MaddpgConfig { grad_clip, action_penalty, messages, actor_step, ..MaddpgConfig::default() };
                let config = MaddpgConfig { encoder_hidden, ..base };
                let mut learner = Maddpg::new(&agents, Activation::Tanh, config, &Seeds::new(4)).unwrap();
                learner.td_pass(&batch, &[], false); // lays out the critic
                learner.actor_pass(&batch);
                let (found, exact) = (&learner.scratch.actor_grads, by_candle(&learner, &batch));
                assert_eq!(found.len(), exact.len());
                let actors = &learner.actors;
                let all =
                    (0..3).map(|i| actors.range(i)).chain((0..actors.encoders.len()).map(|j| actors.encoder_range(j)));
                for range in all {
                    let scale = exact[range.clone()].iter().fold(0.0f32, |m, g| m.max(g.abs()));
                    assert!(scale > 1e-4, "nothing to compare: {scale}");
                    for at in range {
                        let error = (found[at] - exact[at]).abs();
                        assert!(
                            error <= 1e-5 * scale,
                            "{at}: {} and {}, {actor_step:?}, {messages:?}",
                            found[at],
                            exact[at]
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn an_encoder_learns_through_those_alone_who_receive_it() {
        let agents = agents(3);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let config = MaddpgConfig { messages: Messages::Encoder, ..MaddpgConfig::default() };
        let mut learner = Maddpg::new(&agents, Activation::Tanh, config, &Seeds::new(4)).unwrap();
        let mut batch = batch(150, 3);
        let silent = |at: usize| (at % 9).is_multiple_of(4);
        batch.link = (0..9 * 150).map(|at| silent(at) || at % 9 == 5).collect(); // of all messages, 1 → 2 alone arrives
        learner.td_pass(&batch, &[], false);
        let (_, [actors, encoders]) = learner.actor_pass(&batch);
        assert!(actors > 0.0 && encoders > 0.0);
        let moved: Vec<bool> = (0..3)
            .map(|j| learner.scratch.actor_grads[learner.actors.encoder_range(j)].iter().any(|&g| g != 0.0))
            .collect();
        assert_eq!(moved, [false, true, false]);
        batch.link = (0..9 * 150).map(silent).collect();
        assert_eq!(learner.actor_pass(&batch).1[1], 0.0);
        // where no message ever arrives, as for maddpg, the encoders stay as they are
        batch.next_link.clone_from(&batch.link);
        let before = learner.params.actors.read().to_vec();
        let found = learner.update(&batch, &[]).unwrap();
        assert_eq!(found.encoder_grad_norm, Some(0.0));
        let (own, after) = (learner.actors.encoder_range(0).start, learner.params.actors.read());
        assert!(before[own..] == after[own..] && before[..own] != after[..own]);
    }

    #[test]
    fn a_gradient_that_is_no_number_is_reported_as_none() {
        let agents = agents(3);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let base = MaddpgConfig { messages: Messages::Encoder, ..MaddpgConfig::default() };
        let config = MaddpgConfig { action_penalty: f32::NAN, ..base };
        let mut learner = Maddpg::new(&agents, Activation::Tanh, config, &Seeds::new(4)).unwrap();
        let found = learner.update(&batch(150, 3), &[]).unwrap();
        assert!(found.actor_objective.is_finite() && found.td_loss.is_finite(), "{found:?}");
        assert!(found.actor_grad_norm.is_nan() && found.encoder_grad_norm.unwrap().is_nan(), "{found:?}");
        let [nan, one] = [f32::NAN, 1.0];
        assert!(larger(nan, one).is_nan() && larger(one, nan).is_nan() && larger(one, 2.0) == 2.0);
    }

    #[test]
    fn an_encoders_gradient_is_clipped_by_itself_and_its_target_follows() {
        let agents = agents(2);
        let agents: Vec<&AgentSpec> = agents.iter().collect();
        let batch = batch(150, 2);
        let made = |grad_clip| {
            let config = MaddpgConfig { messages: Messages::Encoder, grad_clip, ..MaddpgConfig::default() };
            let mut learner = Maddpg::new(&agents, Activation::Tanh, config, &Seeds::new(4)).unwrap();
            learner.td_pass(&batch, &[], false);
            learner
        };
        let (mut free, mut bound) = (made(f32::INFINITY), made(1e-4));
        let (_, norms) = free.actor_pass(&batch);
        assert_eq!(bound.actor_pass(&batch).1, norms);
        for range in [0, 1].map(|j| free.actors.encoder_range(j)) {
            let norm =
                |learner: &Maddpg| clip_norm(&mut learner.scratch.actor_grads[range.clone()].to_vec(), f32::INFINITY);
            assert!(norm(&free) > 2e-4 && (norm(&bound) - 1e-4).abs() < 1e-6, "{} and {}", norm(&free), norm(&bound));
        }
        let start = free.params.actors.read().to_vec();
        free.update(&batch, &[]).unwrap();
        let (online, target) = (free.params.actors.read(), free.params.target_actors.read());
        let moved = |at: usize| start[at] + 0.01 * (online[at] - start[at]);
        assert!(free.actors.encoder_range(1).all(|at| (target[at] - moved(at)).abs() < 1e-7));
        assert!(free.actors.encoder_range(1).any(|at| online[at] != start[at]));
    }

    #[test]
    fn the_critics_gradient_equals_finite_differences_of_its_loss() {
        let agents = agents(2);
        let config = MaddpgConfig::default();
        let mut learner =
            Maddpg::new(&agents.iter().collect::<Vec<_>>(), Activation::Tanh, config, &Seeds::new(4)).unwrap();
        let batch = batch(300, 2);
        learner.td_pass(&batch, &[], true);
        let mut grads = vec![0.0; learner.critic.parameters()];
        learner.critic.unpack_grads(&learner.scratch.critic_packed_grads, &mut grads);
        let square: f64 = grads.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
        let start = learner.params.critic.read().to_vec();
        let h = 1e-2 / square.sqrt();
        let mut at = |h: f64| {
            let moved = |p: &mut [f32]| {
                p.iter_mut().zip(&start).zip(&grads).for_each(|((p, s), g)| *p = s + (h * f64::from(*g)) as f32);
            };
            learner.params.critic.update(moved).unwrap();
            learner.td_loss(&batch)
        };
        let slope = (at(h) - at(-h)) / (2.0 * h);
        assert!((slope / square - 1.0).abs() < 1e-2, "{slope} against {square}");
    }
}
