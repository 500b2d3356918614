//! Reading one Parquet file: row batches of bounded size, put together to whole episodes.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::array::RecordBatch;
use arrow::datatypes::{DataType, Field, Schema};
use arrow::error::ArrowError;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions};

use super::batch::Batch;
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
        Self::open_columns(path, layout, &schema(layout))
    }

    /// Opens these columns of a file, of which there must be those that come first in every schema.
    pub(super) fn open_columns(path: &Path, layout: &Layout, columns: &Schema) -> Result<Self, StorageError> {
        let file = File::open(path).map_err(IoError::os("open", path))?;
        let metadata = guard(path, || ArrowReaderMetadata::load(&file, ArrowReaderOptions::new()))?;
        check_pages(&file, metadata.metadata(), PAGE_LIMIT).map_err(|fault| match fault {
            PageFault::Unreadable(message) | PageFault::Greedy(message) => damaged(path, message),
        })?;
        let roots = roots(metadata.schema(), columns, path)?;
        let reader = SideBySide::open(file, &metadata, &roots, batch_rows(layout));
        Ok(Self::new(path, layout, columns, Box::new(reader)))
    }

    /// Reads the batches of a journal, whose columns are compared with the layout.
    pub(super) fn journal(path: &Path, layout: &Layout, found: &Schema, rows: Batches) -> Result<Self, StorageError> {
        let columns = schema(layout);
        roots(found, &columns, path)?;
        Ok(Self::new(path, layout, &columns, rows))
    }

    fn new(path: &Path, layout: &Layout, columns: &Schema, reader: Batches) -> Self {
        let columns = columns.fields().iter().map(|f| f.name().clone()).collect();
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
                    *slot = None;
                    let Some(next) = self.next_batch()? else {
                        return if rows == 0 { Ok(None) } else { Err(self.cut(index, rows)) };
                    };
                    self.batch.insert(next)
                }
            };
            let last = batch.take(&self.layout, &mut episode, &mut rows).map_err(|m| damaged(&self.path, m))?;
            if last {
                episode.steps = rows - 1;
                return Ok(Some(episode));
            }
        }
    }

    /// The next rows, as they come.
    pub(super) fn next_batch(&mut self) -> Result<Option<Batch>, StorageError> {
        let next = guard(&self.path, || self.reader.next().transpose());
        self.broken |= next.is_err();
        let batch = next?.map(|next| Batch::new(&next, &self.columns)).transpose();
        batch.map_err(|message| damaged(&self.path, message))
    }

    /// The rows end within an episode.
    pub(super) fn cut(&self, episode: u64, rows: usize) -> StorageError {
        damaged(&self.path, format!("episode {episode} ends after {rows} rows without is_last"))
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

/// Where these columns stand among those found, each of the right type.
fn roots(found: &Schema, columns: &Schema, path: &Path) -> Result<Vec<usize>, StorageError> {
    let mut roots = Vec::new();
    for field in columns.fields() {
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

pub(super) fn damaged(path: &Path, message: String) -> StorageError {
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
