//! A team of actors acting on many rows at once: what the learner and a batched rollout share.
//!
//! Parameters are laid out for the kernels once ([`Team::load`]) and used until they change. The input of actor i is
//! all learners' observations with the lost ones zeroed; its first weight is permuted to that order when it is loaded,
//! so that nothing is gathered per row.

use super::Actors;
use crate::nn::{Input, Packed, Passes};

/// Actors with their parameters laid out, and the buffers in which they act; nothing is allocated once it is warm.
#[derive(Debug, Default)]
pub struct Team {
    members: Vec<Member>,
}

#[derive(Debug, Default)]
struct Member {
    packed: Packed,
    grads: Packed,
    /// Observations with the lost ones zeroed, `[rows, O]`; unused when nothing was lost.
    input: Vec<f32>,
    lossless: bool,
    passes: Passes,
}

impl Team {
    /// Takes over parameters.
    pub fn load(&mut self, actors: &Actors, params: &[f32]) {
        self.members.resize_with(actors.len(), Member::default);
        for (i, member) in self.members.iter_mut().enumerate() {
            if actors.messages && member.packed.columns.is_empty() {
                member.packed.columns = columns(actors, i);
                member.grads.columns.clone_from(&member.packed.columns);
            }
            actors.networks[i].pack(actors.slice(params, i), &mut member.packed);
        }
    }

    /// All actors act on `rows` rows of `observations` `[rows, O]` under the link bits `[rows, N²]`, sender by receiver.
    pub fn act(&mut self, actors: &Actors, observations: &[f32], link: &[bool], rows: usize) {
        for (i, member) in self.members.iter_mut().enumerate() {
            member.lossless = !actors.messages || all_received(actors.len(), i, &link[..rows * actors.len().pow(2)]);
            if !member.lossless {
                member.receive(actors, i, observations, link, rows);
            }
            let Member { packed, input, lossless, passes, .. } = member;
            let input = if *lossless { observations } else { input };
            actors.networks[i].forward_packed(packed, of(actors, i, input), rows, passes);
        }
    }

    /// What actor `i` did on the rows of the last [`Self::act`], `[rows, action]`.
    pub fn actions(&self, i: usize) -> &[f32] {
        self.members[i].passes.output()
    }

    /// Sets the gradients of all actors to zero.
    pub(super) fn clear_grads(&mut self, actors: &Actors) {
        for (network, member) in actors.networks.iter().zip(&mut self.members) {
            network.clear_grads(&mut member.grads);
        }
    }

    /// Backward pass of actor `i` on the rows of the last [`Self::act`], given ∂L/∂action `[rows, action]`.
    pub(super) fn backward(&mut self, actors: &Actors, i: usize, observations: &[f32], rows: usize, grad: &[f32]) {
        let Member { packed, grads, input, lossless, passes } = &mut self.members[i];
        let input = of(actors, i, if *lossless { observations } else { input });
        actors.networks[i].backward_packed(packed, input, rows, passes, grad, Some(grads), None);
    }

    /// Writes actor `i`'s gradients in the order of its parameters.
    pub(super) fn grads(&self, actors: &Actors, i: usize, flat: &mut [f32]) {
        flat.fill(0.0);
        actors.networks[i].unpack_grads(&self.members[i].grads, flat);
    }
}

impl Member {
    /// Zeroes what actor `i` did not receive.
    fn receive(&mut self, actors: &Actors, i: usize, observations: &[f32], link: &[bool], rows: usize) {
        let (n, width) = (actors.len(), actors.observation.iter().sum::<usize>());
        self.input.clear();
        self.input.extend_from_slice(&observations[..rows * width]);
        for (row, bits) in self.input.chunks_exact_mut(width).zip(link.chunks_exact(n * n)) {
            let mut at = 0;
            for (j, &observation) in actors.observation.iter().enumerate() {
                if j != i && !bits[j * n + i] {
                    row[at..at + observation].fill(0.0);
                }
                at += observation;
            }
        }
    }
}

/// Whether everything was delivered to learner `i` of `n`.
fn all_received(n: usize, i: usize, link: &[bool]) -> bool {
    link.chunks_exact(n * n).all(|bits| (0..n).all(|j| j == i || bits[j * n + i]))
}

/// The part of rows of all observations that enters actor `i`.
fn of<'a>(actors: &Actors, i: usize, rows: &'a [f32]) -> Input<'a> {
    let stride = actors.observation.iter().sum();
    Input { data: if actors.messages { rows } else { &rows[actors.observation_offset(i)..] }, stride }
}

/// Which column of actor `i`'s first weight, whose order is own observation first, belongs to each observed float.
fn columns(actors: &Actors, i: usize) -> Vec<u32> {
    let mut next = actors.observation[i];
    let mut columns = Vec::new();
    for (j, &width) in actors.observation.iter().enumerate() {
        let start = if j == i { 0 } else { next };
        columns.extend((start..start + width).map(|c| c as u32));
        next += if j == i { 0 } else { width };
    }
    columns
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Activation, Tape};
    use crate::rng::{self, Seeds};
    use crate::schema::{AgentSpec, Controller};

    #[test]
    fn a_team_acts_as_its_actors_do_one_row_at_a_time() {
        let agents: Vec<AgentSpec> = [5, 3, 4]
            .iter()
            .enumerate()
            .map(|(i, &observation)| AgentSpec {
                name: format!("agent_{i}"),
                team: "team".to_owned(),
                controller: Controller::Policy,
                learner: true,
                communicator: true,
                observation,
                message: observation,
                action: 1 + i,
            })
            .collect();
        let rows = 200;
        let mut rng = Seeds::new(1).stream("team");
        let observations: Vec<f32> = (0..rows * 12).map(|_| rng::normal(&mut rng) as f32).collect();
        let lossy: Vec<bool> = (0..rows * 9).map(|at| at % 9 % 4 == 0 || rng::bernoulli(&mut rng, 0.5)).collect();
        for (messages, link) in [(true, lossy.clone()), (true, vec![true; rows * 9]), (false, lossy)] {
            let actors = Actors::new(&agents.iter().collect::<Vec<_>>(), &[20, 64], Activation::Tanh, messages);
            let params = actors.init(&mut rng);
            let mut team = Team::default();
            team.load(&actors, &params);
            team.act(&actors, &observations, &link, rows);
            let (mut input, mut tape) = (Vec::new(), Tape::default());
            for row in 0..rows {
                for i in 0..3 {
                    input.clear();
                    actors.push_input(i, &observations[row * 12..], &link[row * 9..], &mut input);
                    let alone = actors.act(&params, i, &input, 1, &mut tape);
                    for (a, b) in alone.iter().zip(&team.actions(i)[row * (1 + i)..]) {
                        assert!((a - b).abs() < 1e-6, "row {row}, actor {i}: {a} and {b}");
                    }
                }
            }
        }
    }
}
