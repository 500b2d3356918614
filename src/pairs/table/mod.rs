//! Samples from named columns of anybody's tables.
//!
//! [`form`] reads a file, whatever its form; [`cells`] says what its text is; [`names`] which columns are meant;
//! [`several`] makes one table of several files; [`numbers`] makes numbers of columns; [`order`] puts rows into episodes;
//! [`chosen`] makes samples of them. [`pass()`] does all this piece by piece, for which [`alike`] holds what is the same
//! in all of them, and [`sample`] draws rows meanwhile.

mod alike;
mod cells;
mod chosen;
mod form;
mod ipc;
mod lines;
mod names;
mod npy;
mod numbers;
mod order;
mod parquet;
mod pass;
mod rows;
mod sample;
mod several;
mod text;
mod topics;

use std::path::{Path, PathBuf};

use self::chosen::{Chosen, Shared};
pub use self::form::PieceSize;
use self::form::guarded;
use self::numbers::Holds;
use self::parquet::is_store as is_parquet_store;
pub use self::pass::{Passed, Progress, pass, size};
pub use self::sample::Sample;
use self::several::Table;
use super::{PairsError, Predicate};
use crate::io::IoError;
use crate::schema::Samples;
use crate::storage::{TableForm, table_form};

/// Which columns to read, and what an episode is. `regex:PATTERN` stands for all columns whose name it matches; `file` for
/// the name of a row's file, unless a file has a column of this name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TableOptions {
    /// Columns of x; a vector column counts as many as it is long.
    pub x: Vec<String>,
    /// Columns of y.
    pub y: Vec<String>,
    /// Columns of z, given which x and y are compared; none: no condition.
    pub given: Vec<String>,
    /// Rows of equal value are one episode.
    pub group: Option<String>,
    /// Order of the rows within an episode; without `group` all rows are one series.
    pub time: Option<String>,
    /// Columns each of whose values is a word, whatever it looks like.
    pub words: Vec<String>,
    /// Which rows to read; all others are as if they were not there.
    pub filter: Option<Predicate>,
    /// Rows to draw, if not all are to be used.
    pub sample: Option<Sample>,
    /// Columns of whose every value there is a set of samples of its own.
    pub by: Vec<String>,
    /// Rows from x (and z) to y, each a set of samples of its own; none: 0. They count all rows of an episode in its order,
    /// whether those have values and the filter keeps them or not.
    pub lags: Vec<usize>,
}

impl TableOptions {
    fn lags(&self) -> &[usize] {
        if self.lags.is_empty() { &[0] } else { &self.lags }
    }

    /// All columns that are named.
    fn wanted(&self) -> Vec<&str> {
        let keys = self.group.iter().chain(&self.by).map(String::as_str);
        self.values().into_iter().chain(keys).collect()
    }

    /// The columns whose values are compared or order the rows.
    fn compared(&self) -> Vec<&str> {
        let lists = self.x.iter().chain(&self.y).chain(&self.given).chain(&self.time);
        lists.map(String::as_str).collect()
    }

    /// The columns whose values mean something: not only that they are equal.
    fn values(&self) -> Vec<&str> {
        let filter = self.filter.iter().flat_map(Predicate::columns);
        self.compared().into_iter().chain(filter.map(String::as_str)).collect()
    }
}

/// Whether a path is a rollout store: a directory, an `.mcap` file, or Parquet with the key `ccmarl.manifest`.
///
/// # Errors
/// [`IoError::Missing`] when nothing is there; [`PairsError::Unreadable`] for a damaged `.parquet` file.
pub fn is_store(path: &Path) -> Result<bool, PairsError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    if path.is_dir() || path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mcap")) {
        return Ok(true);
    }
    let form = table_form(path)?;
    Ok(form == TableForm::Parquet && guarded(path, form, || is_parquet_store(path))?)
}

/// Samples from the named columns of one file. Rows with a missing value are left out and counted in the notes.
///
/// # Errors
/// [`PairsError`] that names column and row.
pub fn table(path: &Path, options: &TableOptions) -> Result<Samples, PairsError> {
    let mut sets = tables(&[path.to_owned()], &TableOptions { by: Vec::new(), lags: Vec::new(), ..options.clone() })?.0;
    sets.pop().ok_or_else(|| PairsError::NoFiles("no file was named".to_owned()))
}

/// Samples from the named columns of several files, whose rows follow each other: one set, or one per value of the columns
/// `options.by`, in order; and what was left out: values without a common row of x and y.
///
/// # Errors
/// As [`table()`]; [`PairsError::Types`] when two files hold different things in a column; [`PairsError::TooManyParts`].
pub fn tables(paths: &[PathBuf], options: &TableOptions) -> Result<(Vec<Samples>, Vec<String>), PairsError> {
    whole(paths, || {
        let (table, options) = filtered(paths, options)?;
        let chosen = Chosen::of(&table, &options)?;
        let (mut sets, mut left_out) = (Vec::new(), Vec::new());
        let mut last = None;
        for part in rows::parts(&table, &options.by)? {
            for set in chosen.at_lags(&part, &mut Shared::default()) {
                match set {
                    Ok(set) => sets.push(set),
                    Err(error) => {
                        left_out.push(format!("{}: {error}", part.within.as_deref().unwrap_or("all rows")));
                        last = Some(error);
                    }
                }
            }
        }
        match last {
            Some(error) if sets.is_empty() => Err(error),
            _ => Ok((sets, left_out)),
        }
    })
}

