//! Samples from named columns of anybody's table.
//!
//! [`form`] reads a file, whatever its form, whole or in pieces; [`pass`] goes over the pieces once, [`sample`] draws rows; [`names`] says which columns are meant; [`numbers`] makes numbers of them;
//! [`order`] puts rows into episodes.

mod form;
mod lines;
mod names;
mod numbers;
mod order;
mod parquet;
mod pass;
mod sample;
mod text;

use std::path::Path;
use std::sync::Arc;

use polars::prelude::{DataFrame, DataType};

pub use self::form::PieceSize;
use self::form::{TableFile, caught, guarded};
use self::names::expanded;
use self::numbers::{is_numeric, numbers};
use self::order::{Order, episodes, texts};
pub use self::pass::{Passed, Progress, pass, size};
use self::sample::Drawn;
pub use self::sample::Sample;
use super::PairsError;
use crate::io::IoError;
use crate::schema::{Columns, Exchange, NOTE, SampleLabels, Samples};
use crate::storage::{TableForm, table_form};

/// Which columns to read, and what an episode is. `regex:PATTERN` stands for all columns whose name it matches.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
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
    /// Rows to draw, if not all are to be used.
    pub sample: Option<Sample>,
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
    Ok(form == TableForm::Parquet && guarded(path, form, || parquet::is_store(path))?)
}

/// Samples from the named columns. Rows with a missing value are left out and counted in the notes.
///
/// # Errors
/// [`PairsError`] that names column and row.
pub fn table(path: &Path, options: &TableOptions) -> Result<Samples, PairsError> {
    caught(path, |file| {
        let options = expanded(file, path, options)?;
        let (frame, note) = frame(file, path, &options)?;
        let mut set = samples(&frame, path, &options)?;
        set.notes.extend(note);
        Ok(set)
    })
}

/// One set of samples per unordered pair of the columns `options.x`, or of all columns of numbers or words; and what was
/// left out: empty columns, and pairs without a common row. The file is read once; rows with a missing value are left out
/// pair by pair.
///
/// # Errors
/// As [`table()`]; [`PairsError::NoPairs`]; [`PairsError::NoRows`] when no pair is left.
pub fn all_pairs(path: &Path, options: &TableOptions) -> Result<(Vec<Samples>, Vec<String>), PairsError> {
    caught(path, |file| {
        let mut options = expanded(file, path, options)?;
        let chosen = !options.x.is_empty();
        if !chosen {
            options.x = file.names()?;
        }
        let (frame, note) = frame(file, path, &options)?;
        let others: Vec<&String> = options.given.iter().chain(&options.group).chain(&options.time).collect();
        let usable = |name: &&String| {
            let kind = frame.column(name).map(|c| c.dtype().clone());
            let readable = kind.is_ok_and(|kind| is_numeric(&kind) || kind == DataType::String);
            chosen || (readable && !others.contains(name))
        };
        let columns: Vec<String> = options.x.iter().filter(usable).cloned().collect();
        if columns.len() < 2 {
            return Err(PairsError::NoPairs { found: columns.len(), path: path.to_owned() });
        }
        let is_empty = |name: &String| frame.column(name).is_ok_and(|c| c.null_count() == frame.height());
        let (empty, full): (Vec<String>, Vec<String>) = columns.into_iter().partition(is_empty);
        let (mut sets, mut last) = (Vec::new(), None);
        let mut left_out: Vec<String> = empty.iter().map(|name| format!("column {name:?} is empty")).collect();
        for (i, j) in (0..full.len()).flat_map(|i| (i + 1..full.len()).map(move |j| (i, j))) {
            let (x, y) = (vec![full[i].clone()], vec![full[j].clone()]);
            match samples(&frame, path, &TableOptions { x, y, ..options.clone() }) {
                Ok(mut set) => {
                    set.notes.extend(note.clone());
                    sets.push(set);
                }
                Err(error @ PairsError::NoRows { .. }) => {
                    left_out.push(error.to_string());
                    last = Some(error);
                }
                Err(error) => return Err(error),
            }
        }
        if !sets.is_empty() {
            return Ok((sets, left_out));
        }
        let columns = full.into_iter().chain(empty).collect::<Vec<_>>().join(", ");
        Err(last.unwrap_or_else(|| PairsError::NoRows { rows: frame.height(), columns, path: path.to_owned() }))
    })
}

