//! The encoders of a team on many rows at once: `m^j = f_j(o^j)`, one network per learner.
//!
//! They learn through the actors that receive them: ∂L/∂m^j of a row is the sum, over the receivers i whose bit ι^{ji}
//! of that row is set, of what actor i's backward pass gives at the inputs that m^j went into. A lost message gives
//! nothing. Where a message is the observation there is no encoder, and all of this does nothing.

use super::{Actors, Team};
use crate::nn::{Input, Mlp, Packed, Passes};

/// Encoders with their parameters laid out.
#[derive(Clone, Debug, Default)]
pub(super) struct Encoders {
    packed: Vec<Packed>,
    grads: Vec<Packed>,
}

/// The buffers in which encoders work; nothing is allocated once they are warm.
#[derive(Clone, Debug, Default)]
pub struct EncoderScratch {
    senders: Vec<Sender>,
}

#[derive(Clone, Debug, Default)]
struct Sender {
    passes: Passes,
    /// ∂L/∂message `[rows, message]`.
    grad: Vec<f32>,
}

impl Encoders {
    /// Takes over parameters, for sending alone.
    pub(super) fn load_forward(&mut self, actors: &Actors, params: &[f32]) {
        self.packed.resize_with(actors.encoders.len(), Packed::default);
        for (j, packed) in self.packed.iter_mut().enumerate() {
            actors.encoders[j].pack_forward(&params[actors.encoder_range(j)], packed);
        }
    }

    /// Adds to [`Self::load_forward`] what learning needs.
    pub(super) fn load_backward(&mut self, actors: &Actors, params: &[f32]) {
        for (j, packed) in self.packed.iter_mut().enumerate() {
            actors.encoders[j].pack_backward(&params[actors.encoder_range(j)], packed);
        }
        self.grads.resize_with(actors.encoders.len(), Packed::default);
    }

    /// What all learners send on `rows` rows of `observations` `[rows, O]`, into `messages` `[rows, M]`; nothing where a
    /// message is the observation. A row's messages do not depend on the rows beside it, to the bit.
    pub(super) fn encode(
        &self,
        actors: &Actors,
        (observations, rows): (&[f32], usize),
        scratch: &mut EncoderScratch,
        messages: &mut Vec<f32>,
    ) {
        let width: usize = actors.encoders.iter().map(Mlp::outputs).sum();
        messages.resize(rows * width, 0.0);
        let mut at = 0;
        for (j, encoder) in actors.encoders.iter().enumerate() {
            let (own, sent) =
                (encoder.outputs(), self.encode_of(actors, j, (seen(actors, j, observations), rows), scratch));
            for (to, from) in messages.chunks_exact_mut(width).zip(sent.chunks_exact(own)) {
                to[at..at + own].copy_from_slice(from);
            }
            at += own;
        }
    }

    /// What learner `j` alone sends on `rows` rows of its `input`, `[rows, message]`; the same bits as among all.
    pub(super) fn encode_of<'s>(
        &self,
        actors: &Actors,
        j: usize,
        (input, rows): (Input<'_>, usize),
        scratch: &'s mut EncoderScratch,
    ) -> &'s [f32] {
        scratch.senders.resize_with(actors.encoders.len(), Sender::default);
        actors.encoders[j].forward_packed(&self.packed[j], input, rows, &mut scratch.senders[j].passes)
    }

    /// Sets the gradients of all encoders to zero.
    pub(super) fn clear_grads(&mut self, actors: &Actors) {
        for (encoder, grads) in actors.encoders.iter().zip(&mut self.grads) {
            encoder.clear_grads(grads);
        }
    }

    /// Backward pass on the rows of the last [`Self::encode`] in `scratch`, which has collected ∂L/∂message.
    pub(super) fn backward(
        &mut self,
        actors: &Actors,
        (observations, rows): (&[f32], usize),
        scratch: &mut EncoderScratch,
    ) {
        for (j, (encoder, Sender { passes, grad })) in actors.encoders.iter().zip(&mut scratch.senders).enumerate() {
            let (input, grads) = (seen(actors, j, observations), Some(&mut self.grads[j]));
            encoder.backward_packed(&self.packed[j], input, rows, passes, grad, grads, None);
        }
    }

    /// Writes encoder `j`'s gradients in the order of its parameters.
    pub(super) fn grads(&self, actors: &Actors, j: usize, flat: &mut [f32]) {
        flat.fill(0.0);
        actors.encoders[j].unpack_grads(&self.grads[j], flat);
    }
}

