//! Tables that other programs wrote, in every form, against values computed from the row number; damaged files; cells,
//! dates, several files, conditions and parts from outside. `datasets/tables/forms/make.py` writes the files.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use ccmarl::pairs::{Predicate, TableOptions, tables};
use ccmarl::schema::{Columns, Samples};
use serde_json::Value;

use super::estimate_mi::run;

const N: usize = 40;

fn form(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("datasets/tables/forms").join(name)
}

fn options(x: &[&str], y: &[&str]) -> TableOptions {
    let own = |names: &[&str]| names.iter().map(ToString::to_string).collect();
    TableOptions { x: own(x), y: own(y), ..TableOptions::default() }
}

fn read(paths: &[PathBuf], options: &TableOptions) -> Result<Samples, String> {
    tables(paths, options).map(|(mut sets, _)| sets.remove(0)).map_err(|e| e.to_string())
}

fn column(columns: &Columns, c: usize) -> Vec<f64> {
    (0..columns.rows()).map(|r| columns.row(r)[c]).collect()
}

fn each(value: impl Fn(usize) -> f64) -> Vec<f64> {
    (0..N).map(value).collect()
}

#[test]
fn arrow_files_streams_and_parquet_hold_what_pyarrow_and_pandas_wrote() {
    for name in ["plain.arrow", "stream.arrow", "lz4.feather", "zstd.feather", "pyarrow.parquet"] {
        let found = read(&[form(name)], &options(&["i", "u", "v", "d"], &["b", "c", "t", "m", "p"])).unwrap();
        assert_eq!(found.x.names, ["i", "u", "v[0]", "v[1]", "d"], "{name}");
        let expected = [
            each(|r| (r * 7 % N) as f64),
            each(|r| (r % 5) as f64),
            each(|r| r as f64 / 2.0),
            each(|r| -(r as f64)),
            each(|r| 86_400.0 * r as f64),
        ];
        expected
            .iter()
            .enumerate()
            .for_each(|(c, e)| assert_eq!(column(&found.x, c), *e, "{name}: {}", found.x.names[c]));
        // high, low, middle
        let expected = [
            each(|r| f64::from(u8::from(r * 3 % 7 > 3))),
            each(|r| [1.0, 0.0, 2.0][r % 3]),
            each(|r| r as f64 / 1e9),
            each(|r| 3600.0 + r as f64),
            each(|r| r as f64 / 4.0),
        ];
        expected
            .iter()
            .enumerate()
            .for_each(|(c, e)| assert_eq!(column(&found.y, c), *e, "{name}: {}", found.y.names[c]));
        assert_eq!(found.y.words, [false, true, false, false, false], "{name}");
        assert_eq!(
            found.notes,
            [
                "note: dates of d are seconds since the first of them",
                "note: dates of t are seconds since the first of them",
                "note: times of m are seconds",
                "note: times of p are seconds"
            ]
        );
    }
    for name in ["plain.arrow", "pandas.feather", "pandas.csv", "pyarrow.parquet"] {
        let found = read(&[form(name)], &options(&["f", "b"], &["s", "d", "t", "c"])).unwrap();
        let rows: Vec<usize> = (0..N).filter(|r| *r != 3 && *r != 5).collect();
        assert_eq!(found.notes[0], "2 of 40 rows left out: a missing value in f, b, s, d, t, c", "{name}");
        let of = |value: &dyn Fn(usize) -> f64| rows.iter().map(|&r| value(r)).collect::<Vec<_>>();
        assert_eq!(column(&found.x, 0), of(&|r| (r * r) as f64 / 8.0), "{name}");
        assert_eq!(column(&found.x, 1), of(&|r| f64::from(u8::from(r * 3 % 7 > 3))), "{name}");
        assert_eq!(column(&found.y, 0), of(&|r| (r * 5 % 4) as f64), "{name}");
        assert_eq!(column(&found.y, 1), of(&|r| 86_400.0 * r as f64), "{name}");
        assert_eq!(column(&found.y, 2), of(&|r| r as f64 / 1e9), "{name}");
        assert_eq!(column(&found.y, 3), of(&|r| [1.0, 0.0, 2.0][r % 3]), "{name}");
    }
}