/// The columns that the options name, of all rows or of those that are drawn, and what was not.
fn frame(file: &dyn TableFile, path: &Path, options: &TableOptions) -> Result<(DataFrame, Option<String>), PairsError> {
    let columns = wanted(options);
    let Some(sample) = &options.sample else { return Ok((form::wanted(file, path, &columns)?, None)) };
    let mut drawn = Drawn::new(sample);
    let mut add = |piece: &dyn TableFile| -> Result<(), PairsError> {
        drawn.add(&form::wanted(piece, path, &columns)?).map_err(form::unreadable("table", path))
    };
    match file.pieces(PieceSize::default())? {
        Some(pieces) => pieces.into_iter().try_for_each(|piece| add(&*piece?))?,
        None => add(file)?,
    }
    let (frame, all) = drawn.finish().map_err(form::unreadable("table", path))?;
    let note = sampled_note(frame.height(), all);
    Ok((frame, note))
}

/// What is said of values on a sample.
fn sampled_note(rows: usize, all: u64) -> Option<String> {
    (all > rows as u64).then(|| format!("{NOTE}estimated on {rows} of {all} rows, drawn at random"))
}

/// All columns that the options name.
fn wanted(options: &TableOptions) -> Vec<&str> {
    let keys = options.group.iter().chain(&options.time);
    options.x.iter().chain(&options.y).chain(&options.given).chain(keys).map(String::as_str).collect()
}

fn samples(frame: &DataFrame, path: &Path, options: &TableOptions) -> Result<Samples, PairsError> {
    let [x, y, z] = [&options.x, &options.y, &options.given].map(|names| numbers(frame, names, path));
    let (x, y, z) = (x?, y?, z?);
    let height = frame.height();
    let group = options.group.as_deref().map(|name| texts(frame, name, path)).transpose()?;
    let time = options.time.as_deref().map(|name| Order::of(frame, name, path)).transpose()?;
    let whole = |r: usize| {
        let values = || x.row(r).iter().chain(y.row(r)).chain(z.row(r));
        values().all(|v| !v.is_nan())
            && group.as_ref().is_none_or(|g| g[r].is_some())
            && time.as_ref().is_none_or(|t| t.has(r))
    };
    let mut rows: Vec<usize> = (0..height).filter(|&r| whole(r)).collect();
    let columns = wanted(options).join(", ");
    if rows.is_empty() {
        return Err(PairsError::NoRows { rows: height, columns, path: path.to_owned() });
    }
    if height > u32::MAX as usize {
        return Err(PairsError::TooManyRows);
    }
    let mut notes = Vec::new();
    if rows.len() < height {
        notes.push(format!("{} of {height} rows left out: a missing value in {columns}", height - rows.len()));
    }
    if let Some(time) = &time {
        rows.sort_by(|&a, &b| time.compare(a, b));
    }
    let (starts, label) = episodes(&mut rows, group.as_deref(), options);
    let pick = |columns: &Columns| {
        let data = rows.iter().flat_map(|&r| columns.row(r).iter().copied()).collect();
        Arc::new(Columns { data, names: columns.names.clone(), words: columns.words.clone() })
    };
    Ok(Samples {
        x: pick(&x),
        y: pick(&y),
        z: (!options.given.is_empty()).then(|| pick(&z)),
        starts: starts.into(),
        rows: (0..rows.len() as u32).collect(),
        exchange: if group.is_none() && time.is_some() { Exchange::Shift } else { Exchange::Episodes },
        labels: SampleLabels {
            x: options.x.join(","),
            y: options.y.join(","),
            given: (!options.given.is_empty()).then(|| options.given.join(",")),
            group: label,
            ..SampleLabels::default()
        },
        notes,
    })
}
