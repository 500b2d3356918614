//! A team of actors acting on many rows at once: what the learner and a batched rollout share.
//!
//! Parameters are laid out for the kernels once ([`Team::load`]) and used until they change. Where a message is the
//! observation, the input of actor i is all learners' observations with the lost ones zeroed; its first weight is
//! permuted to that order when it is loaded, so that nothing is gathered per row. Where messages are encoded, the input
//! is gathered: own observation, then what arrived of the others'.

use super::encoders::{EncoderScratch, Encoders};
use super::{Actors, Messages};
use crate::nn::{Input, Packed, Passes};

/// Actors with their parameters laid out, and their encoders where they have any.
#[derive(Clone, Debug, Default)]
pub struct Team {
    packed: Vec<Packed>,
    grads: Vec<Packed>,
    encoders: Encoders,
}

/// What a team acts on: rows that follow each other.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'a> {
    /// `[rows, O]`, all learners.
    pub observations: &'a [f32],
    /// What was sent, `[rows, M]`; not looked at where a message is the observation.
    pub messages: &'a [f32],
    /// `[rows, N²]`, sender by receiver.
    pub link: &'a [bool],
}

/// The buffers in which a team acts; nothing is allocated once they are warm.
#[derive(Clone, Debug, Default)]
pub struct TeamScratch {
    members: Vec<Member>,
}

#[derive(Clone, Debug, Default)]
struct Member {
    /// What enters the network, where that is not the rows of all observations as they are.
    input: Vec<f32>,
    gathered: bool,
    /// ∂L/∂(what it heard), `[rows, messages of the others]`.
    heard: Vec<f32>,
    passes: Passes,
}

impl Team {
    /// Takes over parameters, for acting and learning.
    pub fn load(&mut self, actors: &Actors, params: &[f32]) {
        self.load_forward(actors, params);
        for (i, packed) in self.packed.iter_mut().enumerate() {
            packed.wanted = if actors.encodes() { actors.observation[i]..actors.input(i) } else { 0..0 };
            actors.networks[i].pack_backward(actors.slice(params, i), packed);
        }
        self.grads.resize_with(actors.len(), Packed::default);
        self.grads.iter_mut().zip(&self.packed).for_each(|(grads, packed)| grads.columns.clone_from(&packed.columns));
        self.encoders.load_backward(actors, params);
    }

    /// Takes over parameters, for acting alone.
    pub fn load_forward(&mut self, actors: &Actors, params: &[f32]) {
        self.packed.resize_with(actors.len(), Packed::default);
        for (i, packed) in self.packed.iter_mut().enumerate() {
            if actors.messages == Messages::Observation && packed.columns.is_empty() {
                packed.columns = columns(actors, i);
            }
            actors.networks[i].pack_forward(actors.slice(params, i), packed);
        }
        self.encoders.load_forward(actors, params);
    }

    /// Takes over parameters of the encoders alone, for sending.
    pub(super) fn load_encoders(&mut self, actors: &Actors, params: &[f32]) {
        self.encoders.load_forward(actors, params);
    }

    /// What all learners send on `rows` rows of `observations` `[rows, O]`, into `messages` `[rows, M]`; nothing where a
    /// message is the observation. A row's messages do not depend on the rows beside it, to the bit.
    pub fn encode(
        &self,
        actors: &Actors,
        (observations, rows): (&[f32], usize),
        scratch: &mut EncoderScratch,
        messages: &mut Vec<f32>,
    ) {
        self.encoders.encode(actors, (observations, rows), scratch, messages);
    }