#[test]
fn arrays_hold_what_numpy_wrote() {
    let (a, b, c) = (each(|r| (r * 7 % N) as f64), each(|r| (r * r) as f64 / 8.0), each(|r| -(r as f64)));
    for name in ["c-order.npy", "fortran.npy", "big-endian.npy"] {
        let found = read(&[form(name)], &options(&["c0", "c2"], &["c1"])).unwrap();
        assert_eq!(
            (column(&found.x, 0), column(&found.x, 1), column(&found.y, 0)),
            (a.clone(), c.clone(), b.clone()),
            "{name}"
        );
    }
    let found = read(&[form("integers.npy")], &options(&["c0"], &["c1"])).unwrap();
    assert_eq!((column(&found.x, 0), column(&found.y, 0)), (a, each(|r| (r * r / 8) as f64)));
    for (name, expected) in [
        ("half.npy", each(|r| -(r as f64) / 2.0)),
        ("truths.npy", each(|r| f64::from(u8::from(r % 3 == 0)))),
        ("days.npy", each(|r| 86_400.0 * r as f64)),
        // counted from the least
        ("unsigned.npy", vec![0.0, 2_f64.powi(63) + 2_f64.powi(20), 4.0]),
    ] {
        assert_eq!(column(&read(&[form(name)], &options(&["c0"], &["c0"])).unwrap().x, 0), expected, "{name}");
    }
    let fields = ["id", "pose.x", "pose.y", "v[0]", "v[1]", "name", "code"];
    let found = read(&[form("fields.npy")], &options(&fields, &["id"])).unwrap();
    let sign = |r: usize| (r % 2) as f64;
    let expected = [
        each(|r| r as f64),
        each(|r| r as f64 / 4.0),
        each(|r| 2.0 * r as f64),
        each(|r| r as f64),
        each(|r| -(r as f64)),
        each(|r| 1.0 - sign(r)), // "c" before "äb"
        each(sign),
    ];
    expected.iter().enumerate().for_each(|(c, e)| assert_eq!(column(&found.x, c), *e, "{}", fields[c]));
    let all = ccmarl::pairs::all_pairs(&[form("c-order.npy")], &TableOptions::default()).unwrap().0;
    assert_eq!(
        all.iter().map(|s| (s.labels.x.as_str(), s.labels.y.as_str())).collect::<Vec<_>>(),
        [("c0", "c1"), ("c0", "c2"), ("c1", "c2")]
    );
}

#[test]
fn types_that_are_not_read_are_named_and_stand_in_nobodys_way() {
    for name in ["odd.feather", "odd.parquet"] {
        for (column, kind) in [("decimal", "Decimal(10, 2)"), ("half", "Float16"), ("pose", "Struct(")] {
            let error = read(&[form(name)], &options(&["x"], &[column])).unwrap_err();
            let expected = format!("column {column:?} holds {kind}");
            assert!(
                error.starts_with(&expected) && error.contains("write it as float64, an integer or text"),
                "{error}"
            );
        }
        let error = read(&[form(name)], &options(&["x"], &["nothing"])).unwrap_err();
        assert!(
            error.starts_with("column \"nothing\" holds null, expected numbers, booleans, dates or words"),
            "{error}"
        );
        let found = read(&[form(name)], &options(&["x"], &["y"])).unwrap();
        assert_eq!((found.len(), found.x.row(3), found.y.row(3)), (20, &[3.0][..], &[2.0][..]));
        let (sets, left_out) = ccmarl::pairs::all_pairs(&[form(name)], &TableOptions::default()).unwrap();
        assert_eq!((sets.len(), left_out.len()), (1, 3), "{left_out:?}");
        assert_eq!(left_out[0], "column \"decimal\" holds Decimal(10, 2)");
    }
}

fn save(path: &Path, bytes: &[u8]) {
    // not synced: there are thousands
    std::fs::File::create(path).unwrap().write_all(bytes).unwrap();
}

