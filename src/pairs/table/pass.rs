//! One pass over a table that memory does not hold: pieces of samples one after the other, and a random sample beside.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use polars::prelude::{Column, DataType, NamedFrom as _, Series};

use super::chosen::Chosen;
use super::form::{PieceSize, TableFile, caught, unreadable};
use super::names::expanded;
use super::numbers::{Holds, per_second};
use super::rows::{self, parts};
use super::sample::{Drawn, Sample};
use super::several::{self, Table};
use super::{TableOptions, whole};
use crate::pairs::PairsError;
use crate::schema::{NOTE, Samples};

/// What a pass has seen.
#[derive(Clone, Debug, PartialEq)]
pub struct Passed {
    /// Rows of the table.
    pub rows: u64,
    /// Those without a missing value, of the ones that the filter keeps.
    pub used: u64,
    /// The sample, if one was asked for; else no rows, with labels and notes.
    pub sample: Samples,
    /// What was left out of the pass.
    pub notes: Vec<String>,
}

/// Where a pass stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Rows read.
    pub rows: u64,
    /// All, where the files say it.
    pub of: Option<u64>,
}

/// Bytes that the columns of a table take in memory, about, as far as that is known before they are read.
///
/// # Errors
/// As [`super::tables()`].
pub fn size(paths: &[PathBuf], options: &TableOptions) -> Result<u64, PairsError> {
    let mut sum = 0;
    for path in paths {
        sum += caught(path, |file| {
            let options = expanded(file, path, options)?;
            let names = if options.x.is_empty() { file.names()? } else { Vec::new() };
            let wanted = options.wanted();
            file.size(&wanted.into_iter().chain(names.iter().map(String::as_str)).collect::<Vec<_>>())
        })?
        .unwrap_or(0);
    }
    Ok(sum)
}

/// Reads a table once: `each` gets the samples of every piece, in which words are numbered alike, and where the pass
/// stands; `options.sample` rows are drawn beside. Every row stands for itself: no group, no order, no parts. Dates are
/// seconds since 1970.
///
/// # Errors
/// As [`super::tables()`]; [`PairsError::Mixed`] for a column that holds numbers in one piece and words in another.
pub fn pass(
    paths: &[PathBuf],
    options: &TableOptions,
    size: PieceSize,
    each: &mut dyn FnMut(&Samples, Progress),
) -> Result<Passed, PairsError> {
    whole(paths, || {
        let of = rows_of(paths)?;
        let mut words = Words::default();
        let (mut used, mut last) = (0_u64, None);
        let mut drawn = options.sample.as_ref().map(Drawn::new);
        let read = over(paths, options, size, &mut |table, places, read, path, options| {
            if let Some(drawn) = &mut drawn {
                drawn.add(&table.frame, places, path)?;
            }
            words.number(table, options, read.before, path)?;
            let all = parts(table, &[])?;
            let found = all.iter().map(|part| Chosen::of(table, options)?.samples(part)).next();
            match found {
                Some(Ok(mut set)) => {
                    words.mark(&mut set);
                    used += set.len() as u64;
                    each(&set, Progress { rows: read.rows, of });
                    last = Some(set);
                    Ok(())
                }
                Some(Err(PairsError::NoRows { .. })) | None => Ok(()),
                Some(Err(error)) => Err(moved(error, read.before)),
            }
        })?;
        let columns = [&read.options.x, &read.options.y, &read.options.given].map(Vec::as_slice).concat();
        let columns = columns.join(", ");
        let path = paths[0].clone();
        let Some(mut sample) = last else {
            return Err(match &options.filter {
                Some(predicate) if read.kept == 0 && read.rows > 0 => {
                    PairsError::NothingKept { predicate: predicate.text().to_owned(), rows: read.rows as usize, path }
                }
                _ if read.rows == 0 => PairsError::EmptyTable(path),
                _ => PairsError::NoRows { rows: read.kept as usize, columns, path },
            });
        };
        let mut notes = Vec::new();
        if used < read.kept {
            notes.push(format!("{} of {} rows left out: a missing value in {columns}", read.kept - used, read.kept));
        }
        notes.extend(read.filtered_note().map(|note| format!("{NOTE}{note}")));
        notes.extend(words.dates.iter().map(|name| format!("{NOTE}dates of {name} are seconds since 1970")));
        let rows = read.rows;
        if let Some(drawn) = drawn {
            let (table, options) = read.drawn(drawn)?;
            let all = parts(&table, &[])?;
            sample = Chosen::of(&table, &options)?.samples(&all[0])?;
        } else {
            (sample.rows, sample.notes) = (Vec::new(), notes.clone());
        }
        Ok(Passed { rows, used, sample, notes })
    })
}

