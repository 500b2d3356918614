//! Why there are no samples.

use std::path::PathBuf;

use crate::io::IoError;
use crate::storage::StorageError;

/// Why there are no samples. The path comes last.
#[derive(Debug, thiserror::Error)]
pub enum PairsError {
    /// The store.
    #[error(transparent)]
    Storage(#[from] StorageError),
    /// The file.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A store without links.
    #[error(
        "no links: expected two or more communicators that send messages and act, found {found}; record with more --agents"
    )]
    NoLinks {
        /// Communicators in the store.
        found: usize,
    },
    /// A store without steps.
    #[error("no samples: the store holds {episodes} episodes and no step; record with --episodes 1 or more")]
    NoSteps {
        /// Episodes in the store.
        episodes: u64,
    },
    /// A value in a store that no policy can have sent.
    #[error("column {column}, episode {episode}, step {step}: expected a finite number, found {value}")]
    StoreValue {
        /// Column.
        column: String,
        /// Episode.
        episode: u64,
        /// Step.
        step: usize,
        /// What stands there.
        value: f32,
    },
    /// A table without a choice of columns.
    #[error("not a rollout store, and as a table it needs --x and --y: name columns of it: {}", .0.display())]
    NoColumns(PathBuf),
    /// No episode is long enough for a lag.
    #[error(
        "no pair {lag} rows apart: the longest episode has {longest} rows, and none of the {samples} samples has so many after it; {remedy}"
    )]
    NoLag {
        /// Rows between x and y.
        lag: usize,
        /// Rows of the longest episode.
        longest: usize,
        /// Samples without a lag.
        samples: usize,
        /// What to do.
        remedy: &'static str,
    },
    /// No two rows so far apart have all values.
    #[error("no pair {lag} rows apart: all {pairs} have a missing value in {columns}: {}", path.display())]
    NoPairsApart {
        /// Rows between x and y.
        lag: usize,
        /// Pairs of rows.
        pairs: usize,
        /// Columns asked for.
        columns: String,
        /// File.
        path: PathBuf,
    },
    /// A pattern that is none, or that no column matches.
    #[error("{pattern:?}: {message}: {}", path.display())]
    Pattern {
        /// What stands behind `regex:`.
        pattern: String,
        /// What is wrong, and the columns.
        message: String,
        /// File.
        path: PathBuf,
    },
    /// Fewer than two columns to compare.
    #[error("--all-pairs needs two columns of numbers or words, found {found}: {}", path.display())]
    NoPairs {
        /// Columns found.
        found: usize,
        /// File.
        path: PathBuf,
    },
    /// More rows than an estimator can number.
    #[error("more than {} rows: take a part of the data", u32::MAX)]
    TooManyRows,
    /// The table lacks a column.
    #[error("no column {name:?}: {hint}: {}", path.display())]
    UnknownColumn {
        /// What was asked for.
        name: String,
        /// Near names, or all.
        hint: String,
        /// File.
        path: PathBuf,
    },
    /// A column that holds no numbers.
    #[error("column {name:?} holds {kind}, expected numbers, booleans, dates or words; {hint}: {}", path.display())]
    NotNumeric {
        /// Column.
        name: String,
        /// Its type.
        kind: String,
        /// Which columns are numeric.
        hint: String,
        /// File.
        path: PathBuf,
    },
    /// Vectors of different lengths in one column.
    #[error("column {name:?}, row {row}: expected a vector of {expected} numbers, found {found}: {}", path.display())]
    Ragged {
        /// Column.
        name: String,
        /// 1-based row of data.
        row: usize,
        /// Length of the first vector.
        expected: usize,
        /// Length here.
        found: usize,
        /// File.
        path: PathBuf,
    },
    /// A column of a table that is read in pieces.
    #[error(
        "column {name:?} holds both {first} and {second}, seen from row {row} on: a large or sampled table is read in \
         pieces, and a column must hold one of them: clean it, give --words {name} to take all as words, or --memory more: {}",
        path.display()
    )]
    Mixed {
        /// Column.
        name: String,
        /// What it held before.
        first: &'static str,
        /// What it holds in this piece.
        second: &'static str,
        /// 1-based row of data at which the piece begins.
        row: usize,
        /// File.
        path: PathBuf,
    },
    /// More words than any estimator can count.
    #[error(
        "column {name:?} holds more than {most} different words: expected categories; leave it out, or take a part by --where: {}",
        path.display()
    )]
    TooManyWords {
        /// Column.
        name: String,
        /// Most words.
        most: usize,
        /// File.
        path: PathBuf,
    },
    /// A number whose square is infinite.
    #[error(
        "column {name:?}, row {row}: infinite or over 1e150 ({value:e}); leave it out with --where, or rescale the column: {}",
        path.display()
    )]
    Infinite {
        /// Column.
        name: String,
        /// 1-based row of data.
        row: usize,
        /// What stands there.
        value: f64,
        /// File.
        path: PathBuf,
    },
    /// Nothing left to estimate from.
    #[error("no rows: all {rows} rows have a missing value in {columns}: {}", path.display())]
    NoRows {
        /// Rows in the file.
        rows: usize,
        /// Columns asked for.
        columns: String,
        /// File.
        path: PathBuf,
    },
    /// A directory where a table should be.
    #[error(
        "it is a directory, and no table: a store is read without --x and --y; of another directory name the files: {}",
        .0.display()
    )]
    Directory(PathBuf),
    /// A file without a row.
    #[error("the table has no rows: {}", .0.display())]
    EmptyTable(PathBuf),
    /// A condition that is none.
    #[error("--where {text:?}: {message}")]
    Where {
        /// The condition.
        text: String,
        /// What was expected and found.
        message: String,
    },
    /// A condition that is true of no row.
    #[error("no rows: --where {predicate:?} keeps none of the {rows} rows: {}", path.display())]
    NothingKept {
        /// The condition.
        predicate: String,
        /// Rows in the file.
        rows: usize,
        /// File.
        path: PathBuf,
    },
    /// A cell that is not like the others of its column.
    #[error(
        "column {name:?}, row {row}: expected {expected}, found {found:?}; leave the cell empty or write NA where a value is missing, leave rows out with --where, or give --words {name} to take all of them as words: {}",
        path.display()
    )]
    Stray {
        /// Column.
        name: String,
        /// 1-based row of data.
        row: usize,
        /// What stands there.
        found: String,
        /// What most cells are, and how many.
        expected: String,
        /// File.
        path: PathBuf,
    },
    /// Numbers or dates in a form that is not read.
    #[error(
        "column {name:?}, row {row}: {found:?} looks like {looks}; rewrite the column so, or give --words {name} to take it as words: {}",
        path.display()
    )]
    OtherForm {
        /// Column.
        name: String,
        /// 1-based row of data.
        row: usize,
        /// What stands there.
        found: String,
        /// What that may be, and how it is to be written.
        looks: &'static str,
        /// File.
        path: PathBuf,
    },
    /// More pairs than anybody reads.
    #[error("--all-pairs: {columns} columns have {pairs} pairs, more than {most}: name fewer with --x 'regex:…': {}", path.display())]
    TooManyPairs {
        /// Columns.
        columns: usize,
        /// Pairs of them.
        pairs: usize,
        /// Most pairs.
        most: usize,
        /// File.
        path: PathBuf,
    },
    /// A part of a table with a single row.
    #[error("1 row with values in {columns}, an estimate needs more: {}", path.display())]
    OneRow {
        /// Columns asked for.
        columns: String,
        /// File.
        path: PathBuf,
    },
    /// Two columns of one name.
    #[error("the first line names {name:?} more than once: rename one: {}", path.display())]
    Twice {
        /// The name.
        name: String,
        /// File.
        path: PathBuf,
    },
    /// A date beside others that have nanoseconds.
    #[error(
        "column {name:?}, row {row}: a date that nanoseconds do not reach (1677 to 2262), and other rows have such: {}",
        path.display()
    )]
    Far {
        /// Column.
        name: String,
        /// 1-based row of data.
        row: usize,
        /// File.
        path: PathBuf,
    },
    /// A column of words that should order rows.
    #[error("--time {name:?} holds words, expected numbers or dates such as 2024-01-31T12:00:00Z: {}", path.display())]
    NoTime {
        /// Column.
        name: String,
        /// File.
        path: PathBuf,
    },
    /// A column that holds other things in another file.
    #[error(
        "column {name:?} holds {found}: --words {name} takes both as words: {}",
        path.display()
    )]
    Types {
        /// Column.
        name: String,
        /// Its type here, and in the first file.
        found: String,
        /// File.
        path: PathBuf,
    },
    /// Too many sets of samples.
    #[error("--by {by}: more than {most} values: name a column with fewer: {}", path.display())]
    TooManyParts {
        /// Columns.
        by: String,
        /// Most values.
        most: usize,
        /// File.
        path: PathBuf,
    },
    /// A word of `--by` that is none.
    #[error("--by {0:?}: of a store expected sender, receiver, none (all links pooled) or step:N")]
    By(String),
    /// Too many ranges of steps.
    #[error("--by step:{steps}: more than {most} ranges: give more steps each")]
    TooManySteps {
        /// Steps of each.
        steps: usize,
        /// Most ranges.
        most: usize,
    },
    /// A line that no table has.
    #[error("line {line} is longer than {limit} bytes: not a table, or a quotation mark without its pair: {}", path.display())]
    LongLine {
        /// 1-based line.
        line: u64,
        /// Longest line, bytes.
        limit: usize,
        /// File.
        path: PathBuf,
    },
    /// A pattern of file names that matches none: as a file that is not there.
    #[error("no file matches: {}", .0.display())]
    NoMatch(PathBuf),
    /// No file is meant.
    #[error("{0}")]
    NoFiles(String),
    /// The file is not what its name says.
    #[error("not a readable {form} table: {message}: {}", path.display())]
    Unreadable {
        /// The form's name.
        form: &'static str,
        /// What the reader said.
        message: String,
        /// File.
        path: PathBuf,
    },
}

impl PairsError {
    /// Whether the user's words are at fault, not the data.
    pub fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::UnknownColumn { .. }
                | Self::NotNumeric { .. }
                | Self::NoColumns(_)
                | Self::Pattern { .. }
                | Self::Where { .. }
                | Self::NoFiles(_)
                | Self::NoTime { .. }
                | Self::TooManyPairs { .. }
                | Self::By(_)
        )
    }
}
