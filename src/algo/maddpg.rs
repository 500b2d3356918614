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
//! actor loss). Lowe's own step, actor i's action alone from its policy and the others' from replay, is
//! [`ActorStep::PerAgent`]. Link bits are as drawn at rollout, `ι_t` for o and ι_{t+1} for o', or
//! redrawn ([`Masks`](super::Masks)).
//!
//! The batch goes through in tiles of 128 rows, each through every network before the next, so that activations stay
//! in the second-level cache.

use super::config::{ActorStep, MaddpgConfig, Messages};
use super::{Actors, Team, TeamScratch};
use crate::nn::{Activation, Adam, AdamConfig, Input, Mlp, NnError, Packed, Params, Passes, TILE, clip_norm};
use crate::rng::Seeds;
use crate::schema::AgentSpec;

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
    /// Shaping bonus stored at rollout `[B]`; zeros when shaping is computed on the minibatch or off.
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

/// Networks laid out for the kernels, and buffers; reused, so that updates allocate nothing once they are warm.
#[derive(Debug, Default)]
struct Scratch {
    team: Team,
    target_team: Team,
    acting: TeamScratch,
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
        // 1. and 2. target and critic; its target follows at once, since nothing reads it before the next update
        let [td_loss, q_mean] = self.td_pass(batch, bonus, true);
        let grads = &mut self.scratch.critic_grads;
        grads.clear();
        grads.resize(self.critic.parameters(), 0.0);
        self.critic.unpack_grads(&self.scratch.critic_packed_grads, grads);
        let critic_grad_norm = clip_norm(grads, self.config.grad_clip);
        follow(&mut self.critic_adam, &self.params.critic, &self.params.target_critic, grads, self.config.tau)?;

        // 3. actors, through the critic just updated, and 4. their targets
        let (actor_objective, actor_grad_norm) = self.actor_pass(batch);
        let grads = &self.scratch.actor_grads;
        follow(&mut self.actor_adam, &self.params.actors, &self.params.target_actors, grads, self.config.tau)?;
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
            target_team.act(actors, tile.next_observations, tile.next_link, rows, acting);
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

    /// Mean Q(o, π(o, M)) and the largest gradient norm of an actor; clipped gradients in `scratch.actor_grads`.
    fn actor_pass(&mut self, batch: &Batch) -> (f64, f32) {
        let widths = Widths::of(&self.actors);
        let (actors, critic) = (&self.actors, &self.critic);
        let Scratch {
            joint, team, acting, passes, grad_q, grad_joint, grad_action, actor_grads, critic: packed, ..
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
            team.act(actors, tile.observations, tile.link, rows, acting);
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
                    team.backward(actors, i, (tile.observations, rows), grad_action, acting);
                }
            }
        }
        actor_grads.resize(actors.parameters(), 0.0);
        let mut norm = 0.0f32;
        for i in 0..n {
            let grads = &mut actor_grads[actors.offsets[i]..actors.offsets[i + 1]];
            team.grads(actors, i, grads);
            norm = norm.max(clip_norm(grads, self.config.grad_clip));
        }
        (objective / (batch.rows * passes_needed) as f64, norm)
    }
}

/// One Adam step of `online`, and `target`'s step towards it.
fn follow(adam: &mut Adam, online: &Params, target: &Params, grads: &[f32], tau: f32) -> Result<(), NnError> {
    let mut moved = Ok(());
    online.update(|params| moved = target.update(|target| adam.step_and_follow(params, grads, target, tau)))?;
    moved
}

/// Consecutive rows of a batch.
struct Tile<'a> {
    observations: &'a [f32],
    next_observations: &'a [f32],
    actions: &'a [f32],
    link: &'a [bool],
    next_link: &'a [bool],
    reward: &'a [f32],
}

