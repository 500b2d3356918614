//! Reading one Parquet file: row batches of bounded size, put together to whole episodes.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::array::{
    Array, ArrayRef, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int32Array, Int64Array, RecordBatch,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field, Schema};
use arrow::error::ArrowError;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions};

use super::columns::{batch_rows, schema};
use super::pages::{PageFault, check_pages};
use super::side_by_side::SideBySide;
use crate::io::IoError;
use crate::schema::{Episode, Layout};
use crate::storage::StorageError;

/// Largest page of a store, bytes; ccmarl's own are about a mebibyte, or one row.
const PAGE_LIMIT: u64 = 64 << 20;

/// Reads the episodes of one file in order.
pub(super) struct Decoder {
    path: PathBuf,
    layout: Layout,
    columns: Vec<String>,
    reader: Batches,
    batch: Option<Batch>,
    /// Whether the reader has given up, so that no further batch can come.
    broken: bool,
}

/// Batches of rows from a file or a journal.
type Batches = Box<dyn Iterator<Item = Result<RecordBatch, ArrowError>> + Send>;

impl Decoder {
    /// Opens a file and compares its columns with the layout.
    pub(super) fn open(path: &Path, layout: &Layout) -> Result<Self, StorageError> {
        let file = File::open(path).map_err(IoError::os("open", path))?;
        let metadata = guard(path, || ArrowReaderMetadata::load(&file, ArrowReaderOptions::new()))?;
        check_pages(&file, metadata.metadata(), PAGE_LIMIT).map_err(|fault| match fault {
            PageFault::Unreadable(message) | PageFault::Greedy(message) => damaged(path, message),
        })?;
        let roots = roots(metadata.schema(), layout, path)?;
        let reader = SideBySide::open(path, &metadata, &roots, batch_rows(layout))?;
        Ok(Self::new(path, layout, Box::new(reader)))
    }

    /// Reads the batches of a journal, whose columns are compared with the layout.
    pub(super) fn journal(path: &Path, layout: &Layout, found: &Schema, rows: Batches) -> Result<Self, StorageError> {
        roots(found, layout, path)?;
        Ok(Self::new(path, layout, rows))
    }

    fn new(path: &Path, layout: &Layout, reader: Batches) -> Self {
        let columns = schema(layout).fields().iter().map(|f| f.name().clone()).collect();
        Self { path: path.to_owned(), layout: layout.clone(), columns, reader, batch: None, broken: false }
    }

    /// The next episode, which must have number `index`; `None` at the end of the file.
    pub(super) fn next_episode(&mut self, index: u64) -> Result<Option<Episode>, StorageError> {
        let mut episode = Episode::with_capacity(&self.layout, index, 0);
        let mut rows = 0;
        loop {
            let batch = match &mut self.batch {
                Some(batch) if batch.at < batch.rows => batch,
                slot => {
                    let next = guard(&self.path, || self.reader.next().transpose());
                    self.broken |= next.is_err();
                    let Some(next) = next? else {
                        let cut = format!("episode {index} ends after {rows} rows without is_last");
                        return if rows == 0 { Ok(None) } else { Err(damaged(&self.path, cut)) };
                    };
                    slot.insert(Batch::new(&next, &self.columns).map_err(|m| damaged(&self.path, m))?)
                }
            };
            let last = batch.take(&self.layout, &mut episode, &mut rows).map_err(|m| damaged(&self.path, m))?;
            if last {
                episode.steps = rows - 1;
                return Ok(Some(episode));
            }
        }
    }

    /// After an error: passes over the rest of the bad episode and returns the number of the next; `None` at the end.
    pub(super) fn skip(&mut self) -> Option<u64> {
        loop {
            if let Some(batch) = &mut self.batch {
                let begins = |&r: &usize| batch.first.value(r) && batch.step.value(r) == 0;
                if let Some(row) = (batch.at.max(batch.passed)..batch.rows).find(begins) {
                    (batch.at, batch.passed) = (row, row + 1);
                    return u64::try_from(batch.episode.value(row)).ok();
                }
            }
            if self.broken {
                return None;
            }
            let next = guard(&self.path, || self.reader.next().transpose());
            self.broken |= !matches!(next, Ok(Some(_)));
            self.batch = next.ok().flatten().and_then(|batch| Batch::new(&batch, &self.columns).ok());
        }
    }
}

