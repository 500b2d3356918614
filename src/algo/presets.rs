//! The rows of the paper's tables as settings of one implementation: a training prior and two shaping weights.

use crate::registry::{Entry, Spec};

/// What distinguishes a row: everything else is the same code (lineage: the rows differ only in prior and shaping).
#[derive(Clone, Debug, PartialEq)]
pub struct Preset {
    /// Link prior during training.
    pub prior: Spec,
    /// Whether the Du-MIE shapes the reward (with the scenario's default α and β, unless set).
    pub shaped: bool,
}

const PAPER: &str = "Yang et al. 2025, arXiv 2512.03528, Table 1";

const fn row(name: &'static str, summary: &'static str, build: fn() -> Preset) -> Entry<fn() -> Preset> {
    Entry { name, summary, reference: PAPER, value: None, build }
}

fn dropout(p: f64, shaped: bool) -> Preset {
    Preset { prior: Spec::new("dropout").with("p", p), shaped }
}

pub(super) const MADDPG: Entry<fn() -> Preset> =
    row("maddpg", "no message arrives in training; message inputs are kept and see zeros", || Preset {
        prior: Spec::new("none"),
        shaped: false,
    });

pub(super) const FC_MADDPG: Entry<fn() -> Preset> =
    row("fc-maddpg", "full communication: every message arrives in training", || Preset {
        prior: Spec::new("perfect"),
        shaped: false,
    });

pub(super) const DROPOUT_MADDPG_02: Entry<fn() -> Preset> =
    row("dropout-maddpg-0.2", "each message is lost with probability 0.2 in training", || dropout(0.2, false));

pub(super) const DROPOUT_MADDPG_05: Entry<fn() -> Preset> =
    row("dropout-maddpg-0.5", "each message is lost with probability 0.5 in training", || dropout(0.5, false));

pub(super) const DROPOUT_MADDPG_08: Entry<fn() -> Preset> =
    row("dropout-maddpg-0.8", "each message is lost with probability 0.8 in training", || dropout(0.8, false));

pub(super) const CC_MADDPG: Entry<fn() -> Preset> = row(
    "cc-maddpg",
    "dropout 0.2 in training, reward shaped by the Du-MIE: +α JSD on delivered, −β CLUB on lost messages",
    || dropout(0.2, true),
);