/// An array file of version 1 with this header and data.
fn npy(header: &str, data: &[u8]) -> Vec<u8> {
    let length = (header.len() as u16).to_le_bytes();
    [b"\x93NUMPY\x01\x00".as_slice(), &length, header.as_bytes(), data].concat()
}

#[test]
fn a_damaged_array_is_an_error_and_never_a_panic() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npy");
    let fails = |bytes: &[u8]| {
        save(&path, bytes);
        read(std::slice::from_ref(&path), &options(&["c0"], &["c0"]))
    };
    for name in ["c-order.npy", "fields.npy", "truths.npy"] {
        let bytes = std::fs::read(form(name)).unwrap();
        for length in 0..bytes.len() {
            let error = fails(&bytes[..length]).unwrap_err();
            assert!(error.starts_with("not a readable NPY table: ") || length < 6, "{length}: {error}");
        }
        for at in 0..160.min(bytes.len()) {
            let mut changed = bytes.clone();
            changed[at] ^= 0x15;
            drop(fails(&changed)); // a value or a name may be another; whatever comes back, it comes back
        }
    }
    let header = |shape: &str| format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n");
    let kind = |descr: &str| format!("{{'descr': {descr}, 'fortran_order': False, 'shape': (1,), }}\n");
    for (bytes, message) in [
        (npy(&header("(4611686018427387904, 4)"), &[0; 8]), "does not fit the 8 bytes behind the header: cut short?"),
        (npy(&header("(2,)"), &[0; 24]), "the shape (2) of 8 bytes each does not fit the 24 bytes"),
        (npy(&header("(0, 9223372036854775807)"), &[]), "more than 1048576 columns: transpose it?"),
        (npy(&header("(1, 1, 1)"), &[0; 8]), "expected one or two dimensions, found the shape (1, 1, 1): reshape it"),
        (npy(&header("()"), &[0; 8]), "expected one or two dimensions, found the shape ()"),
        (npy(&header("(-1,)"), &[0; 8]), "dimension cannot be negative"),
        (npy(&kind("'|O'"), &[0; 8]), "it holds Python objects, expected numbers, booleans, dates or words"),
        (npy(&kind("'<c16'"), &[0; 16]), "column c0 holds <c16, expected numbers, booleans, dates or words"),
        (npy(&kind("'|S0'"), &[]), "its elements have no bytes"),
        (npy(&kind("'<M8[Y]'"), &[0; 8]), "column c0 holds <M8[Y]"),
        (npy(&kind("'<M8[W]'"), &[0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f]), "a time that is too large"),
        (npy(&kind("'|S2'"), &[0xff, 0xfe]), "column c0, row 1: expected UTF-8 text"),
        (npy(&kind("[('a', '<f8', (1000000, 1000000))]"), &[]), "does not fit"),
        (npy(&"[".repeat(5000), &[]), "a header with brackets 5000 deep, expected at most 12"),
        (
            [b"\x93NUMPY\x02\x00".as_slice(), &u32::MAX.to_le_bytes()].concat(),
            "a header of 4294967295 bytes, expected at most 1048576",
        ),
    ] {
        let error = fails(&bytes).unwrap_err();
        assert!(error.contains(message) && error.ends_with("a.npy"), "{error}");
    }
}

