//! Several files as one table: their rows one after the other, each column with one type.

use std::path::{Path, PathBuf};

use polars::prelude::{
    BooleanChunked, Column, DataFrame, DataType, IdxCa, NamedFrom as _, NewChunkedArray as _, Series, TimeUnit,
};

use super::form::{TableFile, caught, unreadable};
use super::numbers::{Holds, per_second};
use super::{TableOptions, cells, names, rows};
use crate::pairs::{PairsError, Predicate};
use crate::registry::did_you_mean;
use crate::storage::{TableForm, table_form};

/// The column that says which file a row is of, unless a file has one of this name itself.
pub(super) const FILE: &str = "file";

/// The column that says which rows a condition keeps, from reading until they are left out.
pub(super) const WANTED: &str = "\u{1}where";

/// Rows of one or several files.
pub(super) struct Table {
    pub(super) frame: DataFrame,
    /// Each file, and the row behind its last one.
    files: Vec<(PathBuf, usize)>,
    /// The rows that are left, if some were left out.
    kept: Option<Vec<usize>>,
    /// The rows that are wanted, where the others stay for a lag to count them.
    wanted: Option<Vec<bool>>,
    /// What was left out.
    notes: Vec<String>,
}

impl Table {
    /// Reads the columns that the options name from every file, with patterns replaced by the columns they match.
    pub(super) fn read(paths: &[PathBuf], options: &TableOptions) -> Result<(Self, TableOptions), PairsError> {
        let mut whole: Option<Self> = None;
        let mut expanded = options.clone();
        for (i, path) in paths.iter().enumerate() {
            let frame = caught(path, |file| {
                if i == 0 {
                    expanded = names::expanded(file, path, options)?;
                }
                read(file, path, &expanded)
            })?;
            if let Some(table) = &mut whole {
                table.append(frame, path)?;
            } else {
                let files = vec![(path.clone(), frame.height())];
                whole = Some(Self { frame, files, kept: None, wanted: None, notes: Vec::new() });
            }
        }
        let whole = whole.ok_or_else(|| PairsError::NoFiles("no file was named".to_owned()))?;
        Ok((whole, expanded))
    }

    /// Rows of one file, or of a piece of one.
    pub(super) fn of(frame: DataFrame, path: &Path) -> Self {
        Self { files: vec![(path.to_owned(), frame.height())], frame, kept: None, wanted: None, notes: Vec::new() }
    }

    /// Rows that were drawn from all those of `files`, each with the row behind its last one; `kept` says which.
    pub(super) fn drawn(self, files: Vec<(PathBuf, usize)>, kept: Vec<usize>, notes: Vec<String>) -> Self {
        Self { files, kept: Some(kept), notes, ..self }
    }

    pub(super) fn column(&self, name: &str) -> Result<&Column, PairsError> {
        self.frame.column(name).map_err(unreadable("data", &self.path()))
    }

    /// The column, with nothing in the rows that are not wanted.
    pub(super) fn values(&self, name: &str) -> Result<Column, PairsError> {
        let column = self.column(name)?;
        let Some(wanted) = &self.wanted else { return Ok(column.clone()) };
        let rows: IdxCa = (0..).zip(wanted).map(|(row, &wanted)| wanted.then_some(row)).collect();
        column.take(&rows).map_err(unreadable("table", &self.path()))
    }

    /// Which rows are wanted, where the others are still there.
    pub(super) fn wanted(&self) -> Option<&[bool]> {
        self.wanted.as_deref()
    }

    /// The first file.
    pub(super) fn path(&self) -> PathBuf {
        self.files[0].0.clone()
    }

    /// Where row `at` of the frame came from: its 1-based row of data, and the file.
    pub(super) fn place(&self, at: usize) -> (usize, PathBuf) {
        let at = self.kept.as_ref().map_or(at, |kept| kept[at]);
        let file = self.files.partition_point(|(_, end)| *end <= at).min(self.files.len() - 1);
        let before = if file == 0 { 0 } else { self.files[file - 1].1 };
        (at - before + 1, self.files[file].0.clone())
    }