/// Random rows of a table, drawn while it is read piece by piece, and the options with their patterns replaced.
pub(super) fn drawn(
    paths: &[PathBuf],
    options: &TableOptions,
    sample: &Sample,
) -> Result<(Table, TableOptions), PairsError> {
    let mut drawn = Drawn::new(sample);
    let read = over(paths, options, PieceSize::default(), &mut |table, places, _, path, _| {
        drawn.add(&table.frame, places, path)
    })?;
    read.drawn(drawn)
}

/// What was read so far.
#[derive(Clone, Debug, Default)]
struct Read {
    options: TableOptions,
    files: Vec<(PathBuf, usize)>,
    /// Rows read before this piece, and with it.
    before: u64,
    rows: u64,
    /// Rows that the filter keeps.
    kept: u64,
}

impl Read {
    fn filtered_note(&self) -> Option<String> {
        let predicate = self.options.filter.as_ref()?;
        Some(format!("{} of {} rows kept by --where {}", self.kept, self.rows, predicate.text()))
    }

    fn drawn(self, drawn: Drawn) -> Result<(Table, TableOptions), PairsError> {
        let mut notes: Vec<String> = self.filtered_note().into_iter().collect();
        let wanted = self.options.sample.as_ref().map_or(usize::MAX, |sample| sample.rows) as u64;
        if self.kept > wanted {
            notes.push(format!("estimated on {wanted} of {} rows, drawn at random", self.kept));
        }
        let path = self.files.first().map(|file| file.0.clone()).unwrap_or_default();
        if self.rows > 0
            && self.kept == 0
            && let Some(predicate) = &self.options.filter
        {
            let predicate = predicate.text().to_owned();
            return Err(PairsError::NothingKept { predicate, rows: self.rows as usize, path });
        }
        let table = drawn.finish(self.files, notes)?.filter(|table| table.frame.height() > 0);
        Ok((table.ok_or(PairsError::EmptyTable(path))?, self.options))
    }
}

/// What is done with a piece: its rows that the filter keeps, their places among all rows, what was read, the file, and the
/// options.
type Each<'a> = &'a mut dyn FnMut(&mut Table, &[usize], &Read, &Path, &TableOptions) -> Result<(), PairsError>;

/// Reads all files piece by piece.
fn over(paths: &[PathBuf], options: &TableOptions, size: PieceSize, each: Each<'_>) -> Result<Read, PairsError> {
    let mut read = Read::default();
    for (i, path) in paths.iter().enumerate() {
        caught(path, |file| {
            if i == 0 {
                read.options = expanded(file, path, options)?;
            }
            let expanded = read.options.clone();
            let mut add = |piece: &dyn TableFile| -> Result<(), PairsError> {
                let frame = several::read(piece, path, &expanded).map_err(|error| moved(error, read.rows))?;
                (read.before, read.rows) = (read.rows, read.rows + frame.height() as u64);
                if read.rows > u64::from(u32::MAX) {
                    return Err(PairsError::TooManyRows);
                }
                let mut table = Table::of(frame, path);
                if let Some(predicate) = &expanded.filter {
                    match rows::keep(&mut table, predicate) {
                        Err(PairsError::NothingKept { .. }) => return Ok(()),
                        other => other?,
                    }
                }
                let height = table.frame.height();
                read.kept += height as u64;
                let places: Vec<usize> = (0..height).map(|at| read.before as usize + table.place(at).0 - 1).collect();
                let mut table = Table::of(table.frame, path);
                if height == 0 { Ok(()) } else { each(&mut table, &places, &read, path, &expanded) }
            };
            match file.pieces(size)? {
                Some(pieces) => pieces.into_iter().try_for_each(|piece| add(&*piece?))?,
                None => add(file)?,
            }
            Ok(())
        })?;
        read.files.push((path.clone(), read.rows as usize));
    }
    Ok(read)
}

