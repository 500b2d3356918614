//! Parquet.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use polars::io::parquet::metadata::FileMetadataRef;
use polars::prelude::{DataFrame, ParquetReader, SerReader as _};

use super::form::{PieceSize, Pieces, TableFile, open, unreadable, unusable};
use crate::pairs::PairsError;
use crate::storage::TableForm;

const FORM: &str = "Parquet";

/// A Parquet file whose digest and pages were checked.
pub(super) struct Parquet(PathBuf);

impl Parquet {
    pub(super) fn new(path: &Path) -> Result<Self, PairsError> {
        crate::storage::check_table(path, TableForm::Parquet)?;
        Ok(Self(path.to_owned()))
    }
}

impl TableFile for Parquet {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let schema = ParquetReader::new(open(&self.0)?).schema().map_err(unreadable(FORM, &self.0))?;
        Ok(schema.iter_names().map(ToString::to_string).collect())
    }

    fn unusable(&self) -> Result<Vec<(String, String)>, PairsError> {
        let schema = ParquetReader::new(open(&self.0)?).schema().map_err(unreadable(FORM, &self.0))?;
        Ok(unusable(schema.iter_values()))
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        read(&self.0, columns, None)
    }

    fn size(&self, columns: &[&str]) -> Result<Option<u64>, PairsError> {
        let mut reader = ParquetReader::new(open(&self.0)?);
        let metadata = reader.get_metadata().map_err(unreadable(FORM, &self.0))?;
        let chunks = metadata.row_groups.iter().flat_map(|group| group.parquet_columns().iter());
        let own = chunks.filter(|chunk| {
            let root = chunk.descriptor().path_in_schema.first();
            root.is_some_and(|root| columns.contains(&root.as_str()))
        });
        // whatever their type, estimators see numbers of eight bytes
        Ok(Some(own.map(|chunk| 8 * chunk.num_values().max(0) as u64).sum()))
    }

    fn rows(&self) -> Result<Option<u64>, PairsError> {
        let rows = ParquetReader::new(open(&self.0)?).num_rows().map_err(unreadable(FORM, &self.0))?;
        Ok(Some(rows as u64))
    }

    fn pieces(&self, size: PieceSize) -> Result<Option<Pieces<'_>>, PairsError> {
        let mut reader = ParquetReader::new(open(&self.0)?);
        let metadata = reader.get_metadata().map_err(unreadable(FORM, &self.0))?;
        // never over the edge of a row group: what stands before a piece in its group is decoded again
        let (mut slices, mut start) = (Vec::new(), 0);
        for group in &metadata.row_groups {
            let rows = group.num_rows();
            let step = size.rows.max(1);
            slices.extend((0..rows).step_by(step).map(|at| (start + at, step.min(rows - at))));
            start += rows;
        }
        let (path, metadata) = (&self.0, Arc::clone(metadata));
        Ok(Some(Box::new(slices.into_iter().map(move |span| {
            Ok(Box::new(Slice { path, metadata: Arc::clone(&metadata), span }) as Box<dyn TableFile>)
        }))))
    }
}

/// Some rows of a Parquet file.
struct Slice<'a> {
    path: &'a Path,
    metadata: FileMetadataRef,
    /// First row, and how many.
    span: (usize, usize),
}

impl TableFile for Slice<'_> {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let mut reader = ParquetReader::new(open(self.path)?);
        reader.set_metadata(Arc::clone(&self.metadata));
        let schema = reader.schema().map_err(unreadable(FORM, self.path))?;
        Ok(schema.iter_names().map(ToString::to_string).collect())
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        read(self.path, columns, Some((self.span, &self.metadata)))
    }
}

/// Columns of all rows, or of a slice.
fn read(
    path: &Path,
    columns: &[&str],
    slice: Option<((usize, usize), &FileMetadataRef)>,
) -> Result<DataFrame, PairsError> {
    let columns = columns.iter().map(|c| (*c).to_owned()).collect();
    let mut reader = ParquetReader::new(open(path)?).with_columns(Some(columns));
    if let Some((slice, metadata)) = slice {
        reader.set_metadata(Arc::clone(metadata));
        reader = reader.with_slice(Some(slice));
    }
    reader.finish().map_err(unreadable(FORM, path))
}

/// Whether a Parquet file says that it is a rollout store.
pub(super) fn is_store(path: &Path) -> Result<bool, PairsError> {
    let mut reader = ParquetReader::new(open(path)?);
    let metadata = reader.get_metadata().map_err(unreadable(FORM, path))?;
    Ok(metadata.key_value_metadata().iter().flatten().any(|kv| kv.key == "ccmarl.manifest"))
}
