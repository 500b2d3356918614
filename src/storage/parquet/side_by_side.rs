//! Reading the columns of a file side by side, on all threads of the caller's pool.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::RecordBatch;
use arrow::datatypes::Schema;
use arrow::error::ArrowError;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder};
use rayon::prelude::*;

use super::decoder::guard;
use crate::io::{IoError, caught};
use crate::storage::StorageError;

/// Readers of one file at most; each has a file handle.
const READERS: usize = 32;

/// Batches of rows, put together from readers of some columns each.
pub(super) struct SideBySide {
    readers: Vec<ParquetRecordBatchReader>,
}

impl SideBySide {
    /// Reads the columns `roots`, `rows` at once.
    pub(super) fn open(
        path: &Path,
        metadata: &ArrowReaderMetadata,
        roots: &[usize],
        rows: usize,
    ) -> Result<Self, StorageError> {
        let reader = |roots: &[usize]| {
            // a handle of its own: a reader moves the place in its file
            let file = File::open(path).map_err(IoError::os("open", path))?;
            let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata.clone());
            let mask = ProjectionMask::roots(builder.parquet_schema(), roots.iter().copied());
            guard(path, || builder.with_projection(mask).with_batch_size(rows).build())
        };
        let readers = roots.chunks(roots.len().div_ceil(READERS).max(1)).map(reader);
        Ok(Self { readers: readers.collect::<Result<_, _>>()? })
    }
}

impl Iterator for SideBySide {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let fault = |message: &str| ArrowError::ParquetError(message.to_owned());
        let next = |reader: &mut ParquetRecordBatchReader| {
            caught(|| reader.next()).unwrap_or_else(|| Some(Err(fault("the decoder of a column gave up"))))
        };
        let batches: Vec<Option<Self::Item>> = self.readers.par_iter_mut().map(next).collect();
        if batches.iter().all(Option::is_none) {
            return None;
        }
        let whole = || {
            let (mut fields, mut columns) = (Vec::new(), Vec::new());
            for batch in batches {
                let batch = batch.ok_or_else(|| fault("its columns differ in length"))??;
                fields.extend(batch.schema().fields().iter().map(Arc::clone));
                columns.extend(batch.columns().iter().map(Arc::clone));
            }
            RecordBatch::try_new(Arc::new(Schema::new(fields)), columns)
        };
        Some(whole())
    }
}
