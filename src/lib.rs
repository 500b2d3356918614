//! `ccmarl`: record multi-agent rollouts over unreliable links, estimate what messages tell about actions, train
//! policies that survive lossy links, and report the comparison.
//!
//! The data goes one way: `scenario → record → storage → pairs → mi → report`. A room imports only from floors below
//! its own; ARCHITECTURE.md draws the house and a test holds it.

pub mod algo;
pub mod channel;
pub mod cli;
pub mod error;
pub mod figure;
pub mod io;
pub mod link;
pub mod mi;
pub mod nn;
pub mod pairs;
pub mod record;
pub mod registry;
pub mod report;
pub mod rng;
pub mod scenario;
pub mod schema;
pub mod stats;
pub mod storage;
pub mod train;

pub use error::Error;
