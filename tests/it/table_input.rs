//! What users hand in: stray cells beside conditions, headers, names, integers of any size.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use ccmarl::pairs::{Predicate, TableOptions, all_pairs, tables};

use super::estimate_mi::run;

fn text(dir: &Path, name: &str, text: &str) -> String {
    ccmarl::io::write_atomic(&dir.join(name), text.as_bytes()).unwrap();
    dir.join(name).to_string_lossy().into_owned()
}

/// 40 rows of x and y; x is `odd` in two of them.
fn numbers(odd: &str) -> String {
    let x = |r: usize| if r % 20 == 7 { odd.to_owned() } else { (r * 37 % 41).to_string() };
    (0..40).fold("x,y\n".to_owned(), |out, r| out + &format!("{},{}\n", x(r), r * r % 11))
}

#[test]
fn a_condition_leaves_out_stray_cells_and_words_that_are_numbers_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let stray = text(dir.path(), "stray.csv", &numbers("broken"));
    let base = [stray.as_str(), "--x", "x", "--y", "y", "--permutations", "0"];
    let of = |more: &[&str]| run(&[&base[..], more].concat());
    let (code, out, err) = of(&["--estimator", "gaussian", "--where", "x <> 'broken'"]);
    assert!(code == 0 && out.contains("38 of 40 rows kept by --where x <> 'broken'"), "{out}{err}");
    // with a lag too, where those rows stay in their places
    let (code, out, err) = of(&["--estimator", "gaussian", "--where", "x <> 'broken'", "--time", "y", "--lag", "1"]);
    assert!(code == 0 && out.contains("38 of 40 rows kept"), "{out}{err}");
    for (filter, message) in [
        ("x > 3", "column \"x\", row 8: expected a number, as in 38 of 40 rows, found \"broken\""),
        ("x <> 'other'", "column \"x\", row 8: expected a number, as in 38 of 40 rows, found \"broken\""),
    ] {
        let (code, _, err) = of(&["--where", filter]);
        assert!(code == 1 && err.contains(message), "{err}");
    }
    let (code, out, err) = of(&["--estimator", "ksg-mixed,auto", "--words", "x"]);
    assert!(code == 0 && out.contains("--words x: 39 words in 40 rows"), "{out}{err}");
    let (code, _, err) = of(&["--words", "nope"]);
    assert!(code == 2 && err.contains("no column \"nope\": known are x, y: "), "{err}");
    let (code, out, err) = of(&["--estimator", "gaussian", "--where", "-y < 0 AND x <> 'broken'"]);
    assert!(code == 0, "{out}{err}");
    let (code, _, err) = of(&["--lag", "-1"]);
    assert!(code == 2 && err.contains("to move x behind y, swap --x and --y"), "{err}");
    let commas = text(
        dir.path(),
        "commas.csv",
        &numbers("1").replace('\n', "\"\n").replace(',', ",\"0,").replacen("\"0,y\"", "y", 1),
    );
    let (code, _, err) = run(&[&commas, "--x", "x", "--y", "y"]);
    assert!(code == 1 && err.contains("looks like a number with a comma, expected as 1234.5; rewrite"), "{err}");
    let (code, _, err) = run(&[&commas, "--x", "x", "--y", "y", "--words", "y", "--estimator", "ksg-mixed"]);
    assert_eq!(code, 0, "{err}");
    let european = text(dir.path(), "european.csv", "x;y\n0,5;1,25\n0,75;2,5\n");
    let (code, _, err) = run(&[&european, "--x", "x", "--y", "y"]);
    assert!(
        code == 1 && err.contains("its columns stand between semicolons and its numbers have decimal commas"),
        "{err}"
    );
    let latin = dir.path().join("latin.csv");
    ccmarl::io::write_atomic(latin.as_ref(), b"x,y\n1,caf\xe9\n2,b\n3,c\n").unwrap();
    let (code, _, err) = run(&[latin.to_str().unwrap(), "--x", "x", "--y", "y"]);
    assert!(code == 1 && err.contains("it is not UTF-8 text: convert it first"), "{err}");
}

#[test]
fn an_empty_column_is_of_any_kind_in_a_condition() {
    let dir = tempfile::tempdir().unwrap();
    let table = text(dir.path(), "a.csv", "x,y,city\n1,2,\n3,4,\n5,7,\n");
    let filter = Some(Predicate::parse("city = 'Rome' OR city IS NULL AND x > 1").unwrap());
    let options = TableOptions { x: vec!["x".into()], y: vec!["y".into()], filter, ..TableOptions::default() };
    assert_eq!(tables(&[PathBuf::from(table)], &options).unwrap().0[0].x.data, [3.0, 5.0]);
}

