//! Mutual information: estimators, the protocol that keeps them honest, and the pieces that the trainer shares.
//!
//! Three scales, never mixed. J = E\[−sp(−T)\] − E\[sp(T)\] ∈ \[−2 ln 2, 0\] is what the paper prints; shifted, J + 2 ln 2 =
//! 2·JSD ∈ \[0, 2 ln 2\], has the unit `jsd` here; everything else is in nats.
//!
//! Adding an estimator: write `mi/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below. The
//! rest of the room is protocol: `prepare` (standardised, split by episode), `fit` (training, stopped on validation),
//! `interval` (episodes as blocks), `null` (whole episodes permuted), `part` (parts of the samples by whole episodes),
//! `run` (all jobs in parallel), `form` (rows as files); and what several share: `critic`, `scorer`, `bounds`, `contrast`
//! and `contrast_given` (trained critics), `linear` (covariances), `student` (t copulas), `given` (z), `knn` and
//! `neighbours`, `counts`, `unseen`.

pub(crate) mod all_pairs;
mod auto;
mod bounds;
mod calibrate;
mod checks;
mod club;
mod club_sample;
pub mod conditional;
mod contrast;
mod contrast_given;
mod counts;
pub mod critic;
mod discrete;
mod discrete_pass;
mod estimate;
mod extrapolate;
mod fit;
mod form;
mod gaussian;
mod gaussian_pass;
mod gcmi;
mod given;
mod infonce;
mod interval;
mod jsd;
mod knn;
mod ksg1;
mod ksg2;
mod ksg_mixed;
mod l1out;
mod linear;
pub mod losses;
mod mine;
mod negatives;
mod neighbours;
mod null;
mod nwj;
mod one_pass;
mod part;
mod prepare;
mod run;
mod scorer;
pub(crate) mod shifted;
mod smile;
mod student;
mod t_copula;
mod tasks;
mod unseen;

pub use calibrate::{Calibrated, Drawn, Source, calibrate, calibrated};
pub use checks::{Check, NORMALS, SERIES};
pub use estimate::{Estimate, Kind, Unit, p_text};
pub use extrapolate::{DIVISIONS, Extrapolated, PartValue, extrapolated, part_value};
pub use fit::Training;
pub use form::{Row, holds, to_csv, to_json, to_parquet};
pub use interval::{Interval, block_interval};
pub use jsd::certified;
pub use negatives::{all_others, derangements};
pub use neighbours::ksg1_value;
pub use null::{p_value, permuted_rows};
pub use one_pass::OnePass;
pub use run::{Job, JobResult, Named, Plan, fits, in_order, job_seeds, run, run_each};
pub use tasks::{TASKS, Task};

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

/// All estimators.
pub const ESTIMATORS: &[Entry<Build>] = &[
    auto::ENTRY,
    club::ENTRY,
    club_sample::ENTRY,
    discrete::ENTRY,
    gaussian::ENTRY,
    gcmi::ENTRY,
    infonce::ENTRY,
    jsd::ENTRY,
    ksg1::USUAL,
    ksg1::ENTRY,
    ksg2::ENTRY,
    ksg_mixed::ENTRY,
    l1out::ENTRY,
    mine::ENTRY,
    nwj::ENTRY,
    smile::ENTRY,
    t_copula::ENTRY,
];

/// What an entry of `warnings` begins with that explains and does not warn.
pub const NOTE: &str = crate::schema::NOTE;

/// Makes an estimator from its parameters.
pub type Build = fn(&Spec) -> Result<Box<dyn Estimator>, RegistryError>;

/// Estimates the mutual information of one set of samples.
pub trait Estimator: Send + Sync {
    /// The estimate, and what comes with it, as output rows. All randomness comes from `seeds`.
    ///
    /// # Errors
    /// [`MiError`] when the samples cannot carry the estimate.
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError>;

    /// The training behind [`Self::estimate`] with the same seeds, looked at, where there is one and the samples can
    /// carry it.
    fn training(&self, _samples: &Samples, _seeds: &Seeds) -> Option<Training> {
        None
    }

    /// The same estimate in one pass over samples that stand each for itself, where the estimator can do that.
    fn one_pass(&self) -> Option<Box<dyn OnePass>> {
        None
    }

    /// Whether it knows what to do with columns of words.
    fn takes_words(&self) -> bool {
        false
    }

    /// Whether it estimates the information given z.
    fn takes_given(&self) -> bool {
        false
    }
}

/// Names of the estimators of which `takes` holds: what an error recommends.
fn taking(takes: fn(&dyn Estimator) -> bool) -> String {
    let built = ESTIMATORS.iter().filter_map(|e| Some((e.name, (e.build)(&Spec::new(e.name)).ok()?)));
    built.filter(|(_, e)| takes(&**e)).map(|(name, _)| name).collect::<Vec<_>>().join(", ")
}

/// What all estimators hold to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Protocol {
    /// Permutations behind a p-value; 0: no p-value.
    pub permutations: usize,
}

impl Default for Protocol {
    fn default() -> Self {
        Self { permutations: 199 }
    }
}

/// Why samples cannot carry an estimate.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum MiError {
    /// Training, validation and test need episodes of their own.
    #[error(
        "needs at least {needed} episodes to split by episode into training, validation and test, found {found}: \
         record more, or give --group a column with more values"
    )]
    TooFewEpisodes {
        /// Least number.
        needed: usize,
        /// Number with samples.
        found: usize,
    },
    /// Too few samples for the widths.
    #[error("needs at least {needed} samples for {widths} columns, found {found}: add samples or name fewer columns")]
    TooFewSamples {
        /// Least number.
        needed: usize,
        /// Columns of x and y.
        widths: usize,
        /// Number found.
        found: usize,
    },
    /// All of x, or all of y, is one value.
    #[error("{column} is constant, so it can tell nothing: name another column")]
    Constant {
        /// Which columns.
        column: String,
    },
    /// Words, and an estimator that needs numbers.
    #[error("{columns} holds words, not numbers: name other columns, or take one of {}", taking(|e| e.takes_words()))]
    Words {
        /// Which columns.
        columns: String,
    },
    /// Too many categories to count.
    #[error(
        "more than {limit} different pairs of categories in the first {rows} rows: such columns are not discrete; take \
         gaussian, or give --sample N"
    )]
    TooManyCategories {
        /// Most pairs.
        limit: usize,
        /// Rows looked at.
        rows: usize,
    },
    /// z, and an estimator that has no use for it.
    #[error("it estimates nothing given z: leave out --given, or take one of {}", taking(|e| e.takes_given()))]
    Given,
    /// Training went astray.
    #[error("training did not give a finite value: look for extreme values in {columns}")]
    Diverged {
        /// Which columns.
        columns: String,
    },
}
