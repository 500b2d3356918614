//! A team of actors acting on many rows at once: what the learner and a batched rollout share.
//!
//! Parameters are laid out for the kernels once ([`Team::load`]) and used until they change. The input of actor i is
//! all learners' observations with the lost ones zeroed; its first weight is permuted to that order when it is loaded,
//! so that nothing is gathered per row.

use super::Actors;
use crate::nn::{Input, Packed, Passes};

/// Actors with their parameters laid out.
#[derive(Clone, Debug, Default)]
pub struct Team {
    packed: Vec<Packed>,
    grads: Vec<Packed>,
}

/// The buffers in which a team acts; nothing is allocated once they are warm.
#[derive(Clone, Debug, Default)]
pub struct TeamScratch {
    members: Vec<Member>,
}

#[derive(Clone, Debug, Default)]
struct Member {
    /// Observations with the lost ones zeroed, `[rows, O]`; unused when nothing was lost.
    input: Vec<f32>,
    lossless: bool,
    passes: Passes,
}

impl Team {
    /// Takes over parameters, for acting and learning.
    pub fn load(&mut self, actors: &Actors, params: &[f32]) {
        self.load_forward(actors, params);
        for (i, packed) in self.packed.iter_mut().enumerate() {
            actors.networks[i].pack_backward(actors.slice(params, i), packed);
        }
        self.grads.resize_with(actors.len(), Packed::default);
        self.grads.iter_mut().zip(&self.packed).for_each(|(grads, packed)| grads.columns.clone_from(&packed.columns));
    }

    /// Takes over parameters, for acting alone.
    pub fn load_forward(&mut self, actors: &Actors, params: &[f32]) {
        self.packed.resize_with(actors.len(), Packed::default);
        for (i, packed) in self.packed.iter_mut().enumerate() {
            if actors.messages && packed.columns.is_empty() {
                packed.columns = columns(actors, i);
            }
            actors.networks[i].pack_forward(actors.slice(params, i), packed);
        }
    }

    /// All actors act on `rows` rows of `observations` `[rows, O]` under the link bits `[rows, N²]`, sender by receiver.
    /// A row's actions do not depend on the rows beside it, to the bit.
    pub fn act(&self, actors: &Actors, observations: &[f32], link: &[bool], rows: usize, scratch: &mut TeamScratch) {
        scratch.members.resize_with(actors.len(), Member::default);
        for (i, (packed, member)) in self.packed.iter().zip(&mut scratch.members).enumerate() {
            member.lossless = !actors.messages || all_received(actors.len(), i, &link[..rows * actors.len().pow(2)]);
            if !member.lossless {
                member.receive(actors, i, observations, link, rows);
            }
            let Member { input, lossless, passes } = member;
            let input = if *lossless { observations } else { input };
            actors.networks[i].forward_packed(packed, of(actors, i, input), rows, passes);
        }
    }

    /// Sets the gradients of all actors to zero.
    pub(super) fn clear_grads(&mut self, actors: &Actors) {
        for (network, grads) in actors.networks.iter().zip(&mut self.grads) {
            network.clear_grads(grads);
        }
    }

    /// Backward pass of actor `i` on the rows of the last [`Self::act`] in `scratch`, given ∂L/∂action `[rows, action]`.
    pub(super) fn backward(
        &mut self,
        actors: &Actors,
        i: usize,
        (observations, rows): (&[f32], usize),
        grad: &[f32],
        scratch: &mut TeamScratch,
    ) {
        let Member { input, lossless, passes } = &mut scratch.members[i];
        let input = of(actors, i, if *lossless { observations } else { input });
        let grads = Some(&mut self.grads[i]);
        actors.networks[i].backward_packed(&self.packed[i], input, rows, passes, grad, grads, None);
    }

    /// Writes actor `i`'s gradients in the order of its parameters.
    pub(super) fn grads(&self, actors: &Actors, i: usize, flat: &mut [f32]) {
        flat.fill(0.0);
        actors.networks[i].unpack_grads(&self.grads[i], flat);
    }
}

impl TeamScratch {
    /// What actor `i` did on the rows of the last [`Team::act`], `[rows, action]`.
    pub fn actions(&self, i: usize) -> &[f32] {
        self.members[i].passes.output()
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
            let [mut scratch, mut single] = [(); 2].map(|()| TeamScratch::default());
            team.act(&actors, &observations, &link, rows, &mut scratch);
            let (mut input, mut tape) = (Vec::new(), Tape::default());
            for row in 0..rows {
                team.act(&actors, &observations[row * 12..], &link[row * 9..], 1, &mut single);
                for i in 0..3 {
                    input.clear();
                    actors.push_input(i, &observations[row * 12..], &link[row * 9..], &mut input);
                    let alone = actors.act(&params, i, &input, 1, &mut tape);
                    let among = &scratch.actions(i)[row * (1 + i)..][..=i];
                    assert_eq!(single.actions(i), among, "row {row}, actor {i}: alone and among others");
                    for (a, b) in alone.iter().zip(among) {
                        assert!((a - b).abs() < 1e-6, "row {row}, actor {i}: {a} and {b}");
                    }
                }
            }
        }
    }
}