    /// What learner `j` alone sends on `rows` rows of its own observations `[rows, observation]`, `[rows, message]`; the
    /// same bits as among all.
    pub(super) fn encode_of<'s>(
        &self,
        actors: &Actors,
        j: usize,
        (observations, rows): (&[f32], usize),
        scratch: &'s mut EncoderScratch,
    ) -> &'s [f32] {
        let input = Input { data: observations, stride: actors.observation[j] };
        self.encoders.encode_of(actors, j, (input, rows), scratch)
    }

    /// All actors act on `rows` rows. A row's actions do not depend on the rows beside it, to the bit.
    pub fn act(&self, actors: &Actors, sight: Sight<'_>, rows: usize, scratch: &mut TeamScratch) {
        scratch.members.resize_with(actors.len(), Member::default);
        for (i, (packed, member)) in self.packed.iter().zip(&mut scratch.members).enumerate() {
            member.receive(actors, i, sight, rows);
            let Member { input, gathered, passes, .. } = member;
            let input = of(actors, i, if *gathered { input } else { sight.observations });
            actors.networks[i].forward_packed(packed, input, rows, passes);
        }
    }

    /// Sets the gradients of all actors and encoders to zero.
    pub(super) fn clear_grads(&mut self, actors: &Actors) {
        for (network, grads) in actors.networks.iter().zip(&mut self.grads) {
            network.clear_grads(grads);
        }
        self.encoders.clear_grads(actors);
    }

    /// Backward pass of actor `i` on the rows of the last [`Self::act`] in `scratch`, given ∂L/∂action `[rows, action]`;
    /// what it gives to the messages is added up in `sending`.
    pub(super) fn backward(
        &mut self,
        actors: &Actors,
        i: usize,
        (sight, rows): (Sight<'_>, usize),
        grad: &[f32],
        (scratch, sending): (&mut TeamScratch, &mut EncoderScratch),
    ) {
        let Member { input, gathered, heard, passes } = &mut scratch.members[i];
        let input = of(actors, i, if *gathered { input } else { sight.observations });
        let (packed, grads) = (&self.packed[i], Some(&mut self.grads[i]));
        if !actors.encodes() || actors.heard(i) == 0 {
            return actors.networks[i].backward_packed(packed, input, rows, passes, grad, grads, None);
        }
        heard.resize(rows * actors.heard(i), 0.0);
        actors.networks[i].backward_packed(packed, input, rows, passes, grad, grads, Some(heard));
        sending.collect(actors, i, heard, sight.link);
    }

    /// Backward pass of the encoders on the rows of the last [`Self::encode`] in `sending`, given what
    /// [`Self::backward`] has added up there.
    pub(super) fn backward_encoders(
        &mut self,
        actors: &Actors,
        (observations, rows): (&[f32], usize),
        sending: &mut EncoderScratch,
    ) {
        self.encoders.backward(actors, (observations, rows), sending);
    }

    /// Writes actor `i`'s gradients in the order of its parameters.
    pub(super) fn grads(&self, actors: &Actors, i: usize, flat: &mut [f32]) {
        flat.fill(0.0);
        actors.networks[i].unpack_grads(&self.grads[i], flat);
    }

    /// Writes encoder `j`'s gradients in the order of its parameters.
    pub(super) fn encoder_grads(&self, actors: &Actors, j: usize, flat: &mut [f32]) {
        self.encoders.grads(actors, j, flat);
    }
}

impl TeamScratch {
    /// What actor `i` did on the rows of the last [`Team::act`], `[rows, action]`.
    pub fn actions(&self, i: usize) -> &[f32] {
        self.members[i].passes.output()
    }
}

impl Member {
    /// Lays out what enters actor `i`, where that is not the rows of all observations as they are.
    fn receive(&mut self, actors: &Actors, i: usize, sight: Sight<'_>, rows: usize) {
        let n = actors.len();
        let link = &sight.link[..rows * n * n];
        match actors.messages {
            Messages::Off => self.gathered = false,
            Messages::Observation => {
                self.gathered = !all_received(n, i, link);
                if self.gathered {
                    self.zero_lost(actors, i, sight.observations, link);
                }
            }
            Messages::Encoder => {
                self.gathered = true;
                self.input.clear();
                let [seen, sent] = [&actors.observation, &actors.message].map(|widths| widths.iter().sum());
                let observed = sight.observations.chunks_exact(seen).zip(sight.messages.chunks_exact(sent));
                for ((observations, messages), bits) in observed.zip(link.chunks_exact(n * n)) {
                    actors.push_input(i, observations, messages, bits, &mut self.input);
                }
            }
        }
    }

