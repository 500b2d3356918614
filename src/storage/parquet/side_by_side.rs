//! Reading the columns of a file side by side, on all threads of the caller's pool.

use std::fs::File;
use std::sync::Arc;

use arrow::array::{ArrayRef, RecordBatch};
use arrow::datatypes::{FieldRef, Schema, SchemaRef};
use arrow::error::ArrowError;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder};
use rayon::prelude::*;

use super::leaf::{Leaf, Plan, Shared};
use super::twins::candidates;
use crate::io::caught;

/// Batches of rows, put together from readers of a column each; no batch has rows of two row groups.
pub(super) struct SideBySide {
    file: Shared,
    metadata: ArrowReaderMetadata,
    schema: SchemaRef,
    columns: Vec<Column>,
    /// Rows of a batch at most.
    rows: usize,
    /// The next row group, and what is left of the one at hand.
    group: usize,
    left: usize,
}

/// A column of the file.
struct Column {
    root: usize,
    field: FieldRef,
    /// How it is read here; the Parquet crate reads it where there is none.
    plan: Option<Plan>,
    /// The earlier column, by position among these, that may hold the same.
    twin: Option<usize>,
    reader: Reader,
}

enum Reader {
    /// Between row groups.
    None,
    Own(Leaf),
    Crate(ParquetRecordBatchReader),
    /// The column `twin` has the same pages in this row group.
    Twin,
}

impl SideBySide {
    /// Reads the columns `roots`, at most `rows` rows at once.
    pub(super) fn open(file: File, metadata: &ArrowReaderMetadata, roots: &[usize], rows: usize) -> Self {
        let fields: Vec<FieldRef> = roots.iter().map(|&root| Arc::clone(&metadata.schema().fields()[root])).collect();
        let schema = Arc::new(Schema::new(fields.clone()));
        let column = |((&root, field), twin): ((&usize, FieldRef), Option<usize>)| {
            let plan = Plan::new(metadata.metadata(), root, &field);
            Column { root, field, plan, twin, reader: Reader::None }
        };
        let columns = roots.iter().zip(fields).zip(candidates(&schema)).map(column).collect();
        Self { file: Shared::new(file), metadata: metadata.clone(), schema, columns, rows, group: 0, left: 0 }
    }

    /// Goes on to the next row group that has rows; false when there is none.
    fn next_group(&mut self) -> Result<bool, ArrowError> {
        while self.left == 0 {
            for column in &mut self.columns {
                column.end()?;
            }
            let groups = self.metadata.metadata().row_groups();
            let Some(group) = groups.get(self.group) else { return Ok(false) };
            self.left = usize::try_from(group.num_rows()).map_err(|_| fault("a row group of less than no rows"))?;
            let plans: Vec<Option<Plan>> = self.columns.iter().map(|column| column.plan).collect();
            let open = |column: &mut Column| {
                let of = column.twin.and_then(|twin| plans[twin]);
                column.open(&self.file, &self.metadata, self.group, of, self.rows.min(self.left))
            };
            self.columns.par_iter_mut().try_for_each(open)?;
            self.group += 1;
        }
        Ok(true)
    }

    fn next_batch(&mut self) -> Result<Option<RecordBatch>, ArrowError> {
        if !self.next_group()? {
            return Ok(None);
        }
        let rows = self.rows.min(self.left);
        self.left -= rows;
        let read: Vec<_> = self.columns.par_iter_mut().map(|column| column.read(rows)).collect();
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(read.len());
        for (array, column) in read.into_iter().zip(&self.columns) {
            let twin = || column.twin.and_then(|twin| arrays.get(twin)).map(Arc::clone);
            arrays.push(array?.or_else(twin).ok_or_else(|| fault("a column without its twin"))?);
        }
        RecordBatch::try_new(Arc::clone(&self.schema), arrays).map(Some)
    }
}

impl Iterator for SideBySide {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.next_batch().transpose()
    }
}

fn fault(message: impl Into<String>) -> ArrowError {
    ArrowError::ParquetError(message.into())
}

impl Column {
    /// A fault of this column; one made to harm can also make the decoder panic.
    fn guard<T>(name: &str, call: impl FnOnce() -> Result<T, String>) -> Result<T, ArrowError> {
        let result = caught(call).unwrap_or_else(|| Err("the decoder gave up on it".to_owned()));
        result.map_err(|message| fault(format!("column {name}: {message}")))
    }

    /// Begins row group `group`; `of` is the plan of the column that may hold the same.
    fn open(
        &mut self,
        file: &Shared,
        metadata: &ArrowReaderMetadata,
        group: usize,
        of: Option<Plan>,
        rows: usize,
    ) -> Result<(), ArrowError> {
        let parquet = metadata.metadata();
        self.reader = Self::guard(self.field.name(), || match (self.plan, of) {
            (Some(plan), Some(of)) if plan.same(&of, file, parquet, group) => Ok(Reader::Twin),
            (Some(plan), _) => Leaf::open(plan, file, parquet, group).map(Reader::Own).map_err(|e| e.to_string()),
            (None, _) => {
                let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file.clone(), metadata.clone());
                let mask = ProjectionMask::roots(builder.parquet_schema(), [self.root]);
                let builder = builder.with_projection(mask).with_row_groups(vec![group]).with_batch_size(rows);
                builder.build().map(Reader::Crate).map_err(|e| e.to_string())
            }
        })?;
        Ok(())
    }

    /// The next `rows` rows; `None` where they are the twin's.
    fn read(&mut self, rows: usize) -> Result<Option<ArrayRef>, ArrowError> {
        let (reader, field) = (&mut self.reader, &self.field);
        Self::guard(field.name(), || match reader {
            Reader::Own(leaf) => leaf.read(field, rows).map(Some),
            Reader::Crate(reader) => {
                let batch = reader.next().transpose().map_err(|e| e.to_string())?;
                let array = batch.map(|batch| Arc::clone(batch.column(0))).filter(|array| array.len() == rows);
                array.map(Some).ok_or_else(|| format!("{rows} rows were expected, fewer are there"))
            }
            Reader::Twin | Reader::None => Ok(None),
        })
    }

    /// Ends the row group; all its rows must have been read.
    fn end(&mut self) -> Result<(), ArrowError> {
        match std::mem::replace(&mut self.reader, Reader::None) {
            Reader::Own(leaf) => Self::guard(self.field.name(), || leaf.end()),
            Reader::Crate(_) | Reader::Twin | Reader::None => Ok(()),
        }
    }
}