#[test]
fn a_damaged_arrow_file_is_an_error_and_never_a_panic() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.arrow");
    let wanted = options(&["i", "f", "b", "v"], &["s", "c", "t"]);
    for name in ["plain.arrow", "stream.arrow", "lz4.feather", "zstd.feather"] {
        let bytes = std::fs::read(form(name)).unwrap();
        for length in (0..bytes.len()).step_by(41) {
            save(&path, &bytes[..length]);
            let cut = read(std::slice::from_ref(&path), &wanted);
            // a stream that ends between two messages is a shorter stream
            assert!(cut.is_err() || name == "stream.arrow", "{name} cut to {length} bytes");
        }
        for at in (0..bytes.len()).step_by(5) {
            let mut changed = bytes.clone();
            changed[at] ^= [0x01, 0x80, 0x7f][at % 3];
            save(&path, &changed);
            drop(read(std::slice::from_ref(&path), &wanted));
        }
    }
    for (bytes, message) in [
        (b"ARROW1".to_vec(), "it is too short for an Arrow file"),
        (b"FEA1 and then nothing of the kind".to_vec(), "it does not begin and end as an Arrow file (Feather 1"),
        ([b"ARROW1\0\0".as_slice(), &[0xff; 4], b"ARROW1"].concat(), "a footer of 4294967295 bytes"),
    ] {
        save(&path, &bytes);
        let error = read(std::slice::from_ref(&path), &wanted).unwrap_err();
        assert!(error.starts_with("damaged: ") && error.contains(message), "{error}");
    }
}

fn json(args: &[&str]) -> Vec<Value> {
    let (code, out, err) =
        run(&[args, &["--estimator", "gaussian", "--permutations", "0", "--format", "json"]].concat());
    assert_eq!(code, 0, "{err}");
    serde_json::from_str(&out).unwrap()
}

fn text(dir: &Path, name: &str, text: &str) -> String {
    save(&dir.join(name), text.as_bytes());
    dir.join(name).to_string_lossy().into_owned()
}

/// 40 rows from `from`: a, b, an instant, a word.
fn csv(dir: &Path, name: &str, from: usize) -> String {
    let mut out = "a,b,t,w\n".to_owned();
    for r in from..from + 40 {
        writeln!(
            out,
            "{},{},2024-01-{:02}T{:02}:00:00Z,{}",
            r * 37 % 41,
            r * r % 11,
            1 + r / 24,
            r % 24,
            ["u", "v"][r % 2]
        )
        .unwrap();
    }
    text(dir, name, &out)
}

#[test]
fn several_files_are_one_table() {
    let dir = tempfile::tempdir().unwrap();
    let (first, second) = (csv(dir.path(), "a.csv", 0), csv(dir.path(), "b.csv", 40));
    let one = csv(dir.path(), "whole.tsv.txt", 0);
    let pattern = dir.path().join("?.csv").to_string_lossy().into_owned();
    let rows = json(&[&pattern, "--x", "a", "--y", "b", "--time", "t", "--lag", "0,3"]);
    let named = json(&[&second, &first, "--x", "a", "--y", "b", "--time", "t", "--lag", "0,3"]);
    assert_eq!((&rows, &rows[0]["n"], &rows[1]["n"]), (&named, &80.into(), &77.into()));
    let rows = json(&[&pattern, "--x", "a", "--y", "b", "--group", "file", "--lag", "3"]);
    assert_eq!((&rows[0]["group"], &rows[0]["n"]), (&"file".into(), &74.into()));
    let rows = json(&[&pattern, "--x", "a", "--y", "b", "--by", "file"]);
    let groups: Vec<&str> = rows.iter().map(|r| r["group"].as_str().unwrap()).collect();
    assert_eq!(groups, [format!("row, file = {first}"), format!("row, file = {second}")]);
    assert_eq!(json(&[&one, "--x", "a", "--y", "b"])[0]["value"], rows[0]["value"]);
    // forms mix
    let (plain, feather) = (form("plain.arrow"), form("pandas.csv"));
    let (plain, feather) = (plain.to_str().unwrap(), feather.to_str().unwrap());
    let rows = json(&[plain, feather, "--x", "i", "--y", "d,t", "--group", "file"]);
    assert_eq!(rows[0]["n"], 80);
    let words = text(dir.path(), "words.csv", "a,b\nu,1\nv,2\n");
    let late = text(dir.path(), "late.csv", "a,b\n1,2\n3,inf\n");
    for (args, code, message) in [
        (&[&first, &words, "--x", "a", "--y", "b"][..], 1, "column \"a\" holds str, and i64 in "),
        (&[&first, &words, "--x", "t", "--y", "b"], 2, "no column \"t\": known are a, b: "),
        (
            &[&first, &late, "--x", "a", "--y", "b"],
            1,
            "column \"b\", row 2: infinite or over 1e150 (inf); leave it out with --where",
        ),
        (&[&first, &second], 2, "several paths are read as tables, with --x and --y; a store is read alone"),
        (&["no*.csv", "--x", "a", "--y", "b"], 1, "no file matches: no*.csv"),
        (&["a[.csv", "--x", "a", "--y", "b"], 2, "not a pattern of file names: "),
    ] {
        let args: Vec<&str> = args.iter().map(|arg| &**arg).collect();
        let (found, out, err) = run(&args);
        assert!(found == code && out.is_empty() && err.contains(message), "{args:?}: {found}: {err}");
    }
}