impl EncoderScratch {
    /// Forgets ∂L/∂message: the next backward passes are of `rows` other rows.
    pub(super) fn clear_grads(&mut self, actors: &Actors, rows: usize) {
        for (encoder, sender) in actors.encoders.iter().zip(&mut self.senders) {
            sender.grad.clear();
            sender.grad.resize(rows * encoder.outputs(), 0.0);
        }
    }

    /// Adds ∂L/∂m of what actor `i` heard, `heard` `[rows, messages of the others]`, to the senders whose bit of the row
    /// is set.
    pub(super) fn collect(&mut self, actors: &Actors, i: usize, heard: &[f32], link: &[bool]) {
        let (n, width) = (actors.len(), actors.heard(i));
        let mut at = 0;
        for (j, sender) in self.senders.iter_mut().enumerate().filter(|(j, _)| *j != i) {
            let own = actors.message[j];
            let rows = heard.chunks_exact(width).zip(link.chunks_exact(n * n));
            for (to, (from, bits)) in sender.grad.chunks_exact_mut(own).zip(rows) {
                if bits[j * n + i] {
                    to.iter_mut().zip(&from[at..at + own]).for_each(|(to, from)| *to += from);
                }
            }
            at += own;
        }
    }
}

/// A learner's encoders, laid out for sending while nobody changes them.
#[derive(Debug)]
pub struct Senders<'a> {
    pub(super) actors: &'a Actors,
    pub(super) team: &'a Team,
    pub(super) scratch: &'a mut EncoderScratch,
}

impl Senders<'_> {
    /// What all learners send on `rows` rows of all observations `[rows, O]`, into `messages` `[rows, M]`.
    pub fn encode(&mut self, observations: &[f32], rows: usize, messages: &mut Vec<f32>) {
        self.team.encode(self.actors, (observations, rows), self.scratch, messages);
    }

    /// What learner `j` alone sends on `rows` rows of its own observations, `[rows, message]`; the same bits as among
    /// all.
    pub fn encode_of(&mut self, j: usize, observations: &[f32], rows: usize) -> &[f32] {
        self.team.encode_of(self.actors, j, (observations, rows), self.scratch)
    }
}

/// The part of rows of all observations, of which there may be none, that learner `j` sees.
fn seen<'a>(actors: &Actors, j: usize, rows: &'a [f32]) -> Input<'a> {
    let data = rows.get(actors.observation_offset(j)..).unwrap_or(&[]);
    Input { data, stride: actors.observation.iter().sum() }
}

#[cfg(test)]
mod tests {
    use crate::algo::{Maddpg, MaddpgConfig, Messages, agent};
    use crate::nn::Activation;
    use crate::rng::Seeds;

    #[test]
    fn messages_of_one_sender_are_those_among_all_and_of_no_rows_there_are_none() {
        let agents = [agent("a", 3, 2), agent("b", 4, 2), agent("c", 5, 2)];
        let agents: Vec<_> = agents.iter().collect();
        let learner = |messages| {
            let config = MaddpgConfig { messages, ..MaddpgConfig::default() };
            Maddpg::new(&agents, Activation::Tanh, config, &Seeds::new(4)).unwrap()
        };
        let (mut encoding, mut all) = (learner(Messages::Encoder), Vec::new());
        let observations: Vec<f32> = (0..150 * 12).map(|at| (at as f32).sin()).collect();
        let mut senders = encoding.senders().unwrap();
        senders.encode(&observations, 150, &mut all);
        assert_eq!(all.len(), 150 * 24);
        for (j, at) in [0, 3, 7].into_iter().enumerate() {
            let own: Vec<f32> = observations.chunks_exact(12).flat_map(|row| &row[at..at + 3 + j]).copied().collect();
            let among: Vec<f32> = all.chunks_exact(24).flat_map(|row| &row[8 * j..8 * j + 8]).copied().collect();
            assert_eq!(senders.encode_of(j, &own, 150), among);
        }
        senders.encode(&[], 0, &mut all);
        assert!(all.is_empty() && senders.encode_of(2, &[], 0).is_empty());
        assert!(learner(Messages::Observation).senders().is_none());
    }
}