    /// All observations with those zeroed that actor `i` did not receive.
    fn zero_lost(&mut self, actors: &Actors, i: usize, observations: &[f32], link: &[bool]) {
        let (n, width) = (actors.len(), actors.observation.iter().sum::<usize>());
        self.input.clear();
        self.input.extend_from_slice(&observations[..link.len() / (n * n) * width]);
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

/// Rows as the input of actor `i`: of all observations, or gathered for it alone.
fn of<'a>(actors: &Actors, i: usize, rows: &'a [f32]) -> Input<'a> {
    let stride = actors.observation.iter().sum();
    match actors.messages {
        Messages::Off => Input { data: &rows[actors.observation_offset(i)..], stride },
        Messages::Observation => Input { data: rows, stride },
        Messages::Encoder => Input { data: rows, stride: actors.input(i) },
    }
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
    use crate::algo::{MaddpgConfig, agent};
    use crate::nn::{Activation, Tape};
    use crate::rng::{self, Seeds};
    use crate::schema::AgentSpec;

    #[test]
    fn a_team_acts_as_its_actors_do_one_row_at_a_time() {
        let agents: Vec<AgentSpec> =
            [5, 3, 4].iter().enumerate().map(|(i, &seen)| agent(&format!("agent_{i}"), seen, 1 + i)).collect();
        let rows = 200;
        let mut rng = Seeds::new(1).stream("team");
        let observations: Vec<f32> = (0..rows * 12).map(|_| rng::normal(&mut rng) as f32).collect();
        let lossy: Vec<bool> = (0..rows * 9).map(|at| at % 9 % 4 == 0 || rng::bernoulli(&mut rng, 0.5)).collect();
        for (messages, link) in [
            (Messages::Observation, lossy.clone()),
            (Messages::Observation, vec![true; rows * 9]),
            (Messages::Off, lossy.clone()),
            (Messages::Encoder, lossy),
            (Messages::Encoder, vec![true; rows * 9]),
        ] {
            let config = MaddpgConfig { hidden: vec![20, 64], messages, message_width: Some(3), ..Default::default() };
            let actors = Actors::new(&agents.iter().collect::<Vec<_>>(), Activation::Tanh, &config);
            let params = actors.init(&mut rng);
            let mut team = Team::default();
            team.load(&actors, &params);
            let mut sending = EncoderScratch::default();
            let [mut scratch, mut single] = [(); 2].map(|()| TeamScratch::default());
            let [mut sent, mut sent_alone] = [(); 2].map(|()| Vec::new());
            team.encode(&actors, (&observations, rows), &mut sending, &mut sent);
            let messages = if actors.encodes() { &sent } else { &observations };
            team.act(&actors, Sight { observations: &observations, messages, link: &link }, rows, &mut scratch);
            let (mut input, mut tape) = (Vec::new(), Tape::default());
            for row in 0..rows {
                let (observations, link) = (&observations[row * 12..], &link[row * 9..]);
                let messages = &messages[row * actors.message.iter().sum::<usize>()..];
                team.encode(&actors, (observations, 1), &mut sending, &mut sent_alone);
                assert_eq!(sent_alone, sent[row * sent_alone.len()..][..sent_alone.len()], "row {row}: sent alone");
                for (j, encoder) in actors.encoders.iter().enumerate() {
                    let seen = &observations[actors.observation_offset(j)..];
                    let sent = encoder.forward(&params[actors.encoder_range(j)], seen, 1, &mut tape);
                    for (a, b) in sent.iter().zip(&sent_alone[3 * j..]) {
                        assert!((a - b).abs() < 1e-6 && a.abs() < 1.0, "row {row}, sender {j}: {a} and {b}");
                    }
                }
                team.act(&actors, Sight { observations, messages, link }, 1, &mut single);
                for i in 0..3 {
                    input.clear();
                    actors.push_input(i, observations, messages, link, &mut input);
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