#[test]
fn cells_are_read_honestly_or_not_at_all() {
    let dir = tempfile::tempdir().unwrap();
    let stray = text(dir.path(), "stray.csv", "a,b,id\n1,NA,7\n2,3,7a\nabc,-,8\n4,none,9\n5,,9b\n6,n/a,1\n");
    let empty = text(dir.path(), "empty.csv", "a,b\n");
    let all = csv(dir.path(), "all.csv", 0);
    let long = text(dir.path(), "long.csv", &format!("a,b\n1,2\n\"{}\",2\n", "x".repeat((16 << 20) + 1)));
    let uneven = text(dir.path(), "uneven.csv", "a,b\n1,\"2,\n3\"\n3,4,5\n");
    let semicolons = text(dir.path(), "semicolons.csv", "a;b\n1;2\n");
    let packed = text(dir.path(), "a.npz", "PK\u{3}\u{4} and so on");
    let store = dir.path().join("folder").to_string_lossy().into_owned();
    std::fs::create_dir(&store).unwrap();
    for (code, args, message) in [
        (
            1,
            &[&stray, "--x", "a", "--y", "b"][..],
            "column \"a\", row 3: expected a number, as in 5 of 6 rows, found \"abc\"; leave the cell empty or write NA where a value is missing, leave rows out with --where, or give --words a to take all of them as words: ",
        ),
        (1, &[&uneven, "--x", "a", "--y", "b"], "row 2 has 3 fields, expected 2 as in the first line"),
        (
            2,
            &[&semicolons, "--x", "a", "--y", "b"],
            "no column \"a\": its only column is \"a;b\": expected commas (tabs in a .tsv) between columns",
        ),
        (
            1,
            &[&packed, "--x", "a", "--y", "b"],
            "not a readable CSV table: it is packed (zip, gzip, .npz, a spreadsheet)",
        ),
        (1, &[&empty, "--x", "a", "--y", "b"], "the table has no rows: "),
        (
            1,
            &[&long, "--x", "a", "--y", "b"],
            "line 3 is longer than 16777216 bytes: not a table, or a quotation mark without its pair: ",
        ),
        (
            2,
            &[&all, "--x", "a", "--y", "b", "--time", "w"],
            "--time \"w\" holds words, expected numbers or dates such as",
        ),
        (
            2,
            &[&all, "--x", "a", "--y", "b", "--where", "a > 'x'"],
            "column \"a\" (a number) cannot be compared with 'x' (text)",
        ),
        (2, &[&all, "--x", "a", "--y", "b", "--where", "ab > 3"], "no column \"ab\": did you mean a?: "),
        (
            1,
            &[&all, "--x", "a", "--y", "b", "--where", "a > 99"],
            "no rows: --where \"a > 99\" keeps none of the 40 rows: ",
        ),
        (
            1,
            &[&store, "--x", "a", "--y", "b"],
            "is a directory, and no table: a store is read without --x and --y; of another directory name the files: ",
        ),
    ] {
        let args: Vec<&str> = args.iter().map(|arg| &**arg).collect();
        let (found, out, err) = run(&args);
        assert!(found == code && out.is_empty() && err.contains(message), "{args:?}: {found}: {err}");
        assert_eq!(err.matches("irectory").count(), if args[0] == store { 2 } else { 0 }, "{err}");
    }
    // as words they are what they are
    let found =
        read(&[PathBuf::from(&stray)], &TableOptions { words: vec!["a".to_owned()], ..options(&["a"], &["a"]) });
    assert_eq!(column(&found.unwrap().x, 0), [0.0, 1.0, 5.0, 2.0, 3.0, 4.0]);
    // a filter is no remedy for a stray cell in a column that it reads, --words is
    let (code, out, err) = run(&[&stray, "--x", "a", "--y", "id", "--words", "a,id", "--estimator", "discrete"]);
    assert!(code == 0 && out.contains("a ; id"), "{err}");
}

