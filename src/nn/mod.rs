//! Networks: small perceptrons with hand-written forward and backward passes over parameters that candle owns.
//!
//! candle's autograd is the reference (tests hold the gradients to 1e-5); on networks of this size it costs several
//! times the fused passes. All arithmetic runs on the calling thread in a fixed order: the same bytes every time.

mod adam;
mod few;
mod mlp;
mod params;
mod product;

pub use adam::{Adam, AdamConfig, clip_norm, soft_update};
pub use few::{FewRows, FewScratch};
pub use mlp::{Activation, Mlp, Tape};
pub use params::{Params, ParamsRef, from_tensors, to_tensors};

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
