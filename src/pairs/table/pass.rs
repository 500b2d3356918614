//! One pass over a table that memory does not hold: pieces of samples one after the other, and a random sample beside.

use std::path::{Path, PathBuf};

use super::alike::Alike;
use super::chosen::Chosen;
use super::form::{PieceSize, TableFile, caught};
use super::names::expanded;
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
/// stands, and says whether it wants more; `options.sample` rows are drawn beside, to the end. Every row stands for itself:
/// no group, no order, no parts.
///
/// # Errors
/// As [`super::tables()`]; [`PairsError::Mixed`] for a column that holds numbers in one piece and words in another;
/// [`PairsError::TooManyWords`].
pub fn pass(
    paths: &[PathBuf],
    options: &TableOptions,
    size: PieceSize,
    each: &mut dyn FnMut(&Samples, Progress) -> bool,
) -> Result<Passed, PairsError> {
    whole(paths, || {
        let of = rows_of(paths)?;
        let (mut used, mut last, mut wanted, mut notes) = (0_u64, None, true, Vec::new());
        let mut drawn = options.sample.as_ref().map(Drawn::new);
        let read = over(paths, options, size, &mut |table, places, read, alike| {
            if let Some(drawn) = &mut drawn {
                drawn.add(&table.frame, places, &table.path())?;
            }
            if !wanted {
                return Ok(drawn.is_some());
            }
            alike.number(table, &read.options, &table.path())?;
            notes = alike.notes(&read.options);
            let all = parts(table, &[])?;
            let found = all.iter().map(|part| Chosen::of(table, &read.options)?.samples(part)).next();
            match found {
                Some(Ok(mut set)) => {
                    alike.mark(&mut set);
                    used += set.len() as u64;
                    wanted = each(&set, Progress { rows: read.rows, of });
                    last = Some(set);
                }
                Some(Err(PairsError::NoRows { .. })) | None => {}
                Some(Err(error)) => return Err(error),
            }
            Ok(wanted || drawn.is_some())
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
        let of_columns = std::mem::take(&mut notes);
        if wanted && used < read.kept {
            notes.push(format!("{} of {} rows left out: a missing value in {columns}", read.kept - used, read.kept));
        }
        notes.extend(read.filtered_note().into_iter().chain(of_columns).map(|note| format!("{NOTE}{note}")));
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
    let read = over(paths, options, PieceSize::default(), &mut |table, places, _, _| {
        drawn.add(&table.frame, places, &table.path())?;
        Ok(true)
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

/// What is done with a piece: its rows that the filter keeps, their places among all rows, what was read, and what is known
/// of the columns; whether to go on. Rows in errors are counted from the start of the piece.
type Each<'a> = &'a mut dyn FnMut(&mut Table, &[usize], &Read, &mut Alike) -> Result<bool, PairsError>;

/// Reads all files piece by piece.
fn over(paths: &[PathBuf], options: &TableOptions, size: PieceSize, each: Each<'_>) -> Result<Read, PairsError> {
    let (mut read, mut alike, mut more) = (Read::default(), Alike::default(), true);
    for (i, path) in paths.iter().enumerate() {
        caught(path, |file| {
            if i == 0 {
                read.options = expanded(file, path, options)?;
            }
            let start = read.rows;
            let mut add = |piece: &dyn TableFile| -> Result<bool, PairsError> {
                let before = read.rows - start;
                let more = next(piece, path, &mut read, &mut alike, each);
                more.map_err(|error| moved(error, before))
            };
            let mut any = false;
            for piece in file.pieces(size)?.into_iter().flatten() {
                any = true;
                more = add(&*piece?)?;
                if !more {
                    break;
                }
            }
            // it cannot be cut, or has no row
            if !any {
                more = add(file)?;
            }
            Ok(())
        })?;
        read.files.push((path.clone(), read.rows as usize));
        if !more {
            break;
        }
    }
    Ok(read)
}

/// Reads a piece, and says whether to go on.
fn next(
    piece: &dyn TableFile,
    path: &Path,
    read: &mut Read,
    alike: &mut Alike,
    each: Each<'_>,
) -> Result<bool, PairsError> {
    let frame = several::read(piece, path, &read.options)?;
    (read.before, read.rows) = (read.rows, read.rows + frame.height() as u64);
    if read.rows > u64::from(u32::MAX) {
        return Err(PairsError::TooManyRows);
    }
    if frame.height() == 0 {
        return Ok(true);
    }
    alike.check(&frame, &read.options, path)?;
    let mut table = Table::of(frame, path);
    if let Some(predicate) = &read.options.filter {
        match rows::keep(&mut table, predicate) {
            Err(PairsError::NothingKept { .. }) => return Ok(true),
            other => other?,
        }
    }
    let height = table.frame.height();
    read.kept += height as u64;
    let places: Vec<usize> = (0..height).map(|at| read.before as usize + table.place(at).0 - 1).collect();
    each(&mut table, &places, read, alike)
}

/// Rows of all files, if every one of them says it.
fn rows_of(paths: &[PathBuf]) -> Result<Option<u64>, PairsError> {
    let each = paths.iter().map(|path| caught(path, |file| file.rows()));
    each.collect::<Result<Vec<_>, _>>().map(|all| all.into_iter().sum())
}

/// The error, with its row counted from the start of the file.
fn moved(mut error: PairsError, before: u64) -> PairsError {
    if let PairsError::Infinite { row, .. }
    | PairsError::Ragged { row, .. }
    | PairsError::Stray { row, .. }
    | PairsError::Far { row, .. }
    | PairsError::Mixed { row, .. } = &mut error
    {
        *row += before as usize;
    }
    error
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use polars::prelude::{NamedFrom as _, ParquetWriter, SerReader as _, Series};
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
            true
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

    /// Two files with dates, integers beyond what a float holds, words, and columns that have no value at first.
    fn files(seed: u64) -> (tempfile::TempDir, [PathBuf; 2]) {
        let mut rng = Seeds::new(seed).stream("files");
        let dir = tempfile::tempdir().unwrap();
        let paths = ["1.csv", "2.csv"].map(|name| dir.path().join(name));
        for (path, rows) in paths.iter().zip([40_u64, 25]) {
            let mut text = "\nd,i,w,late,n\n".to_owned();
            for row in 0..rows {
                let day = 1 + rng::below(&mut rng, 28);
                let large = (1_u64 << 60) + rng::below(&mut rng, 1000) as u64;
                let word = ["red", "green", ""][rng::below(&mut rng, 3)];
                let late = if row < 20 { "" } else { ["a", "b"][rng::below(&mut rng, 2)] };
                let number = if row % 3 == 0 { "1.5".to_owned() } else { row.to_string() };
                writeln!(text, "2024-01-{day:02}T00:00:00.25,{large},{word},{late},{number}").unwrap();
            }
            crate::io::write_atomic(path, text.as_bytes()).unwrap();
        }
        (dir, paths)
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]
        #[test]
        fn pieces_of_several_files_are_the_table_in_memory(
            seed in 0_u64..1000,
            bytes in 1_usize..600,
            filter in prop::sample::select(vec![
                "", "w = 'red'", "d >= '2024-01-10'", "late IS NULL OR late = 'a'", "n > 1 AND w <> 'green'",
            ]),
        ) {
            let (_dir, paths) = files(seed);
            let filter = (!filter.is_empty()).then(|| crate::pairs::Predicate::parse(filter).unwrap());
            for (x, y) in [("d", "i"), ("n", "d"), ("i", "n"), ("w", "i"), ("late", "w")] {
                let options = TableOptions { filter: filter.clone(), ..of(x, y, &[]) };
                let whole = crate::pairs::tables(&paths, &options).unwrap().0.remove(0);
                let mut found: [Vec<f64>; 2] = Default::default();
                let passed = pass(&paths, &options, PieceSize { rows: 1, bytes }, &mut |piece, _| {
                    found[0].extend((0..piece.len()).map(|r| piece.x.row(r)[0]));
                    found[1].extend((0..piece.len()).map(|r| piece.y.row(r)[0]));
                    true
                })
                .unwrap();
                prop_assert_eq!((passed.rows, passed.used), (65, whole.len() as u64));
                for (found, expected) in found.iter().zip([&whole.x, &whole.y]) {
                    if expected.is_words(0) {
                        // numbers of words: one each
                        let pairs: std::collections::BTreeSet<(u64, u64)> =
                            found.iter().zip(&expected.data).map(|(a, b)| (a.to_bits(), b.to_bits())).collect();
                        let words: std::collections::BTreeSet<u64> = expected.data.iter().map(|v| v.to_bits()).collect();
                        prop_assert_eq!(pairs.len(), words.len());
                    } else {
                        // counted from elsewhere, the same in all pieces
                        let moved = found[0] - expected.data[0];
                        for (a, b) in found.iter().zip(&expected.data) {
                            prop_assert!((a - b - moved).abs() < 1e-9, "{} {} {}", a, b, moved);
                        }
                    }
                }
                // a sample of all rows is the table
                let all = TableOptions { sample: Some(Sample { rows: 1000, seeds: Seeds::new(1) }), ..options.clone() };
                prop_assert_eq!(crate::pairs::tables(&paths, &all).unwrap().0.remove(0), whole);
            }
        }
    }

    #[test]
    fn a_sample_takes_pieces_of_the_types_of_their_columns_whole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        let text = format!("a,b\n{}{}", "1,\n".repeat(30), "2.5,x\n".repeat(30));
        crate::io::write_atomic(&path, text.as_bytes()).unwrap();
        let options = TableOptions { sample: Some(Sample { rows: 1000, seeds: Seeds::new(1) }), ..of("a", "b", &[]) };
        let size = PieceSize { rows: 1, bytes: 20 };
        let passed = pass(&[path], &options, size, &mut |_, _| true).unwrap();
        assert_eq!(passed.sample.x.data, [2.5; 30]);
        assert_eq!((passed.sample.y.is_words(0), passed.used), (true, 30));
    }

    #[test]
    fn columns_hold_one_thing_in_all_pieces_and_files() {
        let dir = tempfile::tempdir().unwrap();
        let paths = ["1.csv", "2.csv"].map(|name| dir.path().join(name));
        let fails = |first: &str, second: &str| {
            crate::io::write_atomic(&paths[0], format!("a,b\n{first}").as_bytes()).unwrap();
            crate::io::write_atomic(&paths[1], format!("a,b\n{second}").as_bytes()).unwrap();
            let size = PieceSize { rows: 1, bytes: 8 };
            let error = pass(&paths, &of("a", "b", &[]), size, &mut |_, _| true).unwrap_err().to_string();
            let sample = Some(Sample { rows: 9, seeds: Seeds::new(1) });
            let options = TableOptions { sample, ..of("a", "b", &[]) };
            assert_eq!(drawn_in(&paths, &options, size).unwrap_err().to_string(), error);
            (error, crate::pairs::tables(&paths, &of("a", "b", &[])).unwrap_err().to_string())
        };
        for (first, second) in [("x,1\ny,2\n", "1,1\n2,2\n"), ("1,1\n", "true,1\n"), ("2024-01-01,1\n", "7,2\n")] {
            let (found, expected) = fails(first, second);
            assert_eq!(found, expected);
            assert!(found.contains(" holds ") && found.contains("takes both as words"), "{found}");
        }
        let (found, _) = fails("2024-01-01,1\n2024-01-02,1\n17,3\n", "1,1\n");
        let expected =
            "column \"a\" holds both dates and numbers, seen from row 3 on: a large or sampled table is read in pieces";
        assert!(found.starts_with(expected), "{found}");
        // rows are those of the file, also behind a filter
        crate::io::write_atomic(&paths[0], b"a,b\n1,1\n2,2\n").unwrap();
        crate::io::write_atomic(&paths[1], b"a,b\n1,1\n1,2\n1e200,3\n").unwrap();
        let filter = Some(crate::pairs::Predicate::parse("b > 1").unwrap());
        let options = TableOptions { filter, ..of("a", "b", &[]) };
        let error = pass(&paths, &options, PieceSize { rows: 1, bytes: 8 }, &mut |_, _| true).unwrap_err().to_string();
        assert!(error.starts_with("column \"a\", row 3: infinite") && error.ends_with("2.csv"), "{error}");
    }

    /// What [`drawn`] gives of pieces of this size.
    fn drawn_in(paths: &[PathBuf], options: &TableOptions, size: PieceSize) -> Result<(), PairsError> {
        let mut drawn = Drawn::new(options.sample.as_ref().unwrap());
        over(paths, options, size, &mut |table, places, _, _| {
            drawn.add(&table.frame, places, &table.path()).map(|()| true)
        })
        .map(drop)
    }

    #[test]
    fn vectors_have_one_length_in_all_pieces() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.parquet");
        let vector = |length: usize| Series::new("".into(), vec![1.0; length]);
        let vectors: Vec<Series> = [2, 2, 3].map(vector).to_vec();
        let columns = vec![
            polars::prelude::Column::from(Series::new("v".into(), vectors)),
            polars::prelude::Column::from(Series::new("b".into(), [1.0, 2.0, 3.0])),
        ];
        let mut frame = polars::prelude::DataFrame::new(3, columns).unwrap();
        ParquetWriter::new(std::fs::File::create(&path).unwrap()).finish(&mut frame).unwrap();
        for rows in [1, 2, 3] {
            let size = PieceSize { rows, bytes: 1 };
            let error = pass(std::slice::from_ref(&path), &of("v", "b", &[]), size, &mut |_, _| true).unwrap_err();
            let error = error.to_string();
            assert!(error.starts_with("column \"v\", row 3: expected a vector of 2 numbers, found 3"), "{error}");
        }
    }

    #[test]
    fn who_wants_no_more_reads_no_more_and_a_condition_is_over_all_pieces() {
        let (_dir, paths) = files(1);
        let mut seen = 0;
        let size = PieceSize { rows: 1, bytes: 100 };
        let passed = pass(&paths, &of("d", "i", &[]), size, &mut |_, _| {
            seen += 1;
            seen < 2
        })
        .unwrap();
        assert!(seen == 2 && passed.rows < 20, "{passed:?}");
        let sample = Some(Sample { rows: 1000, seeds: Seeds::new(1) });
        let options = TableOptions { sample, ..of("d", "i", &[]) };
        let passed = pass(&paths, &options, size, &mut |_, _| false).unwrap();
        assert_eq!((passed.rows, passed.sample.len()), (65, 65));
        for (text, message) in [
            ("n > 1000", "no rows: --where \"n > 1000\" keeps none of the 65 rows"),
            ("late = 'zz'", "no rows: --where \"late = 'zz'\" keeps none of the 65 rows"),
        ] {
            let filter = Some(crate::pairs::Predicate::parse(text).unwrap());
            let options = TableOptions { filter, ..of("d", "i", &[]) };
            let error = pass(&paths, &options, size, &mut |_, _| true).unwrap_err().to_string();
            assert!(error.starts_with(message), "{error}");
        }
        crate::io::write_atomic(&paths[0], b"d,x\n").unwrap();
        let missing = pass(&paths[..1], &of("d", "i", &[]), size, &mut |_, _| true).unwrap_err().to_string();
        assert!(missing.starts_with("no column \"i\""), "{missing}");
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
                pass(std::slice::from_ref(&path), &of("a", "b", &[]), PieceSize { rows: 1, bytes: 40 }, &mut |_, _| {
                    true
                })
                .unwrap_err();
            error.to_string()
        };
        let lines = |n: usize, line: &str| format!("{line}\n").repeat(n);
        let infinite = fails(&format!("a,b\n{}1e200,2\n{}", lines(50, "1,2"), lines(50, "1,2")));
        assert!(infinite.starts_with("column \"a\", row 51: infinite or over 1e150"), "{infinite}");
        let mixed = fails(&format!("a,b\n{}{}", lines(50, "1,2"), lines(50, "x,2")));
        assert!(mixed.starts_with("column \"a\" holds both numbers and words, seen from row "), "{mixed}");
        let mixed = fails(&format!("a,b\n{}{}", lines(49, "x,2"), lines(50, "1,2")));
        assert!(mixed.starts_with("column \"a\" holds both words and numbers, seen from row "), "{mixed}");
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
