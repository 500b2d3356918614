//! A row group in the making: its columns are encoded side by side, on the threads of the caller's pool.
//!
//! What a column becomes depends on its own values and on where the blocks are cut, never on the threads.

use std::sync::Arc;

use arrow::array::{ArrayRef, RecordBatch};
use arrow::datatypes::{Field, SchemaRef};
use bytes::Bytes;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_writer::{
    ArrowColumnChunk, ArrowColumnWriter, ArrowRowGroupWriterFactory, ArrowWriterOptions, compute_leaves,
};
use parquet::column::writer::ColumnCloseResult;
use parquet::errors::ParquetError;
use rayon::prelude::*;

use super::columns::properties;
use super::twins::{Keeper, candidates, equal};

/// An encoded column of a row group.
pub(super) enum Chunk {
    /// As it was encoded.
    Own(Box<ArrowColumnChunk>),
    /// The pages of another column that holds the same, and what is known of them.
    Twin(Bytes, Box<ColumnCloseResult>),
}

/// Encodes blocks of rows into the column chunks of one row group after the other.
pub(super) struct Group {
    schema: SchemaRef,
    factory: ArrowRowGroupWriterFactory,
    keeper: Arc<Keeper>,
    /// For every column, the earlier one that may hold the same.
    twins: Vec<Option<usize>>,
    /// One per column, in schema order; empty between groups.
    columns: Vec<Column>,
}

/// A column of the group.
struct Column {
    writer: ArrowColumnWriter,
    /// While it is the same as another column, nothing is written.
    twin: Option<Twin>,
}

/// The other column, and the blocks so far, should one differ.
struct Twin {
    of: usize,
    held: Vec<ArrayRef>,
}

impl Group {
    /// No group yet.
    pub(super) fn new(schema: SchemaRef) -> Result<Self, ParquetError> {
        let twins = candidates(&schema);
        let keeper = Arc::new(Keeper::new(&twins));
        let factory = Arc::<Keeper>::clone(&keeper);
        let options = ArrowWriterOptions::new().with_properties(properties(&schema)).with_page_store_factory(factory);
        let writer = ArrowWriter::try_new_with_options(std::io::sink(), SchemaRef::clone(&schema), options)?;
        let (_, factory) = writer.into_serialized_writer()?;
        Ok(Self { schema, factory, keeper, twins, columns: Vec::new() })
    }

    /// Adds rows to the group.
    pub(super) fn write(&mut self, batch: &RecordBatch) -> Result<(), ParquetError> {
        if self.columns.is_empty() {
            let writers = self.factory.create_column_writers(0)?.into_iter().zip(&self.twins);
            let column =
                |(writer, of): (_, &Option<usize>)| Column { writer, twin: of.map(|of| Twin { of, held: Vec::new() }) };
            self.columns = writers.map(column).collect();
        }
        let (fields, blocks) = (self.schema.fields(), batch.columns());
        self.columns.par_iter_mut().zip(fields.par_iter()).zip(blocks).try_for_each(|((column, field), block)| {
            if let Some(twin) = &mut column.twin
                && equal(block, &blocks[twin.of])
            {
                twin.held.push(ArrayRef::clone(block));
                return Ok(());
            }
            // a column that has differed once goes on by itself
            let held = column.twin.take().map(|twin| twin.held).unwrap_or_default();
            held.iter().chain([block]).try_for_each(|block| write(&mut column.writer, field, block))
        })
    }

    /// Ends the group; `None` when it has no rows.
    pub(super) fn end(&mut self) -> Result<Option<Vec<Chunk>>, ParquetError> {
        if self.columns.is_empty() {
            return Ok(None);
        }
        let close = |column: Column| match column.twin {
            None => column.writer.close().map(Ok),
            Some(twin) => Ok(Err(twin.of)),
        };
        let closed: Vec<Result<ArrowColumnChunk, usize>> =
            std::mem::take(&mut self.columns).into_par_iter().map(close).collect::<Result<_, ParquetError>>()?;
        let known: Vec<Option<ColumnCloseResult>> =
            closed.iter().map(|chunk| chunk.as_ref().ok().map(|chunk| chunk.close().clone())).collect();
        let chunk = |chunk| match chunk {
            Ok(own) => Ok(Chunk::Own(Box::new(own))),
            Err(of) => {
                let known: &Option<ColumnCloseResult> = &known[of];
                let known = known.clone().ok_or_else(|| ParquetError::General(format!("column {of} has no chunk")))?;
                Ok(Chunk::Twin(self.keeper.chunk(of), Box::new(known)))
            }
        };
        closed.into_iter().map(chunk).collect::<Result<_, ParquetError>>().map(Some)
    }
}

/// Encodes a block of a column: a list of plain values, or the values themselves, so one leaf.
fn write(writer: &mut ArrowColumnWriter, field: &Field, block: &ArrayRef) -> Result<(), ParquetError> {
    compute_leaves(field, block)?.iter().try_for_each(|leaf| writer.write(leaf))
}