#[test]
fn times_order_rows_and_ties_are_told() {
    let dir = tempfile::tempdir().unwrap();
    // nanoseconds since 1970 that a float cannot tell apart, backwards
    let mut out = "t,x\n".to_owned();
    (0..50).rev().for_each(|r| writeln!(out, "{},{r}", 1_706_702_400_000_000_000_i64 + r).unwrap());
    let nanos = PathBuf::from(text(dir.path(), "nanos.csv", &out));
    let timed = |time: &str, x: &[&str]| TableOptions { time: Some(time.to_owned()), ..options(x, x) };
    let found = read(std::slice::from_ref(&nanos), &timed("t", &["x", "t"])).unwrap();
    let rising: Vec<f64> = (0..50).map(f64::from).collect();
    assert_eq!((column(&found.x, 0), column(&found.x, 1)), (rising.clone(), rising));
    assert_eq!(found.notes[0], "note: integers of t are counted from the least of them: they do not fit a float");
    let ties = text(
        dir.path(),
        "ties.csv",
        "t,x\n2024-01-02,1\n2024-01-01T12:00+12:00,2\n2024-01-01,3\n2024-01-02 00:00:00.5,4\n",
    );
    let found = read(&[PathBuf::from(ties)], &timed("t", &["x"])).unwrap();
    assert_eq!(column(&found.x, 0), [2.0, 3.0, 1.0, 4.0]);
    assert_eq!(found.notes, ["note: 1 of 4 rows have the t of the row before: they stay in the file's order"]);
}

#[test]
fn conditions_and_parts_of_a_table() {
    let dir = tempfile::tempdir().unwrap();
    let table = csv(dir.path(), "a.csv", 0);
    let base = [table.as_str(), "--x", "a", "--y", "b"];
    let half = json(&[&base[..], &["--where", "w = 'u' AND t >= '2024-01-01'"]].concat());
    assert_eq!(
        (&half[0]["n"], &half[0]["warnings"][0]),
        (&20.into(), &"note: 20 of 40 rows kept by --where w = 'u' AND t >= '2024-01-01'".into())
    );
    let parts = json(&[&base[..], &["--by", "w"]].concat());
    let groups: Vec<&str> = parts.iter().map(|r| r["group"].as_str().unwrap()).collect();
    assert_eq!((groups, &parts[0]["value"]), (vec!["row, w = u", "row, w = v"], &half[0]["value"]));
    let (_, out, _) = run(&[&base[..], &["--by", "w", "--estimator", "gaussian"]].concat());
    assert!(
        out.contains("a ; b, w = u") && out.contains("a ; b, w = v") && out.contains("each row was taken"),
        "{out}"
    );
    // numbers by size
    let mut found =
        tables(&[PathBuf::from(&table)], &TableOptions { by: vec!["b".to_owned()], ..options(&["a"], &["a"]) })
            .unwrap()
            .0;
    assert_eq!(found.pop().unwrap().labels.within.unwrap(), "b = 9");
    // a condition may use columns that are not compared, and the row of an error is the file's
    let late = text(dir.path(), "late.csv", "a,b,keep\n1,2,no\n3,4,yes\n5,inf,yes\n");
    let (code, _, err) = run(&[&late, "--x", "a", "--y", "b", "--where", "keep = 'yes'"]);
    assert!(code == 1 && err.contains("column \"b\", row 3: infinite"), "{err}");
    let filter = Some(Predicate::parse("b < 1e9").unwrap());
    assert_eq!(read(&[PathBuf::from(late)], &TableOptions { filter, ..options(&["a"], &["b"]) }).unwrap().len(), 2);
    let many = text(dir.path(), "many.csv", &(0..1002).fold("a,b\n".to_owned(), |out, r| out + &format!("{r},{r}\n")));
    let (code, _, err) = run(&[&many, "--x", "a", "--y", "b", "--by", "a"]);
    assert!(code == 1 && err.contains("--by a: more than 1000 values: name a column with fewer: "), "{err}");
    // a pattern may have a comma in it, and --x may stand twice
    let args = [table.as_str(), "--x", "regex:^[a,b]{1,1}$", "--x", "w", "--y", "t", "--format", "json"];
    let (code, out, err) = run(&[&args[..], &["--estimator", "ksg-mixed", "--permutations", "0"]].concat());
    let rows: Vec<Value> = serde_json::from_str(&out).unwrap();
    assert_eq!((code, &rows[0]["x"]), (0, &"a,b,w".into()), "{err}");
}