/// One set of samples per unordered pair of the columns `options.x`, or of all columns of numbers or words; and what was
/// left out: empty columns, and pairs without a common row. The files are read once; rows with a missing value are left out
/// pair by pair.
///
/// # Errors
/// As [`tables()`]; [`PairsError::NoPairs`]; [`PairsError::NoRows`] when no pair is left.
pub fn all_pairs(paths: &[PathBuf], options: &TableOptions) -> Result<(Vec<Samples>, Vec<String>), PairsError> {
    whole(paths, || {
        let named = !options.x.is_empty();
        let mut options = options.clone();
        let mut left_out = Vec::new();
        if !named {
            (options.x, left_out) = names::of_first(paths)?;
        }
        few_pairs(options.x.len(), &paths[0])?;
        let (table, options) = filtered(paths, &options)?;
        let keys = options.group.iter().chain(&options.by);
        let others: Vec<&String> = options.given.iter().chain(&options.time).chain(keys).collect();
        let usable = |name: &&String| {
            let held = table.frame.column(name).map(|column| Holds::of(column.dtype()));
            named || (held.is_ok_and(|held| held != Holds::Other) && !others.contains(name))
        };
        let columns: Vec<String> = options.x.iter().filter(usable).cloned().collect();
        if columns.len() < 2 {
            return Err(PairsError::NoPairs { found: columns.len(), path: table.path() });
        }
        let parts = rows::parts(&table, &options.by)?;
        let rows = table.frame.height();
        let is_empty = |name: &String| table.values(name).is_ok_and(|c| c.null_count() == rows);
        let (empty, full): (Vec<String>, Vec<String>) = columns.into_iter().partition(is_empty);
        few_pairs(full.len(), &paths[0])?;
        let (mut sets, mut last) = (Vec::new(), None);
        let mut shared: Vec<Shared> = parts.iter().map(|_| Shared::default()).collect();
        left_out.extend(empty.iter().map(|name| format!("column {name:?} is empty")));
        for (i, j) in (0..full.len()).flat_map(|i| (i + 1..full.len()).map(move |j| (i, j))) {
            let (x, y) = (vec![full[i].clone()], vec![full[j].clone()]);
            let options = TableOptions { x, y, ..options.clone() };
            let chosen = Chosen::of(&table, &options)?;
            for (part, shared) in parts.iter().zip(&mut shared) {
                for set in chosen.at_lags(part, shared) {
                    match set {
                        Ok(set) => sets.push(set),
                        Err(error) => {
                            let within = part.within.as_ref().map(|within| format!("{within}: ")).unwrap_or_default();
                            left_out.push(format!("{within}{error}"));
                            last = Some(error);
                        }
                    }
                }
            }
        }
        if !sets.is_empty() {
            return Ok((sets, left_out));
        }
        let columns = full.into_iter().chain(empty).collect::<Vec<_>>().join(", ");
        Err(last.unwrap_or_else(|| PairsError::NoRows { rows, columns, path: table.path() }))
    })
}

/// Most pairs of `--all-pairs`.
const MOST_PAIRS: usize = 100_000;

fn few_pairs(columns: usize, path: &Path) -> Result<(), PairsError> {
    let pairs = columns * columns.saturating_sub(1) / 2;
    if pairs <= MOST_PAIRS {
        return Ok(());
    }
    Err(PairsError::TooManyPairs { columns, pairs, most: MOST_PAIRS, path: path.to_owned() })
}

/// The table without the rows that the filter leaves out; the options with their patterns replaced.
fn filtered(paths: &[PathBuf], options: &TableOptions) -> Result<(Table, TableOptions), PairsError> {
    if let Some(sample) = &options.sample {
        return pass::drawn(paths, options, sample);
    }
    let (mut table, options) = Table::read(paths, options)?;
    if table.frame.height() > u32::MAX as usize {
        return Err(PairsError::TooManyRows);
    }
    if table.frame.height() == 0 {
        return Err(PairsError::EmptyTable(table.path()));
    }
    if let Some(predicate) = &options.filter {
        let leave_out = if options.lags().iter().any(|&lag| lag > 0) { rows::mark } else { rows::keep };
        leave_out(&mut table, predicate)?;
    }
    Ok((table, options))
}

/// Runs what reads whole files; a panic in there becomes an error of ours.
fn whole<T>(paths: &[PathBuf], read: impl FnOnce() -> Result<T, PairsError>) -> Result<T, PairsError> {
    let path = paths.first().ok_or_else(|| PairsError::NoFiles("no file was named".to_owned()))?;
    crate::io::caught(read).unwrap_or_else(|| {
        let message = "its columns cannot be used: the file is damaged".to_owned();
        Err(PairsError::Unreadable { form: "data", message, path: path.clone() })
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn all_pairs_have_every_column_once_where_no_value_is_missing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        crate::io::write_atomic(&path, b"a,b,c,d\n1,2,3,4\n2,3,5,\n4,4,4,8\n").unwrap();
        let (sets, _) = all_pairs(std::slice::from_ref(&path), &TableOptions::default()).unwrap();
        let named = |x: &str, y: &str| sets.iter().find(|s| s.labels.x == x && s.labels.y == y).unwrap();
        assert_eq!(sets.len(), 6);
        assert!(Arc::ptr_eq(&named("a", "b").x, &named("a", "c").x));
        assert!(Arc::ptr_eq(&named("a", "c").y, &named("b", "c").y));
        assert!(Arc::ptr_eq(&named("a", "b").starts, &named("b", "c").starts));
        assert!(Arc::ptr_eq(&named("b", "d").y, &named("c", "d").y));
        for set in &sets {
            let one = TableOptions {
                x: vec![set.labels.x.clone()],
                y: vec![set.labels.y.clone()],
                ..TableOptions::default()
            };
            assert_eq!(*set, table(&path, &one).unwrap());
        }
    }
}
