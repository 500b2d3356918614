//! One pass over a table that memory does not hold: pieces of samples one after the other, and a random sample beside.

use std::collections::BTreeMap;
use std::path::Path;

use polars::prelude::{Column, DataFrame, DataType, NamedFrom as _, Series};

use super::form::{self, PieceSize, TableFile, caught};
use super::names::expanded;
use super::sample::Drawn;
use super::{TableOptions, sampled_note, samples, wanted};
use crate::pairs::PairsError;
use crate::schema::Samples;

/// What a pass has seen.
#[derive(Clone, Debug, PartialEq)]
pub struct Passed {
    /// Rows of the table.
    pub rows: u64,
    /// Those without a missing value.
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
    /// All, where the file says it.
    pub of: Option<u64>,
}

/// Bytes that the columns of a table take in memory, about, where that is known before they are read.
///
/// # Errors
/// As [`super::table()`].
pub fn size(path: &Path, options: &TableOptions) -> Result<Option<u64>, PairsError> {
    caught(path, |file| {
        let options = expanded(file, path, options)?;
        let names = if options.x.is_empty() { file.names()? } else { Vec::new() };
        file.size(&wanted(&options).into_iter().chain(names.iter().map(String::as_str)).collect::<Vec<_>>())
    })
}

/// Reads a table once: `each` gets the samples of every piece, in which words are numbered alike, and where the pass
/// stands; `options.sample` rows are drawn beside. Every row stands for itself: no group, no order.
///
/// # Errors
/// As [`super::table()`]; [`PairsError::Mixed`] for a column that holds numbers in one piece and words in another.
pub fn pass(
    path: &Path,
    options: &TableOptions,
    size: PieceSize,
    each: &mut dyn FnMut(&Samples, Progress),
) -> Result<Passed, PairsError> {
    caught(path, |file| {
        let options = expanded(file, path, options)?;
        let of = file.rows()?;
        let mut words = Words::default();
        let mut drawn = options.sample.as_ref().map(Drawn::new);
        let (mut rows, mut used, mut last) = (0_u64, 0_u64, None);
        let mut add = |piece: &dyn TableFile| -> Result<(), PairsError> {
            let frame = form::wanted(piece, path, &wanted(&options))?;
            if let Some(drawn) = &mut drawn {
                drawn.add(&frame).map_err(form::unreadable("table", path))?;
            }
            let height = frame.height() as u64;
            let found = samples(&words.numbered(frame, &options, rows, path)?, path, &options);
            rows += height;
            if rows > u64::from(u32::MAX) {
                return Err(PairsError::TooManyRows);
            }
            match found {
                Ok(mut set) => {
                    words.mark(&mut set);
                    used += set.len() as u64;
                    each(&set, Progress { rows, of });
                    last = Some(set);
                    Ok(())
                }
                Err(PairsError::NoRows { .. }) => Ok(()),
                Err(error) => Err(moved(error, rows - height)),
            }
        };
        match file.pieces(size)? {
            Some(pieces) => pieces.into_iter().try_for_each(|piece| add(&*piece?))?,
            None => add(file)?,
        }
        let columns = wanted(&options).join(", ");
        let Some(mut sample) = last else {
            return Err(PairsError::NoRows { rows: rows as usize, columns, path: path.to_owned() });
        };
        let mut notes = Vec::new();
        if used < rows {
            notes.push(format!("{} of {rows} rows left out: a missing value in {columns}", rows - used));
        }
        if let Some(drawn) = drawn {
            let (frame, all) = drawn.finish().map_err(form::unreadable("table", path))?;
            sample = samples(&frame, path, &options)?;
            sample.notes.extend(sampled_note(frame.height(), all));
        } else {
            (sample.rows, sample.notes) = (Vec::new(), notes.clone());
        }
        Ok(Passed { rows, used, sample, notes })
    })
}

/// The error, with its row counted from the start of the table.
fn moved(mut error: PairsError, before: u64) -> PairsError {
    if let PairsError::Infinite { row, .. } | PairsError::Ragged { row, .. } = &mut error {
        *row += before as usize;
    }
    error
}

/// The numbers of words, the same in all pieces, and which columns hold words.
#[derive(Default)]
struct Words {
    columns: BTreeMap<String, Kind>,
}

enum Kind {
    Numbers,
    Words(BTreeMap<String, u32>),
}

