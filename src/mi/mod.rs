//! Mutual information.

pub mod conditional;
pub mod critic;
pub mod losses;
mod negatives;

pub use negatives::{all_others, derangements};
