//! CSV and TSV.

use std::path::{Path, PathBuf};

use polars::prelude::{CsvReadOptions, DataFrame, SerReader as _};

use super::form::{TableFile, open, unreadable};
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
        let options = options.map_parse_options(|options| options.with_separator(self.separator));
        let frame = options.into_reader_with_file_handle(open(&self.path)?).finish();
        frame.map_err(unreadable(self.form.name(), &self.path))
    }
}

impl TableFile for Text {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let frame = self.finish(CsvReadOptions::default().with_n_rows(Some(0)).with_infer_schema_length(Some(0)))?;
        Ok(frame.get_column_names().into_iter().map(ToString::to_string).collect())
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        // the whole file decides a column's type: a float in the last row must not be an error
        let columns = columns.iter().map(|&c| c.into()).collect();
        self.finish(CsvReadOptions::default().with_infer_schema_length(None).with_columns(Some(columns)))
    }
}