impl<'a> Tile<'a> {
    fn of(batch: &'a Batch, start: usize, rows: usize, widths: Widths, learners: usize) -> Self {
        let [o, a, l] =
            [widths.observations, widths.actions, learners * learners].map(|w| start * w..(start + rows) * w);
        Self {
            observations: &batch.observations[o.clone()],
            next_observations: &batch.next_observations[o],
            actions: &batch.actions[a],
            link: &batch.link[l.clone()],
            next_link: &batch.next_link[l],
            reward: &batch.reward[start..start + rows],
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

    /// Columns of actor `i`'s action in the critic's input.
    fn action(self, actors: &Actors, i: usize) -> std::ops::Range<usize> {
        let start = self.observations + actors.networks[..i].iter().map(Mlp::outputs).sum::<usize>();
        start..start + actors.networks[i].outputs()
    }

    /// Lays rows into the critic's input rows, from column `at`.
    fn put(self, joint: &mut [f32], rows: &[f32], at: usize) {
        let width = rows.len() * self.joint() / joint.len();
        for (to, from) in joint.chunks_exact_mut(self.joint()).zip(rows.chunks_exact(width)) {
            to[at..at + width].copy_from_slice(from);
        }
    }

    fn input(self, joint: &[f32]) -> Input<'_> {
        Input { data: joint, stride: self.joint() }
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

    /// What the actors climb, from the definition and one network at a time: mean Q with the actions of `fresh` actors
    /// from their policies and the others' from the batch.
    fn objective(learner: &Maddpg, batch: &Batch, fresh: &[usize]) -> f64 {
        let (mut joint, mut input) = (Vec::new(), Vec::new());
        let mut tape = crate::nn::Tape::default();
        for row in 0..batch.rows {
            let observations = &batch.observations[row * 7..(row + 1) * 7];
            joint.extend_from_slice(observations);
            for i in 0..2 {
                if fresh.contains(&i) {
                    input.clear();
                    learner.actors.push_input(i, observations, &batch.link[row * 4..], &mut input);
                    let params = learner.params.actors.read();
                    joint.extend_from_slice(learner.actors.act(&params, i, &input, 1, &mut tape));
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
        let batch = batch(150);
        for actor_step in [ActorStep::Joint, ActorStep::PerAgent] {
            let config =
                MaddpgConfig { grad_clip: f32::INFINITY, action_penalty: 0.0, actor_step, ..MaddpgConfig::default() };
            let mut learner = Maddpg::new(&agents, Activation::Sigmoid, config, &Seeds::new(4)).unwrap();
            learner.td_pass(&batch, &[], false);
            let (found, _) = learner.actor_pass(&batch);
            let groups: &[&[usize]] = if actor_step == ActorStep::Joint { &[&[0, 1], &[0, 1]] } else { &[&[0], &[1]] };
            let mean = groups.iter().map(|fresh| objective(&learner, &batch, fresh)).sum::<f64>() / 2.0;
            assert!((found - mean).abs() < 1e-6, "{found} and {mean}");
            let start = learner.params.actors.read().to_vec();
            let grads = learner.scratch.actor_grads.clone();
            // both actors' first weights and last biases, a weight of a received message, and the steepest coordinate
            let steepest = (0..grads.len()).max_by(|&a, &b| grads[a].abs().total_cmp(&grads[b].abs())).unwrap();
            let second = learner.actors.offsets[1];
            for at in [0, 5, second, second - 1, second + 6, grads.len() - 1, steepest] {
                let mut values = [0.0; 2];
                for (value, step) in values.iter_mut().zip([1e-2f32, -1e-2]) {
                    let move_one = |p: &mut [f32]| {
                        p.copy_from_slice(&start);
                        p[at] += step;
                    };
                    learner.params.actors.update(move_one).unwrap();
                    *value = objective(&learner, &batch, groups[usize::from(at >= second)]);
                }
                let slope = -(values[0] - values[1]) / 2e-2;
                let error = (slope - f64::from(grads[at])).abs();
                assert!(error < 1e-5 + 0.02 * slope.abs(), "{at}: {slope} against {}, {actor_step:?}", grads[at]);
            }
        }
    }

    #[test]
    fn the_critics_gradient_equals_finite_differences_of_its_loss() {
        let agents = agents(2);
        let config = MaddpgConfig::default();
        let mut learner =
            Maddpg::new(&agents.iter().collect::<Vec<_>>(), Activation::Tanh, config, &Seeds::new(4)).unwrap();
        let batch = batch(300);
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
