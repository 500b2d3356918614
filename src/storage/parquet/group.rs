//! A row group in the making: its columns are encoded side by side, on the threads of the caller's pool.
//!
//! What a column becomes depends on its own values and on where the blocks are cut, never on the threads.

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_writer::{ArrowColumnChunk, ArrowColumnWriter, ArrowRowGroupWriterFactory, compute_leaves};
use parquet::errors::ParquetError;
use rayon::prelude::*;

use super::columns::properties;

/// Encodes blocks of rows into the column chunks of one row group after the other.
pub(super) struct Group {
    schema: SchemaRef,
    factory: ArrowRowGroupWriterFactory,
    /// One per column, in schema order; empty between groups.
    columns: Vec<ArrowColumnWriter>,
}

impl Group {
    /// No group yet.
    pub(super) fn new(schema: SchemaRef) -> Result<Self, ParquetError> {
        let writer = ArrowWriter::try_new(std::io::sink(), SchemaRef::clone(&schema), Some(properties(&schema)))?;
        let (_, factory) = writer.into_serialized_writer()?;
        Ok(Self { schema, factory, columns: Vec::new() })
    }

    /// Adds rows to the group.
    pub(super) fn write(&mut self, batch: &RecordBatch) -> Result<(), ParquetError> {
        if self.columns.is_empty() {
            self.columns = self.factory.create_column_writers(0)?;
        }
        let fields = self.schema.fields();
        self.columns.par_iter_mut().zip(fields.par_iter()).zip(batch.columns()).try_for_each(
            |((writer, field), column)| {
                // a list of plain values, or the values themselves: one leaf
                compute_leaves(field, column)?.iter().try_for_each(|leaf| writer.write(leaf))
            },
        )
    }

    /// Ends the group; `None` when it has no rows.
    pub(super) fn end(&mut self) -> Result<Option<Vec<ArrowColumnChunk>>, ParquetError> {
        if self.columns.is_empty() {
            return Ok(None);
        }
        std::mem::take(&mut self.columns)
            .into_par_iter()
            .map(ArrowColumnWriter::close)
            .collect::<Result<_, _>>()
            .map(Some)
    }
}