    /// What a reader of any result must know.
    pub(super) fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Leaves out the rows that are not `wanted`, and notes it.
    pub(super) fn keep(&mut self, wanted: &[bool], note: String) -> Result<(), PairsError> {
        self.notes.push(note);
        let mask = BooleanChunked::from_slice("".into(), wanted);
        self.frame = self.frame.filter(&mask).map_err(unreadable("data", &self.path()))?;
        self.kept = Some((0..wanted.len()).filter(|&at| wanted[at]).collect());
        Ok(())
    }

    /// Notes the rows that are `wanted`, and keeps the others in their places.
    pub(super) fn mark(&mut self, wanted: Vec<bool>, note: String) {
        self.notes.push(note);
        self.wanted = Some(wanted);
    }

    /// Puts the rows of another file behind; a column of both must hold the same in both.
    pub(super) fn append(&mut self, mut frame: DataFrame, path: &Path) -> Result<(), PairsError> {
        let first = self.path();
        let fail = || unreadable("data", path);
        let columns: Vec<String> = self.frame.get_column_names().into_iter().map(ToString::to_string).collect();
        for name in &columns {
            let (mine, other) = (self.column(name)?, frame.column(name).map_err(fail())?);
            if mine.dtype() == other.dtype() {
                continue;
            }
            let common = common(mine, other).ok_or_else(|| PairsError::Types {
                name: name.clone(),
                found: format!("{}, and {} in {}", other.dtype(), mine.dtype(), first.display()),
                path: path.to_owned(),
            })?;
            let (mine, other) = (mine.cast(&common).map_err(fail())?, other.cast(&common).map_err(fail())?);
            self.frame.with_column(mine).map_err(fail())?;
            frame.with_column(other).map_err(fail())?;
        }
        let frame = frame.select(&columns).map_err(fail())?;
        self.frame.vstack_mut(&frame).map_err(fail())?;
        self.files.push((path.to_owned(), self.frame.height()));
        Ok(())
    }
}

/// The type of two columns that hold the same kind of thing, or of which one is empty.
fn common(a: &Column, b: &Column) -> Option<DataType> {
    let empty = |column: &Column| column.null_count() == column.len();
    let of = |column: &Column| Holds::of(column.dtype());
    match (a.dtype(), b.dtype()) {
        (_, kind) if empty(a) => Some(kind.clone()),
        (kind, _) if empty(b) => Some(kind.clone()),
        (DataType::Boolean, _) | (_, DataType::Boolean) => None,
        (DataType::Duration(_), DataType::Duration(_)) => Some(DataType::Duration(TimeUnit::Nanoseconds)),
        (first, second) if of(a) == of(b) => match of(a) {
            Holds::Numbers if first.is_integer() && second.is_integer() && no_u64(first) && no_u64(second) => {
                Some(DataType::Int64)
            }
            Holds::Numbers => Some(DataType::Float64),
            Holds::Dates => {
                let fine = |kind: &DataType| matches!(kind, DataType::Datetime(TimeUnit::Nanoseconds, _));
                let unit = if fine(first) || fine(second) { TimeUnit::Nanoseconds } else { TimeUnit::Microseconds };
                (unit == TimeUnit::Microseconds || (near(a) && near(b))).then_some(DataType::Datetime(unit, None))
            }
            Holds::Words => Some(DataType::String),
            _ => None,
        },
        _ => None,
    }
}

/// Whether all dates of a column are within what nanoseconds reach, 1677 to 2262.
fn near(column: &Column) -> bool {
    let limit = 9.2e9 * per_second(column.dtype());
    let ticks = column.to_physical_repr().cast(&DataType::Float64);
    ticks.is_ok_and(|ticks| ticks.f64().is_ok_and(|ticks| ticks.iter().flatten().all(|tick| tick.abs() < limit)))
}

fn no_u64(kind: &DataType) -> bool {
    kind != &DataType::UInt64
}

fn is_of(predicate: &Predicate, name: &str) -> bool {
    predicate.columns().iter().any(|column| column == name)
}

/// Near names, or all; in quotes where blanks would not be seen.
fn hint(name: &str, known: &[String]) -> String {
    let is_plain = |name: &String| !name.is_empty() && !name.contains(|c: char| c.is_whitespace() || c == ',');
    let plain = known.iter().all(is_plain);
    let shown: Vec<String> = known.iter().map(|name| if plain { name.clone() } else { format!("{name:?}") }).collect();
    did_you_mean(name, shown.iter().map(String::as_str))
}

