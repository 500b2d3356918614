//! The seed tree: every generator of the program is a named child of one seed.
//!
//! `Seeds::new(1).child("record").child("episode/17").stream("agent/2")` is the same `ChaCha8` stream on every
//! machine, whatever thread asks and in whatever order. There is no other way to make a generator.

use rand::{Rng, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

/// A random stream: portable, seekable, named.
pub type Stream = ChaCha8Rng;

/// A node of the seed tree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Seeds {
    key: [u8; 32],
}

impl Seeds {
    /// The root of the tree for a user's seed.
    pub fn new(seed: u64) -> Self {
        let mut hash = Sha256::new();
        hash.update(b"ccmarl seed v1");
        hash.update(seed.to_le_bytes());
        Self { key: hash.finalize().into() }
    }

    /// The node called `name` below this one.
    #[must_use]
    pub fn child(&self, name: &str) -> Self {
        let mut hash = Sha256::new();
        hash.update(self.key);
        hash.update(name.as_bytes());
        Self { key: hash.finalize().into() }
    }

    /// The numbered node `name/index` below this one.
    #[must_use]
    pub fn indexed(&self, name: &str, index: u64) -> Self {
        let mut hash = Sha256::new();
        hash.update(self.key);
        hash.update(name.as_bytes());
        hash.update(b"/");
        hash.update(index.to_le_bytes());
        Self { key: hash.finalize().into() }
    }

    /// A seed for another tree that belongs below this node.
    pub fn seed(&self) -> u64 {
        self.key.iter().take(8).fold(0, |seed, &byte| (seed << 8) | u64::from(byte))
    }

    /// A fresh stream, at its start, named `name` below this node.
    pub fn stream(&self, name: &str) -> Stream {
        ChaCha8Rng::from_seed(self.child(name).key)
    }

    /// A fresh stream, at its start, named `name/index` below this node.
    pub fn indexed_stream(&self, name: &str, index: u64) -> Stream {
        ChaCha8Rng::from_seed(self.indexed(name, index).key)
    }
}

/// Where a stream stands: enough to go on from exactly there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StreamState {
    seed: [u8; 32],
    word_pos_low: u64,
    word_pos_high: u64,
}

/// Saves where `stream` stands.
pub fn save(stream: &Stream) -> StreamState {
    let pos = stream.get_word_pos();
    StreamState { seed: stream.get_seed(), word_pos_low: pos as u64, word_pos_high: (pos >> 64) as u64 }
}

/// Makes a stream that goes on where `state` was saved.
pub fn restore(state: &StreamState) -> Stream {
    let mut stream = ChaCha8Rng::from_seed(state.seed);
    stream.set_word_pos(u128::from(state.word_pos_low) | (u128::from(state.word_pos_high) << 64));
    stream
}

/// Uniform in `[low, high)`, 53 random bits.
pub fn uniform<R: Rng + ?Sized>(rng: &mut R, low: f64, high: f64) -> f64 {
    let unit = (rng.next_u64() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0);
    low + (high - low) * unit
}

/// True with probability `p`.
pub fn bernoulli<R: Rng + ?Sized>(rng: &mut R, p: f64) -> bool {
    uniform(rng, 0.0, 1.0) < p
}

/// Standard normal, by Box–Muller over [`libm`]: the same value on every platform.
pub fn normal<R: Rng + ?Sized>(rng: &mut R) -> f64 {
    let radius = libm::sqrt(-2.0 * libm::log(1.0 - uniform(rng, 0.0, 1.0)));
    radius * libm::cos(core::f64::consts::TAU * uniform(rng, 0.0, 1.0))
}

/// A whole number in `0..n`; 0 when `n` is 0.
pub fn below<R: Rng + ?Sized>(rng: &mut R, n: usize) -> usize {
    if n < 2 { 0 } else { rng.random_range(0..n as u64) as usize }
}

/// A uniform random permutation of `0..n`.
pub fn permutation<R: Rng + ?Sized>(rng: &mut R, n: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for i in (1..n).rev() {
        order.swap(i, below(rng, i + 1));
    }
    order
}

/// A random cyclic permutation of `0..n` (Sattolo): no element stays in its place when `n > 1`.
pub fn derangement<R: Rng + ?Sized>(rng: &mut R, n: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for i in (1..n).rev() {
        order.swap(i, below(rng, i));
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_of_different_names_differ_and_of_equal_names_agree() {
        let seeds = Seeds::new(1);
        let a = normal(&mut seeds.stream("a"));
        assert_eq!(a, normal(&mut seeds.stream("a")));
        assert_ne!(a, normal(&mut seeds.stream("b")));
        assert_ne!(a, normal(&mut Seeds::new(2).stream("a")));
        assert_ne!(normal(&mut seeds.indexed_stream("e", 1)), normal(&mut seeds.indexed_stream("e", 11)));
    }

    #[test]
    fn a_saved_stream_goes_on_where_it_stood() {
        let mut stream = Seeds::new(7).stream("x");
        for _ in 0..13 {
            normal(&mut stream);
        }
        let mut again = restore(&save(&stream));
        assert_eq!(normal(&mut stream), normal(&mut again));
    }

    #[test]
    fn a_derangement_has_no_fixed_point() {
        let mut rng = Seeds::new(3).stream("d");
        for n in 2..40 {
            assert!(derangement(&mut rng, n).iter().enumerate().all(|(i, &j)| i != j));
        }
    }

    #[test]
    fn normals_have_mean_zero_and_variance_one() {
        let mut rng = Seeds::new(5).stream("n");
        let n = 100_000;
        let (mut sum, mut squares) = (0.0, 0.0);
        for _ in 0..n {
            let z = normal(&mut rng);
            sum += z;
            squares += z * z;
        }
        assert!((sum / f64::from(n)).abs() < 0.015);
        assert!((squares / f64::from(n) - 1.0).abs() < 0.025);
    }
}