#[test]
fn links_of_a_store_are_pooled_divided_and_filtered() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("store").to_string_lossy().into_owned();
    let record = ["record", "--scenario", "simple_spread", "--link", "dropout:0.3", "--episodes", "12"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    assert!(command.args(record).args(["--out", &store]).output().unwrap().status.success());
    let n = |rows: &[Value]| rows.iter().map(|r| r["n"].as_u64().unwrap()).sum::<u64>();
    let all = json(&[&store]);
    let total = n(&all);
    for (by, rows, senders) in [("sender", 6, 3), ("receiver", 6, 0), ("none", 2, 0), ("sender,receiver", 12, 3)] {
        let found = json(&[&store, "--by", by]);
        let named: std::collections::BTreeSet<_> = found.iter().filter_map(|r| r["sender"].as_str()).collect();
        assert_eq!((found.len(), named.len(), n(&found)), (rows, senders, total), "{by}");
    }
    let steps = json(&[&store, "--by", "none,step:10"]);
    let groups: Vec<&str> = steps.iter().map(|r| r["group"].as_str().unwrap()).collect();
    let ranges = ["episode, steps 0–9", "episode, steps 10–19", "episode, steps 20–29"];
    assert_eq!((groups, n(&steps)), ([ranges, ranges].concat().iter().map(|g| &**g).collect::<Vec<_>>(), total));
    let (_, out, _) = run(&[&store, "--by", "receiver", "--estimator", "gaussian", "--permutations", "20"]);
    assert!(out.contains("all → agent_1 delivered") && out.contains("note: 2 links are pooled"), "{out}");
    let some = json(&[&store, "--where", "sender = 'agent_0' AND step BETWEEN 5 AND 9 AND delivered"]);
    assert_eq!((some.len(), some[0]["delivered"].as_bool()), (2, Some(true)));
    assert!(n(&some) < 2 * 5 * 12);
    for (args, message) in [
        (["--by", "agent"], "--by \"agent\": of a store expected sender, receiver, none (all links pooled) or step:N"),
        (["--where", "group = 1"], "no column \"group\": known are delivered, episode, receiver, sender, step: "),
    ] {
        let (code, _, err) = run(&[&[store.as_str()], &args[..]].concat());
        assert!(code == 2 && err.contains(message), "{err}");
    }
    let plot = dir.path().join("p.svg").to_string_lossy().into_owned();
    let (code, _, err) = run(&[&store, "--by", "none", "--plot", &plot]);
    assert!(code == 2 && err.contains("--plot draws one matrix: leave out --by"), "{err}");
}