/// The columns of one file that the options name, typed; and the file's own name, if that is asked for.
pub(super) fn read(file: &dyn TableFile, path: &Path, options: &TableOptions) -> Result<DataFrame, PairsError> {
    let wanted = options.wanted();
    let known = file.names()?;
    let has = |name: &str| known.iter().any(|n| n == name);
    let of_file = wanted.contains(&FILE) && !has(FILE);
    let mut columns: Vec<&str> = wanted.iter().copied().filter(|name| !(of_file && *name == FILE)).collect();
    columns.sort_unstable();
    columns.dedup();
    if let Some(&name) = columns.iter().find(|name| !has(name)) {
        let hint = match known.as_slice() {
            [one] if one.contains([';', '|', '\t']) => {
                format!("its only column is {one:?}: expected commas (tabs in a .tsv) between columns")
            }
            _ => hint(name, &known),
        };
        return Err(PairsError::UnknownColumn { name: name.to_owned(), hint, path: path.to_owned() });
    }
    if let Some(name) = options.words.iter().find(|name| !has(name) && *name != FILE) {
        let hint = hint(name, &known);
        return Err(PairsError::UnknownColumn { name: name.clone(), hint, path: path.to_owned() });
    }
    if let Some((name, kind)) = file.unusable()?.into_iter().find(|(name, _)| columns.contains(&name.as_str())) {
        let hint = "write it as float64, an integer or text".to_owned();
        return Err(PairsError::NotNumeric { name, kind, hint, path: path.to_owned() });
    }
    let fail = || unreadable("data", path);
    // a file's name alone is no column of it: something must say how many rows there are
    let counted = if columns.is_empty() { known.first().map(String::as_str) } else { None };
    columns.extend(counted);
    let mut frame = file.read(&columns)?;
    let text = matches!(table_form(path)?, TableForm::Csv | TableForm::Tsv);
    let only_group = |name: &str| !options.values().contains(&name);
    let is_words = |name: &str| options.words.iter().any(|word| word == name);
    let (cells, mut faults) = (frame.clone(), Vec::new());
    for &name in &columns {
        let column = frame.column(name).map_err(fail())?;
        let column = match text {
            true => match cells::typed(column, is_words(name) || only_group(name), None, path) {
                // a condition may leave out the rows at fault
                Err(error) if options.filter.is_some() => {
                    faults.push((name, error));
                    cells::typed(column, true, None, path)?
                }
                typed => typed?,
            },
            false if is_words(name) => column.cast(&DataType::String).map_err(fail())?,
            false => continue,
        };
        frame.with_column(column).map_err(fail())?;
    }
    if of_file {
        let name = path.display().to_string();
        let names = Series::new(FILE.into(), [name.as_str()]).new_from_index(0, frame.height());
        frame.with_column(names.into()).map_err(fail())?;
    }
    let Some(predicate) = &options.filter else { return Ok(frame) };
    let wanted = match rows::wanted(&Table::of(frame.clone(), path), predicate) {
        // compared as what they mostly are, stray cells stay errors
        Err(PairsError::Where { .. }) if faults.iter().any(|(name, _)| is_of(predicate, name)) => {
            return Err(faults.remove(faults.iter().position(|(name, _)| is_of(predicate, name)).unwrap_or(0)).1);
        }
        wanted => wanted?,
    };
    let is_text = |name: &str| frame.column(name).is_ok_and(|column| column.dtype() == &DataType::String);
    let read: Vec<&str> = columns.iter().copied().filter(|name| options.compared().contains(name)).collect();
    let again = read.into_iter().filter(|name| text && is_text(name) && !is_words(name)).collect::<Vec<_>>();
    for name in again {
        let column = cells::typed(cells.column(name).map_err(fail())?, false, Some(&wanted), path)?;
        frame.with_column(column).map_err(fail())?;
    }
    frame.with_column(Series::new(WANTED.into(), wanted).into()).map_err(fail())?;
    Ok(frame)
}
