//! CSV and TSV. The first line names the columns.

use std::io::{BufRead as _, BufReader, Cursor, Read as _};
use std::path::{Path, PathBuf};

use polars::io::mmap::MmapBytesReader;
use polars::prelude::{CsvReadOptions, DataFrame, SerReader as _};

use super::form::{PieceSize, Pieces, TableFile, open, unreadable};
use super::lines::{LINE, Lines};
use crate::io::IoError;
use crate::pairs::PairsError;
use crate::storage::TableForm;

/// Lines of text, none of which is absurdly long.
pub(super) struct Text {
    path: PathBuf,
    form: TableForm,
    separator: u8,
}

impl Text {
    pub(super) fn new(path: &Path, form: TableForm, separator: u8) -> Result<Self, PairsError> {
        check_lines(path, form)?;
        Ok(Self { path: path.to_owned(), form, separator })
    }

    fn finish(&self, options: CsvReadOptions) -> Result<DataFrame, PairsError> {
        self.parsed(open(&self.path)?, options)
    }

    fn parsed(&self, text: impl MmapBytesReader, options: CsvReadOptions) -> Result<DataFrame, PairsError> {
        let options = options.with_infer_schema_length(Some(0));
        let options = options.map_parse_options(|options| options.with_separator(self.separator));
        let frame = options.into_reader_with_file_handle(text).finish();
        frame.map_err(|error| match self.uneven() {
            None if error.to_string().to_lowercase().contains("utf-8") || error.to_string().contains("utf8") => {
                let message = "it is not UTF-8 text: convert it first, for example with iconv".to_owned();
                PairsError::Unreadable { form: self.form.name(), message, path: self.path.clone() }
            }
            Some((row, found, expected)) => {
                let remedy = if expected == 1 && self.has_semicolons() {
                    ": its columns stand between semicolons and its numbers have decimal commas; save it with commas \
                     between columns and decimal points"
                } else {
                    ""
                };
                let message = format!("row {row} has {found} fields, expected {expected} as in the first line{remedy}");
                PairsError::Unreadable { form: self.form.name(), message, path: self.path.clone() }
            }
            None => unreadable(self.form.name(), &self.path)(error),
        })
    }

    /// Columns by their names as people write them.
    fn chosen(
        &self,
        columns: &[&str],
        read: impl Fn(CsvReadOptions) -> Result<DataFrame, PairsError>,
    ) -> Result<DataFrame, PairsError> {
        let header = names(&read(CsvReadOptions::default().with_n_rows(Some(0)))?);
        if let Some(name) =
            header.iter().filter_map(|name| repeats(name)).find(|name| columns.contains(&&*unescaped(name)))
        {
            return Err(PairsError::Twice { name: unescaped(name), path: self.path.clone() });
        }
        let own: Vec<&str> =
            header.iter().map(String::as_str).filter(|name| columns.contains(&&*unescaped(name))).collect();
        let mut frame = read(of_columns(&own))?;
        for name in own.into_iter().filter(|name| name.contains("\"\"")) {
            frame.rename(name, unescaped(name).into()).map_err(unreadable(self.form.name(), &self.path))?;
        }
        Ok(frame)
    }

    /// Whether the first line names columns between semicolons.
    fn has_semicolons(&self) -> bool {
        let mut line = Vec::new();
        let read = open(&self.path).map(|file| BufReader::new(file.take(1 << 16)).read_until(b'\n', &mut line));
        read.is_ok_and(|read| read.is_ok()) && line.contains(&b';')
    }

    /// The first row of data with more fields than the first line, how many those are, and how many it may have; asked
    /// only when the reader gave up, since it does not say where.
    fn uneven(&self) -> Option<(usize, usize, usize)> {
        let input = BufReader::with_capacity(1 << 18, open(&self.path).ok()?);
        let (mut row, mut fields, mut expected, mut quoted) = (0, 1, 0, false);
        for byte in input.bytes() {
            match byte.ok()? {
                b'"' => quoted = !quoted,
                b'\n' if !quoted => {
                    if row > 0 && fields > expected {
                        return Some((row, fields, expected));
                    }
                    expected = if row == 0 { fields } else { expected };
                    (row, fields) = (row + 1, 1);
                }
                byte if byte == self.separator && !quoted => fields += 1,
                _ => {}
            }
        }
        (row > 0 && fields > expected).then_some((row, fields, expected))
    }
}

impl TableFile for Text {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        let header = self.finish(CsvReadOptions::default().with_n_rows(Some(0)))?;
        Ok(names(&header).iter().filter(|name| repeats(name).is_none()).map(|name| unescaped(name)).collect())
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        self.chosen(columns, |options| self.finish(options))
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

/// The name that stands twice, of the second of two columns: the reader gives that one this name.
fn repeats(name: &str) -> Option<&str> {
    let (first, number) = name.rsplit_once("_duplicated_")?;
    number.parse::<u32>().is_ok().then_some(first)
}

/// A name without the quotes that stand for one: the reader leaves them.
fn unescaped(name: &str) -> String {
    name.replace("\"\"", "\"")
}

fn of_columns(columns: &[&str]) -> CsvReadOptions {
    CsvReadOptions::default().with_columns(Some(columns.iter().map(|&c| c.into()).collect()))
}

fn names(frame: &DataFrame) -> Vec<String> {
    frame.get_column_names().into_iter().map(ToString::to_string).collect()
}

/// Some lines of such a file, under its first line.
struct Piece<'a> {
    of: &'a Text,
    text: Vec<u8>,
}

impl TableFile for Piece<'_> {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        self.of.names()
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        self.of.chosen(columns, |options| self.of.parsed(Cursor::new(&self.text), options))
    }
}

/// How zip archives (spreadsheets, .npz) and gzip files begin.
const PACKED: [&[u8]; 2] = [b"PK\x03\x04", b"\x1f\x8b"];

/// Refuses what is packed, and a line that is longer than [`LINE`]: no table has one, and the reader would hold it in
/// memory. A line end within quotes ends no line, as for [`Lines`].
fn check_lines(path: &Path, form: TableForm) -> Result<(), PairsError> {
    let (mut file, mut block) = (open(path)?, vec![0; 1 << 18]);
    let (mut line, mut length, mut quoted) = (1_u64, 0, false);
    loop {
        let read = file.read(&mut block).map_err(IoError::os("read", path))?;
        if line == 1 && PACKED.iter().any(|magic| block[..read].starts_with(magic)) {
            let message = "it is packed (zip, gzip, .npz, a spreadsheet): unpack it, or save it as a table".to_owned();
            return Err(PairsError::Unreadable { form: form.name(), message, path: path.to_owned() });
        }
        for &byte in &block[..read] {
            quoted ^= byte == b'"';
            if byte == b'\n' && !quoted {
                (line, length) = (line + 1, 0);
            } else {
                length += 1;
            }
            if length > LINE {
                return Err(PairsError::LongLine { line, limit: LINE, path: path.to_owned() });
            }
        }
        if read == 0 {
            return Ok(());
        }
    }
}