#[test]
fn headers_are_read_as_written_and_names_are_near_whatever_their_case() {
    let dir = tempfile::tempdir().unwrap();
    let quoted = text(dir.path(), "q.csv", "\"a \"\"q\"\"\",b\n1,2\n3,4\n5,7\n");
    let options = |x: &str, y: &str| TableOptions { x: vec![x.into()], y: vec![y.into()], ..TableOptions::default() };
    let read = |path: &str, x: &str, y: &str| {
        tables(&[PathBuf::from(path)], &options(x, y))
            .map(|(sets, _)| sets[0].x.data.clone())
            .map_err(|e| e.to_string())
    };
    assert_eq!(read(&quoted, "a \"q\"", "b").unwrap(), [1.0, 3.0, 5.0]);
    let error = read(&quoted, "zzz", "b").unwrap_err();
    assert!(error.contains("known are \"a \\\"q\\\"\", \"b\": "), "{error}");
    let twice = text(dir.path(), "t.csv", "x,y,x,z\n1,2,3,4\n5,6,7,8\n");
    let error = read(&twice, "x", "y").unwrap_err();
    assert!(error.starts_with("the first line names \"x\" more than once: rename one: "), "{error}");
    assert_eq!(read(&twice, "z", "y").unwrap(), [4.0, 8.0]);
    assert!(read(&twice, "x_duplicated_0", "y").unwrap_err().starts_with("no column"));
    assert!(read(&twice, "Z", "y").unwrap_err().starts_with("no column \"Z\": did you mean z"));
}

#[test]
fn parts_of_one_row_and_too_many_pairs_are_told_once() {
    let dir = tempfile::tempdir().unwrap();
    let days: String =
        (0..9).fold("day,x,y\n".to_owned(), |out, r| out + &format!("d{r},{},{}\n", r * 5 % 9, r * 2 % 9));
    let last = (0..20).fold(days, |out, r| out + &format!("d9,{},{}\n", r * 7 % 20, r * r % 11));
    let days = text(dir.path(), "days.csv", &last);
    let args = [days.as_str(), "--x", "x", "--y", "y", "--by", "day", "--estimator", "gaussian"];
    let (code, _, err) = run(&args);
    let note = "note: left out: day = d0 … day = d8 (9 in all): 1 row with values in x, y, an estimate needs more: ";
    assert!(code == 0 && err.contains(note) && err.matches("left out").count() == 1, "{err}");
    let mut wide = (0..500).map(|c| format!("c{c}")).collect::<Vec<_>>().join(",");
    (0..3).for_each(|r| write!(wide, "\n{}", vec![r.to_string(); 500].join(",")).unwrap());
    let wide = PathBuf::from(text(dir.path(), "wide.csv", &wide));
    let error = all_pairs(&[wide], &TableOptions::default()).unwrap_err();
    assert!(error.is_usage());
    let said = "--all-pairs: 500 columns have 124750 pairs, more than 100000: name fewer with --x 'regex:…': ";
    assert!(error.to_string().starts_with(said), "{error}");
}

#[test]
fn integers_beyond_63_bits_are_compared_as_such() {
    let dir = tempfile::tempdir().unwrap();
    let big = |r: u64| u64::MAX - 20 + r;
    let rows: Vec<u64> = vec![3, 0, 2, 1, 4];
    let table = rows.iter().fold("t,x,y\n".to_owned(), |out, &r| out + &format!("{},{r},{r}\n", big(r)));
    let path = [PathBuf::from(text(dir.path(), "big.csv", &table))];
    let of = |x: &str, filter: Option<String>| {
        let filter = filter.map(|text| Predicate::parse(&text).unwrap());
        let (x, y, time) = (vec![x.to_owned()], vec!["y".to_owned()], Some("t".to_owned()));
        tables(&path, &TableOptions { x, y, time, filter, ..TableOptions::default() }).unwrap().0[0].x.data.clone()
    };
    assert_eq!(of("x", None), [0.0, 1.0, 2.0, 3.0, 4.0]);
    assert_eq!(of("t", None), [0.0, 1.0, 2.0, 3.0, 4.0]);
    assert_eq!(of("x", Some(format!("t > {}", big(2)))), [3.0, 4.0]);
}
