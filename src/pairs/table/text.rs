//! CSV and TSV.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use polars::io::mmap::MmapBytesReader;
use polars::prelude::{CsvReadOptions, DataFrame, SerReader as _};

use super::form::{PieceSize, Pieces, TableFile, open, unreadable};
use super::lines::Lines;
use crate::io::IoError;
use crate::pairs::PairsError;
use crate::storage::TableForm;

/// Lines of text, the first of which names the columns.
pub(super) struct Text {
    path: PathBuf,
    form: TableForm,
    separator: u8,
}

impl Text {
    pub(super) fn new(path: &Path, form: TableForm, separator: u8) -> Self {
        Self { path: path.to_owned(), form, separator }
    }

    fn finish(&self, options: CsvReadOptions) -> Result<DataFrame, PairsError> {
        self.parsed(open(&self.path)?, options)
    }

    fn parsed(&self, text: impl MmapBytesReader, options: CsvReadOptions) -> Result<DataFrame, PairsError> {
        let options = options.map_parse_options(|options| options.with_separator(self.separator));
        let frame = options.into_reader_with_file_handle(text).finish();
        frame.map_err(unreadable(self.form.name(), &self.path))
    }
}

impl TableFile for Text {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let frame = self.finish(CsvReadOptions::default().with_n_rows(Some(0)).with_infer_schema_length(Some(0)))?;
        Ok(frame.get_column_names().into_iter().map(ToString::to_string).collect())
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        self.finish(of_columns(columns))
    }

    fn size(&self, _columns: &[&str]) -> Result<Option<u64>, PairsError> {
        Ok(Some(self.path.metadata().map_err(IoError::os("open", &self.path))?.len()))
    }

    fn pieces(&self, size: PieceSize) -> Result<Option<Pieces<'_>>, PairsError> {
        let lines = Lines::open(&self.path, size.bytes)?;
        let piece =
            |text: Result<Vec<u8>, PairsError>| Ok(Box::new(Piece { of: self, text: text? }) as Box<dyn TableFile>);
        Ok(Some(Box::new(lines.map(piece))))
    }
}

/// The whole text decides a column's type: a float in the last row must not be an error.
fn of_columns(columns: &[&str]) -> CsvReadOptions {
    let columns = columns.iter().map(|&c| c.into()).collect();
    CsvReadOptions::default().with_infer_schema_length(None).with_columns(Some(columns))
}

/// Some lines of such a file, under its first line.
struct Piece<'a> {
    of: &'a Text,
    text: Vec<u8>,
}

impl TableFile for Piece<'_> {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let options = CsvReadOptions::default().with_n_rows(Some(0)).with_infer_schema_length(Some(0));
        let frame = self.of.parsed(Cursor::new(&self.text), options)?;
        Ok(frame.get_column_names().into_iter().map(ToString::to_string).collect())
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        self.of.parsed(Cursor::new(&self.text), of_columns(columns))
    }
}