/// Rows of all files, if every one of them says it.
fn rows_of(paths: &[PathBuf]) -> Result<Option<u64>, PairsError> {
    let each = paths.iter().map(|path| caught(path, |file| file.rows()));
    each.collect::<Result<Vec<_>, _>>().map(|all| all.into_iter().sum())
}

/// The error, with its row counted from the start of the table.
fn moved(mut error: PairsError, before: u64) -> PairsError {
    if let PairsError::Infinite { row, .. } | PairsError::Ragged { row, .. } | PairsError::Stray { row, .. } =
        &mut error
    {
        *row += before as usize;
    }
    error
}

/// The numbers of words, the same in all pieces, and which columns hold words or dates.
#[derive(Default)]
struct Words {
    columns: BTreeMap<String, Kind>,
    dates: std::collections::BTreeSet<String>,
}

enum Kind {
    Numbers,
    Words(BTreeMap<String, u32>),
}

impl Words {
    /// Puts numbers in place of words and dates. `before` rows stand before the piece.
    fn number(
        &mut self,
        table: &mut Table,
        options: &TableOptions,
        before: u64,
        path: &Path,
    ) -> Result<(), PairsError> {
        for name in options.x.iter().chain(&options.y).chain(&options.given) {
            let column = table.column(name)?.clone();
            let kind = column.dtype().clone();
            let fail = || unreadable("table", path);
            let numbers = if column.null_count() == column.len() {
                // nothing in it: not even a kind
                Series::full_null(name.as_str().into(), column.len(), &DataType::Float64).into()
            } else if Holds::of(&kind) == Holds::Words {
                let texts = column.cast(&DataType::String).map_err(fail())?;
                self.numbered(name, &texts, before, path)?
            } else {
                if let Kind::Words(_) = self.columns.entry(name.clone()).or_insert(Kind::Numbers) {
                    return Err(PairsError::Mixed { name: name.clone(), row: before + 1, path: path.to_owned() });
                }
                match Holds::of(&kind) {
                    Holds::Dates => {
                        self.dates.insert(name.clone());
                        let ticks = column.to_physical_repr().cast(&DataType::Float64).map_err(fail())?;
                        let ticks = ticks.f64().map_err(fail())?;
                        let each = per_second(&kind);
                        let seconds: Vec<Option<f64>> = ticks.iter().map(|v| v.map(|v| v / each)).collect();
                        Series::new(name.as_str().into(), seconds).into()
                    }
                    Holds::Numbers if kind.is_integer() => column.cast(&DataType::Float64).map_err(fail())?,
                    _ => continue,
                }
            };
            table.frame.with_column(numbers).map_err(fail())?;
        }
        Ok(())
    }

    fn numbered(&mut self, name: &str, texts: &Column, before: u64, path: &Path) -> Result<Column, PairsError> {
        let entry = self.columns.entry(name.to_owned()).or_insert_with(|| Kind::Words(BTreeMap::new()));
        let Kind::Words(known) = entry else {
            return Err(PairsError::Mixed { name: name.to_owned(), row: before + 1, path: path.to_owned() });
        };
        let texts = texts.str().map_err(unreadable("table", path))?;
        let mut number = |text: &str| {
            let next = known.len() as u32;
            known.get(text).copied().unwrap_or_else(|| {
                known.insert(text.to_owned(), next);
                next
            })
        };
        let numbers: Vec<Option<u32>> = texts.iter().map(|text| text.map(&mut number)).collect();
        Ok(Series::new(name.into(), numbers).into())
    }

