//! Reports: run directories in; tables, figures and one self-contained page out.
//!
//! [`collect()`] reads runs and MI files, [`write()`] makes the output directory. Between the two the caller may compute
//! reference returns (random policy, oracle) for [`Collected::tasks`].

mod collect;
mod columns;
mod curves;
mod markdown;
mod mutual;
mod page;
mod published;
mod returns;
mod write;

use std::path::PathBuf;

pub use collect::{Collected, Run, Task, collect};
pub use published::{Published, Tables};
pub use returns::{CHANNELS, Cell, Reference, Returns, Row, Tidy};
pub use write::{Request, Summary, write};

use crate::figure::FigureError;
use crate::io::IoError;

/// What can go wrong with a report. The path comes last.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// Files and directories.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A figure.
    #[error(transparent)]
    Figure(#[from] FigureError),
    /// The caller wanted no more of it.
    #[error("interrupted: nothing was written")]
    Stopped,
    /// A path that holds no run.
    #[error(
        "expected a run directory (with config.toml) or a directory of runs, found none: run `ccmarl train` first: {}",
        .0.display()
    )]
    NoRuns(PathBuf),
    /// A run without anything to show.
    #[error(
        "expected evaluation.parquet or metrics.parquet in the run, found neither: run `ccmarl evaluate` on it: {}",
        .0.display()
    )]
    EmptyRun(PathBuf),
    /// No input at all.
    #[error("nothing to report: give run directories, or --mi FILE")]
    NoInput,
    /// A config.toml that is not a run's.
    #[error("expected a run's config.toml, found one that cannot be read ({message}): {}", path.display())]
    Config {
        /// What is wrong, and where.
        message: String,
        /// The file.
        path: PathBuf,
    },
    /// Not a Parquet file.
    #[error("expected a Parquet file, found one that cannot be read ({message}): {}", path.display())]
    Parquet {
        /// The reader's words.
        message: String,
        /// The file.
        path: PathBuf,
    },
    /// A column is missing.
    #[error("expected a column {column:?} ({kind}), found only {found}: {}", path.display())]
    MissingColumn {
        /// The column.
        column: &'static str,
        /// Its type.
        kind: &'static str,
        /// The columns that are there.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// A column of another type.
    #[error("column {column:?}: expected {kind}, found {found}: {}", path.display())]
    ColumnType {
        /// The column.
        column: &'static str,
        /// Type needed.
        kind: &'static str,
        /// Type found.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// A null or a value that is not finite where a number is needed.
    #[error("column {column:?}, row {row}: expected {kind}, found {found}: {}", path.display())]
    Value {
        /// The column.
        column: &'static str,
        /// 0-based row.
        row: usize,
        /// What is needed.
        kind: &'static str,
        /// What is there.
        found: String,
        /// The file.
        path: PathBuf,
    },
    /// A table without rows.
    #[error("expected at least one row, found none: {}", .0.display())]
    NoRows(PathBuf),
    /// The files of a run contradict each other.
    #[error("{what}: config.toml says {config}, evaluation.parquet says {evaluation}: evaluate the run again: {}", path.display())]
    Mismatch {
        /// Which field.
        what: &'static str,
        /// In config.toml.
        config: String,
        /// In evaluation.parquet.
        evaluation: String,
        /// The run.
        path: PathBuf,
    },
    /// The same training twice.
    #[error(
        "two runs of {series} with seed {seed} count as one seed: drop one of {} and {}",
        first.display(),
        path.display()
    )]
    Duplicate {
        /// Algorithm.
        series: String,
        /// Their seed.
        seed: u64,
        /// One.
        first: PathBuf,
        /// The other.
        path: PathBuf,
    },
    /// The compiled-in published tables or the page template are broken: a fault of this program.
    #[error("internal: {0}")]
    Internal(String),
}
