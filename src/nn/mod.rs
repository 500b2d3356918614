//! Networks: small perceptrons with hand-written forward and backward passes over parameters that candle owns.
//!
//! candle's autograd is the reference (tests hold the gradients to 1e-5); on networks of this size it costs several
//! times the fused passes. All arithmetic runs on the calling thread in a fixed order: the same bytes every time on
//! one instruction set, which is chosen at run time ([`Level`]): AVX-512, AVX2 with FMA, or portable code.

mod adam;
mod kernel;
mod mlp;
mod params;
mod passes;
mod rows;
mod simd;
mod sliding;
mod vector;

pub use adam::{Adam, AdamConfig, clip_norm};
pub(crate) use kernel::{Finish, Left, Product};
pub use mlp::{Activation, Mlp, Tape};
pub use params::{Params, ParamsRef, from_tensors, to_tensors};
pub(crate) use passes::{Input, Packed, Passes, TILE};
pub use simd::Level;
pub(crate) use simd::{LANES, Operation, Simd};
pub(crate) use sliding::{Lines, SlidingDots, SlidingSums};
pub(crate) use vector::{exp, exp_in_place, ln};

/// What can go wrong with networks and their files.
#[derive(Debug, thiserror::Error)]
pub enum NnError {
    /// candle refused: a shape, a dtype, a file.
    #[error("network: {0}")]
    Candle(#[from] candle_core::Error),
    /// A checkpoint file cannot be read or written.
    #[error("network file: {0}")]
    Safetensors(#[from] safetensors::SafeTensorError),
    /// The parameters do not fit the network.
    #[error("network {name}: expected {expected} parameters, found {found}")]
    Size {
        /// Which network.
        name: String,
        /// Parameters that its shape needs.
        expected: usize,
        /// Parameters found.
        found: usize,
    },
}