impl Words {
    /// The piece with numbers in place of words. `before` rows stand before it.
    fn numbered(
        &mut self,
        mut frame: DataFrame,
        options: &TableOptions,
        before: u64,
        path: &Path,
    ) -> Result<DataFrame, PairsError> {
        for name in options.x.iter().chain(&options.y).chain(&options.given) {
            let column = frame.column(name).map_err(form::unreadable("table", path))?;
            if column.null_count() == column.len() {
                // nothing in it: not even a kind
                let empty = Series::new_null(name.as_str().into(), column.len());
                let empty = empty.cast(&DataType::Float64).map_err(form::unreadable("table", path))?;
                frame.with_column(Column::from(empty)).map_err(form::unreadable("table", path))?;
                continue;
            }
            let Ok(texts) = column.str() else {
                if let Kind::Words(_) = self.columns.entry(name.clone()).or_insert(Kind::Numbers) {
                    return Err(PairsError::Mixed { name: name.clone(), row: before + 1, path: path.to_owned() });
                }
                continue;
            };
            let Kind::Words(known) = self.columns.entry(name.clone()).or_insert_with(|| Kind::Words(BTreeMap::new()))
            else {
                return Err(PairsError::Mixed { name: name.clone(), row: before + 1, path: path.to_owned() });
            };
            let numbers: Vec<Option<u32>> = texts
                .iter()
                .map(|text| {
                    text.map(|text| match known.get(text) {
                        Some(&number) => number,
                        None => {
                            let next = known.len() as u32;
                            known.insert(text.to_owned(), next);
                            next
                        }
                    })
                })
                .collect();
            let numbers = Column::from(Series::new(name.as_str().into(), numbers));
            frame.with_column(numbers).map_err(form::unreadable("table", path))?;
        }
        Ok(frame)
    }

    /// Says which columns of the samples stand for words.
    fn mark(&self, samples: &mut Samples) {
        for columns in [Some(&mut samples.x), Some(&mut samples.y), samples.z.as_mut()].into_iter().flatten() {
            let columns = std::sync::Arc::make_mut(columns);
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
    fn tables(rows: usize, seed: u64) -> (tempfile::TempDir, [std::path::PathBuf; 2]) {
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
        std::fs::write(&paths[0], &text).unwrap();
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
        let passed = pass(path, options, size, &mut |piece, progress| {
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
        let sample = super::super::Sample { rows: 60, seeds: Seeds::new(1) };
        for path in &paths {
            let options = TableOptions { sample: Some(sample.clone()), ..of("a", "w\nord", &[]) };
            let (_, _, passed) = joined(path, &options, PieceSize { rows: 7, bytes: 300 });
            let alone = table(path, &options).unwrap();
            assert_eq!(passed.sample, alone);
            assert!(alone.len() <= 60 && alone.len() > 40 && alone.x.is_words(0) == false && alone.y.is_words(0));
            assert!(alone.notes.contains(&"note: estimated on 60 of 200 rows, drawn at random".to_owned()));
            let all = TableOptions { sample: Some(super::super::Sample { rows: 1000, ..sample.clone() }), ..options };
            let (whole, drawn) = (table(path, &of("a", "w\nord", &[])).unwrap(), table(path, &all).unwrap());
            assert_eq!(whole, drawn);
        }
        assert_eq!(size(&paths[1], &of("a", "b", &[])).unwrap(), Some(200 * 2 * 8));
        assert_eq!(size(&paths[0], &of("a", "b", &[])).unwrap(), Some(paths[0].metadata().unwrap().len()));
    }

    #[test]
    fn what_is_wrong_with_a_piece_is_said_with_its_row_in_the_table() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        let fails = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let error = pass(&path, &of("a", "b", &[]), PieceSize { rows: 1, bytes: 40 }, &mut |_, _| ()).unwrap_err();
            error.to_string()
        };
        let lines = |n: usize, line: &str| format!("{line}\n").repeat(n);
        let infinite = fails(&format!("a,b\n{}1e200,2\n{}", lines(50, "1,2"), lines(50, "1,2")));
        assert!(infinite.starts_with("column \"a\", row 51: infinite or over 1e150"), "{infinite}");
        let mixed = fails(&format!("a,b\n{}{}", lines(50, "1,2"), lines(50, "x,2")));
        assert!(mixed.starts_with("column \"a\" holds both numbers and words, seen from row "), "{mixed}");
        let mixed = fails(&format!("a,b\n{}{}", lines(50, "x,2"), lines(50, "1,2")));
        assert!(mixed.starts_with("column \"a\" holds both numbers and words, seen from row "), "{mixed}");
        let empty = fails(&format!("a,b\n{}", lines(50, "1,")));
        assert!(empty.starts_with("no rows: all 50 rows have a missing value in a, b"), "{empty}");
        assert!(fails("a,b\n").starts_with("no rows: all 0 rows"), "{}", fails("a,b\n"));
        assert!(fails("a,c\n1,2\n").starts_with("no column \"b\""), "{}", fails("a,c\n1,2\n"));
        // a column without a value in some pieces is neither
        std::fs::write(&path, format!("a,b\n{}{}{}", lines(30, ",2"), lines(30, "x,2"), lines(30, ",2"))).unwrap();
        let (all, words, passed) = joined(&path, &of("a", "b", &[]), PieceSize { rows: 1, bytes: 40 });
        assert_eq!((all.len(), words, passed.rows), (30, vec![true, false], 90));
    }
}