    /// Says which columns of the samples stand for words.
    fn mark(&self, samples: &mut Samples) {
        for columns in [Some(&mut samples.x), Some(&mut samples.y), samples.z.as_mut()].into_iter().flatten() {
            let columns = Arc::make_mut(columns);
            columns.words =
                columns.names.iter().map(|name| matches!(self.columns.get(name), Some(Kind::Words(_)))).collect();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use polars::prelude::{ParquetWriter, SerReader as _};
    use proptest::prelude::*;

    use super::*;
    use crate::pairs::table;
    use crate::rng::{self, Seeds};

    /// A CSV table with gaps, words (one of them with a line end) and numbers; the same as Parquet in small row groups.
    fn tables(rows: usize, seed: u64) -> (tempfile::TempDir, [PathBuf; 2]) {
        let mut rng = Seeds::new(seed).stream("table");
        let mut text = "a,b,\"w\nord\",c\n".to_owned();
        for row in 0..rows {
            let gap = |of: usize, value: String| if row % of == 3 { String::new() } else { value };
            let word = ["red", "\"gr\n\"\"een\"", "blue"][rng::below(&mut rng, 3)].to_owned();
            let (a, b) = (rng::normal(&mut rng), rng::normal(&mut rng));
            writeln!(text, "{},{},{},{}", gap(11, a.to_string()), gap(17, b.to_string()), gap(13, word), row % 5)
                .unwrap();
        }
        let dir = tempfile::tempdir().unwrap();
        let paths = ["t.csv", "t.parquet"].map(|name| dir.path().join(name));
        crate::io::write_atomic(&paths[0], text.as_bytes()).unwrap();
        let options = polars::prelude::CsvReadOptions::default().with_infer_schema_length(None);
        let reader = options.into_reader_with_file_handle(std::io::Cursor::new(text));
        let mut frame = reader.finish().unwrap();
        let file = std::fs::File::create(&paths[1]).unwrap();
        ParquetWriter::new(file).with_row_group_size(Some(70)).finish(&mut frame).unwrap();
        (dir, paths)
    }

    fn of(x: &str, y: &str, given: &[&str]) -> TableOptions {
        let given = given.iter().map(|&g| g.to_owned()).collect();
        TableOptions { x: vec![x.to_owned()], y: vec![y.to_owned()], given, ..TableOptions::default() }
    }

    /// All samples of a pass, joined; and what it has seen.
    fn joined(path: &Path, options: &TableOptions, size: PieceSize) -> (Vec<[f64; 3]>, Vec<bool>, Passed) {
        let (mut all, mut words) = (Vec::new(), Vec::new());
        let passed = pass(&[path.to_owned()], options, size, &mut |piece, progress| {
            assert!(progress.of.is_none_or(|of| of >= progress.rows));
            words = [piece.x.is_words(0), piece.y.is_words(0)].to_vec();
            all.extend((0..piece.len()).map(|r| {
                let z = piece.z.as_ref().map_or(0.0, |z| z.row(r)[0]);
                [piece.x.row(r)[0], piece.y.row(r)[0], z]
            }));
        });
        (all, words, passed.unwrap())
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 16, ..ProptestConfig::default() })]
        #[test]
        fn pieces_hold_the_rows_that_the_table_holds(seed in 0_u64..100, rows in 1_usize..90, bytes in 1_usize..3000) {
            let (_dir, paths) = tables(200, seed);
            for path in &paths {
                let options = of("a", "b", &["c"]);
                let (all, words, passed) = joined(path, &options, PieceSize { rows, bytes });
                let whole = table(path, &options).unwrap();
                let z = whole.z.as_ref().unwrap();
                let expected: Vec<[f64; 3]> =
                    (0..whole.len()).map(|r| [whole.x.row(r)[0], whole.y.row(r)[0], z.row(r)[0]]).collect();
                prop_assert_eq!(&all, &expected);
                prop_assert_eq!((passed.rows, passed.used, &passed.notes), (200, all.len() as u64, &whole.notes));
                prop_assert_eq!((passed.sample.labels, passed.sample.rows.len()), (whole.labels, 0));
                prop_assert_eq!(words, [false, false]);
                // words: the same ones have the same number, in every piece
                let options = of("w\nord", "a", &[]);
                let (all, words, _) = joined(path, &options, PieceSize { rows, bytes });
                let whole = table(path, &options).unwrap();
                let pairs: std::collections::BTreeSet<(u64, u64)> = all
                    .iter()
                    .zip(0..)
                    .map(|(found, r)| (found[0].to_bits(), whole.x.row(r)[0].to_bits()))
                    .collect();
                prop_assert_eq!((pairs.len(), words), (3, vec![true, false]));
            }
        }
    }

    #[test]
    fn a_sample_is_drawn_beside_the_pass_and_is_the_one_that_the_table_draws_alone() {
        let (_dir, paths) = tables(200, 1);
        let sample = Sample { rows: 60, seeds: Seeds::new(1) };
        for path in &paths {
            let options = TableOptions { sample: Some(sample.clone()), ..of("a", "w\nord", &[]) };
            let (_, _, passed) = joined(path, &options, PieceSize { rows: 7, bytes: 300 });
            let alone = table(path, &options).unwrap();
            assert_eq!(passed.sample, alone);
            assert!(alone.len() <= 60 && alone.len() > 40 && !alone.x.is_words(0) && alone.y.is_words(0));
            assert!(alone.notes.contains(&"note: estimated on 60 of 200 rows, drawn at random".to_owned()));
            let all = TableOptions { sample: Some(Sample { rows: 1000, ..sample.clone() }), ..options };
            let (whole, drawn) = (table(path, &of("a", "w\nord", &[])).unwrap(), table(path, &all).unwrap());
            assert_eq!(whole, drawn);
        }
        assert_eq!(size(&paths[1..], &of("a", "b", &[])).unwrap(), 200 * 2 * 8);
        assert_eq!(size(&paths[..1], &of("a", "b", &[])).unwrap(), paths[0].metadata().unwrap().len());
    }

    #[test]
    fn what_is_wrong_with_a_piece_is_said_with_its_row_in_the_table() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        let fails = |text: &str| {
            crate::io::write_atomic(&path, text.as_bytes()).unwrap();
            let error =
                pass(std::slice::from_ref(&path), &of("a", "b", &[]), PieceSize { rows: 1, bytes: 40 }, &mut |_, _| ())
                    .unwrap_err();
            error.to_string()
        };
        let lines = |n: usize, line: &str| format!("{line}\n").repeat(n);
        let infinite = fails(&format!("a,b\n{}1e200,2\n{}", lines(50, "1,2"), lines(50, "1,2")));
        assert!(infinite.starts_with("column \"a\", row 51: infinite or over 1e150"), "{infinite}");
        let mixed = fails(&format!("a,b\n{}{}", lines(50, "1,2"), lines(50, "x,2")));
        assert!(mixed.starts_with("column \"a\" holds both numbers and words, seen from row "), "{mixed}");
        let mixed = fails(&format!("a,b\n{}{}", lines(49, "x,2"), lines(50, "1,2")));
        assert!(mixed.starts_with("column \"a\" holds both numbers and words, seen from row "), "{mixed}");
        // in the middle of a piece it is a stray cell
        let stray = fails(&format!("a,b\n{}{}", lines(50, "x,2"), lines(50, "1,2")));
        assert!(
            stray.starts_with("column \"a\", row 50: expected a number, as in 9 of 10 rows, found \"x\""),
            "{stray}"
        );
        let empty = fails(&format!("a,b\n{}", lines(50, "1,")));
        assert!(empty.starts_with("no rows: all 50 rows have a missing value in a, b"), "{empty}");
        assert!(fails("a,b\n").starts_with("the table has no rows"), "{}", fails("a,b\n"));
        assert!(fails("a,c\n1,2\n").starts_with("no column \"b\""), "{}", fails("a,c\n1,2\n"));
        // a column without a value in some pieces is neither
        crate::io::write_atomic(
            &path,
            format!("a,b\n{}{}{}", lines(30, ",2"), lines(30, "x,2"), lines(30, ",2")).as_bytes(),
        )
        .unwrap();
        let (all, words, passed) = joined(&path, &of("a", "b", &[]), PieceSize { rows: 1, bytes: 40 });
        assert_eq!((all.len(), words, passed.rows), (30, vec![true, false], 90));
    }
}
