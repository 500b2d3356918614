//! Columns that say the same: an agent that sends its observation has two equal columns, and the second is a third of all
//! encoding. While every block of a row group agrees, it is not encoded: the first one's pages are written again, which
//! gives the same file.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use arrow::array::{Array as _, ArrayRef, FixedSizeListArray, Float32Array};
use arrow::datatypes::Schema;
use bytes::Bytes;
use parquet::arrow::arrow_writer::{InMemoryPageStore, PageKey, PageStore, PageStoreArgs, PageStoreFactory};
use parquet::column::writer::ColumnCloseResult;
use parquet::errors::{ParquetError, Result};
use parquet::file::metadata::ColumnChunkMetaData;
use parquet::schema::types::ColumnDescPtr;

/// For every column, the earlier one that may hold the same: a message's observation.
pub(super) fn candidates(schema: &Schema) -> Vec<Option<usize>> {
    let twin = |name: &str| {
        let observation = format!("observation.{}", name.strip_prefix("message.")?);
        schema.index_of(&observation).ok()
    };
    schema.fields().iter().map(|field| twin(field.name())).collect()
}

/// Whether two list columns of a block hold the same bits.
pub(super) fn equal(a: &ArrayRef, b: &ArrayRef) -> bool {
    fn bits(array: &ArrayRef) -> Option<(i32, &[u8])> {
        let list = array.as_any().downcast_ref::<FixedSizeListArray>()?;
        let values = list.values().as_any().downcast_ref::<Float32Array>()?;
        (list.null_count() == 0).then(|| (list.value_length(), bytemuck::cast_slice(values.values())))
    }
    bits(a).is_some_and(|a| bits(b) == Some(a))
}

/// The pages of a column's chunk, shared with who writes them again.
type Pages = Arc<Mutex<Vec<Bytes>>>;

/// Keeps the pages of the columns that may have a twin; the others are let go as they are written.
#[derive(Debug)]
pub(super) struct Keeper {
    /// Per column that is kept, the pages of the group at hand; earlier groups may still be on their way to the file.
    kept: Vec<Option<Mutex<Pages>>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Keeper {
    /// A keeper for columns of these twins.
    pub(super) fn new(twins: &[Option<usize>]) -> Self {
        let keeps = |column| twins.contains(&Some(column)).then(Mutex::default);
        Self { kept: (0..twins.len()).map(keeps).collect() }
    }

    /// The pages of the chunk that `column` has just ended, one after the other.
    pub(super) fn chunk(&self, column: usize) -> Bytes {
        let kept = self.kept.get(column).and_then(Option::as_ref);
        Bytes::from(kept.map(|pages| lock(&lock(pages)).concat()).unwrap_or_default())
    }
}

impl PageStoreFactory for Keeper {
    fn create(&self, args: &PageStoreArgs<'_>) -> Result<Box<dyn PageStore>> {
        Ok(match self.kept.get(args.column_index()).and_then(Option::as_ref) {
            Some(pages) => {
                let fresh = Pages::default();
                *lock(pages) = Arc::clone(&fresh);
                Box::new(Kept(fresh))
            }
            None => Box::new(InMemoryPageStore::default()),
        })
    }
}

/// A column's pages, which stay when they are taken.
struct Kept(Pages);

impl PageStore for Kept {
    fn put(&mut self, value: Bytes) -> Result<PageKey> {
        let mut pages = lock(&self.0);
        pages.push(value);
        Ok(PageKey::new(pages.len() as u64 - 1))
    }

    fn take(&mut self, key: PageKey) -> Result<Bytes> {
        let page = lock(&self.0).get(key.get() as usize).cloned();
        page.ok_or_else(|| ParquetError::General(format!("page {} of a column is gone", key.get())))
    }
}

/// What is known of a chunk, for the column `to` that holds the same.
pub(super) fn renamed(close: &ColumnCloseResult, to: ColumnDescPtr) -> Result<ColumnCloseResult> {
    let from = &close.metadata;
    let mut builder = ColumnChunkMetaData::builder(to)
        .set_compression_codec(from.compression_codec())
        .set_encodings_mask(*from.encodings_mask())
        .set_total_compressed_size(from.compressed_size())
        .set_total_uncompressed_size(from.uncompressed_size())
        .set_num_values(from.num_values())
        .set_data_page_offset(from.data_page_offset())
        .set_repetition_level_histogram(from.repetition_level_histogram().cloned())
        .set_definition_level_histogram(from.definition_level_histogram().cloned());
    if let Some(stats) = from.page_encoding_stats() {
        builder = builder.set_page_encoding_stats(stats.clone());
    }
    Ok(ColumnCloseResult { metadata: builder.build()?, ..close.clone() })
}
