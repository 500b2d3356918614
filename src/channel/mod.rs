//! Channels: what a link does, counted, and which link explains what was recorded.
//!
//! [`Observations`] are link bits by episode and ordered pair, with the pair's relative state where a store has it.
//! [`fit`] fits the families of links to them and compares them on held-out episodes; [`LinkStatistics`] counts loss per
//! step, bursts and loss against distance. Losses are predicted one message ahead: from the losses before and the states.

mod chain;
mod classifier;
mod figures;
mod fitting;
mod observations;
mod score;
mod statistics;
mod threshold;

use std::path::PathBuf;

pub use chain::{MAX_LOSSES, Runs};
pub use fitting::{Compared, Fit, FitOutcome, MODELS, Parameter, fit};
pub use observations::{DataSource, Observations};
pub use score::{Bin, Estimate, Score};
pub use statistics::{BIN_WIDTH, LinkStatistics, Observed};

use crate::io::IoError;
use crate::record::RecordError;
use crate::registry::RegistryError;
use crate::storage::StorageError;

/// Fewest episodes of a fit: models are compared on a part of them.
pub const LEAST_EPISODES: usize = 10;

/// Why there is no fit. The path comes last.
#[derive(Debug, thiserror::Error)]
pub enum ChannelError {
    /// The store.
    #[error(transparent)]
    Storage(#[from] StorageError),
    /// Files.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A trace that cannot be read, or a fitted link that is none.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The scenario behind a store.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A store without links.
    #[error("no links: expected two or more communicators, found {found}; record with more --agents: {}", path.display())]
    NoLinks {
        /// Communicators in the store.
        found: usize,
        /// Where.
        path: PathBuf,
    },
    /// Nothing was lost, or everything.
    #[error(
        "all {messages} messages were {class}: a fit needs delivered and lost ones; record over a link that loses some, or use the link {link} as it is: {}",
        path.display()
    )]
    OneClass {
        /// Messages.
        messages: usize,
        /// `delivered` or `lost`.
        class: &'static str,
        /// The link that does just this.
        link: &'static str,
        /// Where.
        path: PathBuf,
    },
    /// Too little to hold anything out.
    #[error("expected at least {needed} episodes, found {found}: models are compared on episodes held out; record more, or cut a long trace into episodes: {}", path.display())]
    TooFewEpisodes {
        /// Fewest.
        needed: usize,
        /// Found.
        found: usize,
        /// Where.
        path: PathBuf,
    },
    /// Too much to hold.
    #[error("{needed} episodes of one link hold more than {messages} messages: cut them into shorter ones: {}", path.display())]
    TooLong {
        /// Fewest episodes.
        needed: usize,
        /// Most messages.
        messages: usize,
        /// Where.
        path: PathBuf,
    },
    /// Models of the state on data without states.
    #[error("{model} needs the agents' positions, and {reason}: fit dropout or markov, or give a rollout store: {}", path.display())]
    NoPositions {
        /// The model.
        model: &'static str,
        /// Why there are none.
        reason: String,
        /// Where.
        path: PathBuf,
    },
    /// Bursts that are none.
    #[error(
        "no burst chain is earned: on held-out episodes it predicts {gain:+.5} ± {error:.5} nats per message more than independent losses, fewer than {margin} standard errors; fit dropout instead: {}",
        path.display()
    )]
    NoChain {
        /// Gain over dropout, nats per message.
        gain: f64,
        /// Its standard error.
        error: f64,
        /// Standard errors asked for.
        margin: f64,
        /// Where.
        path: PathBuf,
    },
    /// A state that no world can have.
    #[error("{field}, episode {episode}, step {step}: expected a finite number within ±1e9, found {value}: {}", path.display())]
    Value {
        /// State field.
        field: String,
        /// Episode.
        episode: u64,
        /// Step.
        step: usize,
        /// What stands there.
        value: f64,
        /// Where.
        path: PathBuf,
    },
}