#[test]
fn topics_of_an_mcap_file_are_columns() {
    let file = [form("json.mcap")];
    let x = ["/imu.linear_acceleration.x", "/imu.linear_acceleration.y", "/imu.v[1]"];
    let timed = TableOptions { time: Some("log_time".to_owned()), ..options(&x, &["/imu.frame"]) };
    let found = read(&file, &timed).unwrap();
    let expected = [each(|r| r as f64 / 2.0), each(|r| -(r as f64)), each(|r| (r * r) as f64)];
    expected.iter().enumerate().for_each(|(c, e)| assert_eq!(column(&found.x, c), *e, "{}", x[c]));
    assert_eq!((column(&found.y, 0), found.notes.len()), (each(|r| (r % 2) as f64), 0));
    // two topics: the messages of equal log time
    let joined = read(&file, &options(&["/imu.v[0]", "log_time"], &["/state.level", "/state.on"])).unwrap();
    let rows: Vec<f64> = (0..N).step_by(2).filter(|r| *r != 4).map(|r| r as f64).collect();
    assert_eq!(
        joined.notes[0],
        "1 of 20 rows left out: a missing value in /imu.v[0], log_time, /state.level, /state.on"
    );
    let times: Vec<f64> = rows.iter().map(|r| r * 1e7).collect();
    assert_eq!((column(&joined.x, 0), column(&joined.x, 1)), (rows.clone(), times));
    let on: Vec<f64> = rows.iter().map(|r| f64::from(u8::from(r % 3.0 == 0.0))).collect();
    assert_eq!((column(&joined.y, 0), column(&joined.y, 1)), (rows.iter().map(|r| r * 1.5).collect(), on));
    let path = form("json.mcap");
    let path = path.to_str().unwrap();
    for (code, args, message) in [
        (2, ["/imu.w", "/state.on"], "no column \"/imu.w\": did you mean /imu.v[0]"),
        (1, ["/odd.level", "/odd.level"], "column /odd.level holds different things in different messages"),
        (1, ["log_time", "log_time"], "log_time alone is no column of a topic: name one of its fields too"),
        (1, ["/imu.v[0]", "/odd.level"], "/imu, /odd have none in common: take columns of one topic"),
    ] {
        let (found, _, err) = run(&[path, "--x", args[0], "--y", args[1]]);
        assert!(found == code && err.contains(message), "{args:?}: {found}: {err}");
    }
}

#[test]
fn the_messages_of_a_store_are_columns_too() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("store.mcap");
    let record = ["record", "--scenario", "simple_spread", "--link", "perfect", "--episodes", "3", "--out"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    assert!(command.args(record).arg(&store).output().unwrap().status.success());
    let names = ["/rollout/step.episode", "/rollout/step.step", "/rollout/step.agents[0].message[0]"];
    let table = read(std::slice::from_ref(&store), &options(&names, &["/rollout/step.agents[1].action[0]"])).unwrap();
    let mut source = ccmarl::storage::open(&store).unwrap();
    let (mut x, mut y) = (Vec::new(), Vec::new());
    while let Some(episode) = source.next_episode().unwrap() {
        for step in 0..episode.steps {
            // the last row has no action, and is left out
            let message = &episode.messages[0];
            x.extend([episode.index as f64, step as f64, f64::from(message.data[step * message.width])]);
            y.push(f64::from(episode.actions[1].data[step * episode.actions[1].width]));
        }
    }
    assert_eq!((&table.x.data, &table.y.data), (&x, &y));
    assert!(table.notes[0].starts_with("3 of "), "{:?}", table.notes);
    let bytes = std::fs::read(form("json.mcap")).unwrap();
    let path = dir.path().join("a.mcap");
    let wanted = options(&["/imu.v[0]"], &["/state.level"]);
    let whole = read(&[form("json.mcap")], &wanted).unwrap();
    save(&path, &bytes[..bytes.len() / 2]);
    assert!(read(std::slice::from_ref(&path), &wanted).unwrap_err().starts_with("damaged: cut short"));
    for at in (0..bytes.len()).step_by(11) {
        save(&path, &bytes[..at]);
        // what stands behind the data repeats it
        if let Ok(found) = read(std::slice::from_ref(&path), &wanted) {
            assert_eq!(found, whole, "cut to {at} bytes");
        }
        let mut changed = bytes.clone();
        changed[at] ^= 0x41;
        save(&path, &changed);
        drop(read(std::slice::from_ref(&path), &wanted));
    }
}