/// Where the columns of the layout stand among those found, each of the right type.
fn roots(found: &Schema, layout: &Layout, path: &Path) -> Result<Vec<usize>, StorageError> {
    let mut roots = Vec::new();
    for field in schema(layout).fields() {
        let Some(index) = found.fields().iter().position(|f| f.name() == field.name()) else {
            return Err(damaged(path, format!("column {} is missing", field.name())));
        };
        let (kind, wanted) = (found.field(index).data_type(), field.data_type());
        if !same(kind, wanted) {
            let (wanted, kind) = (show(wanted), show(kind));
            return Err(damaged(path, format!("column {}: expected {wanted}, found {kind}", field.name())));
        }
        roots.push(index);
    }
    Ok(roots)
}

/// The columns of a batch, and the row at which the next episode begins.
struct Batch {
    rows: usize,
    at: usize,
    episode: Int64Array,
    step: Int32Array,
    first: BooleanArray,
    last: BooleanArray,
    terminal: BooleanArray,
    /// The other columns, in schema order.
    rest: Vec<ArrayRef>,
    /// Rows before this one were passed over.
    passed: usize,
}

impl Batch {
    fn new(batch: &RecordBatch, columns: &[String]) -> Result<Self, String> {
        fn typed<A: Array + Clone + 'static>(array: &ArrayRef) -> Result<A, String> {
            array.as_any().downcast_ref::<A>().cloned().ok_or_else(|| format!("unexpected type {}", array.data_type()))
        }
        let mut sorted = Vec::with_capacity(columns.len());
        for name in columns {
            let array = batch.column_by_name(name).ok_or_else(|| format!("column {name} is missing"))?;
            let nullable = name.starts_with("action.") || name == "reward" || name.starts_with("reward.");
            if !nullable && array.null_count() > 0 {
                return Err(format!("column {name}: expected no null, found {}", array.null_count()));
            }
            sorted.push(ArrayRef::clone(array));
        }
        let rest = sorted.split_off(5);
        let last: BooleanArray = typed(&sorted[3])?;
        let acted = NullBuffer::new(!last.values());
        for (name, array) in columns[5..].iter().zip(&rest) {
            let nullable = name.starts_with("action.") || name.starts_with("reward");
            if nullable
                && array.nulls() != Some(&acted)
                && let Some(row) = (0..batch.num_rows()).find(|&r| array.is_null(r) != last.value(r))
            {
                let step = typed::<Int32Array>(&sorted[1])?.value(row);
                return Err(format!(
                    "column {name}: step {step}: null is for the last row of an episode, and only there"
                ));
            }
            if let Some(list) = array.as_any().downcast_ref::<FixedSizeListArray>()
                && list.values().null_count() > 0
                && !nullable
            {
                return Err(format!("column {name}: expected no null element, found {}", list.values().null_count()));
            }
        }
        let (episode, step) = (typed(&sorted[0])?, typed(&sorted[1])?);
        let (first, terminal) = (typed(&sorted[2])?, typed(&sorted[4])?);
        Ok(Self { rows: batch.num_rows(), at: 0, episode, step, first, last, terminal, rest, passed: 0 })
    }

    /// Moves the rows of the episode that begins or goes on at `at` over; whether its last row is among them.
    fn take(&mut self, layout: &Layout, e: &mut Episode, rows: &mut usize) -> Result<bool, String> {
        let from = self.at;
        let mut done = false;
        while self.at < self.rows && !done {
            let r = self.at;
            let (number, step) = (self.episode.value(r), self.step.value(r));
            if number != e.index as i64 || i64::from(step) != *rows as i64 {
                let expected = format!("expected episode {} step {rows}", e.index);
                return Err(format!(
                    "{expected}, found episode {number} step {step}: rows are missing, doubled or unsorted"
                ));
            }
            if self.first.value(r) != (step == 0) {
                return Err(format!("column is_first: episode {number} step {step} has {}", self.first.value(r)));
            }
            done = self.last.value(r);
            if self.terminal.value(r) && !done {
                return Err(format!("column is_terminal: episode {number} step {step} is not the last"));
            }
            e.terminal = self.terminal.value(r);
            *rows += 1;
            self.at += 1;
        }
        let (n, acted) = (self.at - from, self.at - from - usize::from(done));
        let mut rest = self.rest.iter();
        let mut next = |width: usize| if width > 0 { rest.next() } else { None };
        if let Some(array) = next(layout.state_fields.len()) {
            let (values, width) = elements::<Float64Array>(array)?;
            let part = values.values().get(from * width..(from + n) * width);
            e.state.extend_from_slice(part.ok_or("a list column is shorter than its rows")?);
        }
        let floats = |array: Option<&ArrayRef>, n: usize, out: &mut Vec<f32>| -> Result<(), String> {
            if let Some(array) = array {
                let (values, width) = elements::<Float32Array>(array)?;
                let part = values.values().get(from * width..(from + n) * width);
                out.extend_from_slice(part.ok_or("a list column is shorter than its rows")?);
            }
            Ok(())
        };
        for (a, m) in layout.agents.iter().zip(&mut e.observations) {
            floats(next(a.observation), n, &mut m.data)?;
        }
        for (a, m) in layout.agents.iter().zip(&mut e.messages) {
            floats(next(a.message), n, &mut m.data)?;
        }
        if let Some(array) = next(layout.communicators().len()) {
            let (values, width) = elements::<BooleanArray>(array)?;
            if values.len() < (from + n) * width {
                return Err("a list column is shorter than its rows".to_owned());
            }
            e.link.extend(values.values().slice(from * width, n * width).iter());
        }
        for (a, m) in layout.agents.iter().zip(&mut e.actions) {
            floats(next(a.action), acted, &mut m.data)?;
        }
        for out in std::iter::once(&mut e.reward).chain(&mut e.rewards) {
            let array = next(1).and_then(|a| a.as_any().downcast_ref::<Float32Array>()).ok_or("no reward column")?;
            out.extend_from_slice(&array.values()[from..from + acted]);
        }
        Ok(done)
    }
}

/// The elements of a list column, and its width.
fn elements<A: Array + 'static>(array: &ArrayRef) -> Result<(&A, usize), String> {
    let list = array.as_any().downcast_ref::<FixedSizeListArray>();
    let values = list.and_then(|l| l.values().as_any().downcast_ref::<A>());
    list.zip(values)
        .map(|(l, v)| (v, l.value_length() as usize))
        .ok_or_else(|| format!("unexpected type {}", array.data_type()))
}

/// Runs a call into the decoder. It reports most faults as errors, but a file made to harm can make it panic; that
/// becomes an error as well.
pub(super) fn guard<T, E: std::fmt::Display>(
    path: &Path,
    call: impl FnOnce() -> Result<T, E>,
) -> Result<T, StorageError> {
    match crate::io::caught(call) {
        Some(Ok(value)) => Ok(value),
        Some(Err(error)) => Err(damaged(path, format!("cannot be decoded: {error}"))),
        None => Err(damaged(path, "the Parquet decoder gave up on it".to_owned())),
    }
}

fn damaged(path: &Path, message: String) -> StorageError {
    StorageError::Damaged { message, path: path.to_owned() }
}

/// Whether two types agree, whatever the elements of lists are called and whether they may be null.
fn same(a: &DataType, b: &DataType) -> bool {
    match (a, b) {
        (DataType::FixedSizeList(x, n), DataType::FixedSizeList(y, m)) => n == m && x.data_type() == y.data_type(),
        _ => a == b,
    }
}

fn show(kind: &DataType) -> String {
    match kind {
        DataType::FixedSizeList(element, n) => format!("a list of {n} {}", Field::data_type(element)),
        other => other.to_string(),
    }
}
