//! `ccmarl estimate-mi` from outside, on tables; and the fixed tables' golden rows.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use polars::prelude::{Column, DataFrame, NamedFrom as _, ParquetReader, ParquetWriter, SerReader as _, Series};
use serde_json::Value;

pub(super) fn run(args: &[&str]) -> (i32, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    let output = command.env_remove("COLUMNS").arg("estimate-mi").args(args).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

fn json(args: &[&str]) -> Vec<Value> {
    let (code, out, err) = run(&[args, &["--format", "json"]].concat());
    assert_eq!(code, 0, "{err}");
    serde_json::from_str(&out).unwrap()
}

fn dataset(name: &str) -> String {
    format!("{}/datasets/{name}", env!("CARGO_MANIFEST_DIR"))
}

fn write(dir: &Path, name: &str, text: &str) -> String {
    let path = dir.join(name);
    ccmarl::io::write_atomic(&path, text.as_bytes()).unwrap();
    path.to_string_lossy().into_owned()
}

/// 60 rows: t, a, b = a + noise of period 7, g in three groups, s text, c constant.
fn csv(dir: &Path) -> String {
    let mut text = "t,a,b,g,s,c\n".to_owned();
    for i in 0..60 {
        let (a, noise) = (f64::from(i * 37 % 60), f64::from(i * i % 7));
        writeln!(text, "{i},{a},{},{},w{i},1", a + noise, i % 12).unwrap();
    }
    write(dir, "table.csv", &text)
}

#[test]
fn errors_name_the_remedy_and_have_the_right_exit_code() {
    let dir = tempfile::tempdir().unwrap();
    let table = csv(dir.path());
    let infinite = write(dir.path(), "inf.csv", "a,b\n1,2\n2,inf\n");
    let huge = write(dir.path(), "huge.csv", "a,b\n1,2\n2,3\n3,1e308\n");
    let hollow = write(dir.path(), "hollow.csv", "a,b\n1,\n,2\n");
    let empty = write(dir.path(), "empty.csv", "");
    let broken = write(dir.path(), "broken.parquet", "PAR1 and then nothing of the kind");
    let missing = dir.path().join("none.csv").to_string_lossy().into_owned();
    let there = write(dir.path(), "there.json", "kept");
    let cases: &[(i32, &[&str], &str)] = &[
        (2, &[&table, "--x", "aa", "--y", "b"], "no column \"aa\": "),
        (
            2,
            &[&table, "--x", "s", "--y", "b"],
            "s holds words, not numbers: name other columns, or take one of auto, discrete, ksg-mixed",
        ),
        (2, &[&table, "--given", "a"], "--x"),
        (
            2,
            &[&table, "--x", "a", "--y", "b", "--given", "g", "--estimator", "jsd"],
            "it estimates nothing given z: leave out --given, or take one of auto, discrete, gaussian, gcmi, infonce, ksg, ksg1, ksg-mixed",
        ),
        (
            1,
            &[&table, "--x", "a", "--y", "b", "--given", "a", "--estimator", "gaussian"],
            "what a leaves of a is constant, so it can tell nothing",
        ),
        (2, &[&table], "not a rollout store, and as a table it needs --x and --y"),
        (2, &[&table, "--x", "a"], "--y"),
        (2, &[&table, "--group", "g"], "--x"),
        (
            2,
            &[&table, "--x", "a", "--y", "b", "--estimator", "gausian"],
            "unknown estimator \"gausian\": did you mean gaussian?",
        ),
        (2, &[&table, "--x", "a", "--y", "b", "--estimator", "jsd:3"], "takes no value"),
        (2, &[&table, "--x", "a", "--y", "b", "--delivered"], "--delivered"),
        (2, &[&table, "--x", "a", "--y", "b", "--out", &there], "output exists: give --force"),
        (2, &[&table, "--x", "a", "--y", "b", "--out", &table, "--force"], "--out would replace the input"),
        (
            2,
            &[&table, "--x", "a", "--y", "b", "--out", "x.txt"],
            "expected a name that ends in .json, .csv or .parquet",
        ),
        (1, &[&table, "--x", "c", "--y", "b", "--estimator", "gaussian"], "c is constant, so it can tell nothing"),
        (
            1,
            &[&table, "--x", "a", "--y", "b", "--group", "c", "--estimator", "jsd"],
            "needs at least 10 episodes to split by episode",
        ),
        (1, &[&infinite, "--x", "a", "--y", "b"], "column \"b\", row 2: infinite or over 1e150"),
        (1, &[&huge, "--x", "a", "--y", "b"], "column \"b\", row 3: infinite or over 1e150"),
        (1, &[&hollow, "--x", "a", "--y", "b"], "no rows: all 2 rows have a missing value in a, b"),
        (1, &[&empty, "--x", "a", "--y", "b"], "not a readable CSV table"),
        (1, &[&broken, "--x", "a", "--y", "b"], "not a readable Parquet table"),
        (1, &[&broken], "not a readable Parquet table"),
        (1, &[&missing, "--x", "a", "--y", "b"], "no such file or directory"),
        (1, &[&missing], "no such file or directory"),
    ];
    for (code, args, message) in cases {
        let (found, out, err) = run(args);
        assert_eq!((found, out.as_str()), (*code, ""), "{args:?}: {err}");
        assert!(err.contains(message), "{args:?}: {err}");
        assert!(!err.contains("panicked"), "{args:?}: {err}");
    }
    assert_eq!(std::fs::read_to_string(there).unwrap(), "kept");
}

#[test]
fn groups_series_and_rows_are_named_in_the_output() {
    let dir = tempfile::tempdir().unwrap();
    let table = csv(dir.path());
    let base = [table.as_str(), "--x", "a", "--y", "b", "--estimator", "gaussian"];
    for (more, group) in [(&[][..], "row"), (&["--group", "g"], "g"), (&["--time", "t"], "blocks of t")] {
        let rows = json(&[&base, more].concat());
        assert_eq!((&rows[0]["group"], &rows[0]["n"]), (&group.into(), &60.into()));
    }
    let (_, out, _) = run(&base);
    assert!(out.contains("each row was taken as independent; give --group or --time"), "{out}");
    assert!(out.contains("a ; b") && out.contains("gaussian"), "{out}");
    let (_, out, _) = run(&[&base[..], &["--group", "g"]].concat());
    assert!(!out.contains("each row was taken"), "{out}");
}

#[test]
fn lags_patterns_and_all_pairs_of_any_separator() {
    let dir = tempfile::tempdir().unwrap();
    // y follows x three rows later
    let mut rng = ccmarl::rng::Seeds::new(1).stream("lag");
    let series: Vec<f64> = (0..400).map(|_| ccmarl::rng::normal(&mut rng)).collect();
    let mut text = "t\tobs_a\tobs_b\ty\tg\tw\n".to_owned();
    for t in 0..400 {
        let later = if t >= 3 { series[t - 3] } else { 0.0 } + 0.3 * ccmarl::rng::normal(&mut rng);
        let g = t / 20;
        writeln!(text, "{t}\t{}\t{}\t{later}\t{g}\t{}", series[t], ccmarl::rng::normal(&mut rng), ["u", "v"][t % 2])
            .unwrap();
    }
    let table = write(dir.path(), "series.tsv", &text);
    for key in [["--time", "t"], ["--group", "g"]] {
        let args = [table.as_str(), "--x", "obs_a", "--y", "y", "--lag", "0..4", "--estimator", "gaussian"];
        let rows = json(&[&args[..], &key].concat());
        let values: Vec<f64> = rows.iter().map(|r| r["value"].as_f64().unwrap()).collect();
        assert_eq!(
            rows.iter().map(|r| r["y"].as_str().unwrap()).collect::<Vec<_>>(),
            ["y", "y[+1]", "y[+2]", "y[+3]", "y[+4]"]
        );
        // −½ ln(1 − 1/1.09)
        assert!(
            (values[3] - 1.245).abs() < 0.1 && values.iter().enumerate().all(|(i, v)| i == 3 || *v < 0.05),
            "{values:?}"
        );
        let left = if key[0] == "--time" { 397 } else { 20 * 17 };
        assert_eq!(rows[3]["n"], left);
    }
    let (_, out, _) =
        run(&[&table, "--x", "obs_a", "--y", "y", "--time", "t", "--lag", "0,3", "--estimator", "gaussian"]);
    assert!(out.contains("obs_a ; y[+3]"), "{out}");
    let rows = json(&[&table, "--x", "regex:^obs_", "--y", "y", "--estimator", "gaussian"]);
    assert_eq!(rows[0]["x"], "obs_a,obs_b");
    let plot = dir.path().join("pairs.svg").to_string_lossy().into_owned();
    let all = [table.as_str(), "--all-pairs", "--group", "g", "--estimator", "gcmi,discrete", "--permutations", "0"];
    let rows = json(&[&all[..], &["--plot", &plot]].concat());
    let of = |name: &str| rows.iter().filter(|r| r["estimator"] == name).count();
    // t, obs_a, obs_b, y, w: ten pairs, six of them without words
    assert_eq!((of("gcmi"), of("discrete"), of("discrete-mm")), (6, 10, 10));
    let svg = std::fs::read_to_string(&plot).unwrap();
    assert!(svg.contains("obs_b") && svg.contains("column") && !svg.contains("receiver"));
    let (code, _, err) = run(&[&all[..], &["--plot", &plot]].concat());
    assert!(code == 2 && err.contains("output exists: give --force"), "{err}");
    for (code, args, message) in [
        (2, &["--x", "regex:^zzz", "--y", "y"][..], "\"^zzz\": matches no column; the columns are t, obs_a"),
        (2, &["--x", "regex:(", "--y", "y"], "\"(\": not a regular expression"),
        (2, &["--x", "obs_a"], "--x needs --y, or --all-pairs"),
        (2, &["--x", "obs_a", "--y", "y", "--lag", "5..2"], "expected 3, 0,1,5 or 0..10"),
        (1, &["--x", "obs_a", "--y", "y", "--lag", "1"], "no pair 1 rows apart: the longest episode has 1 rows"),
        (1, &["--all-pairs", "--x", "y"], "--all-pairs needs two columns of numbers or words, found 1"),
        (2, &["--all-pairs", "--plot", "x.pdf"], "expected a name that ends in .svg or .png"),
    ] {
        let (found, out, err) = run(&[&[table.as_str()], args].concat());
        assert_eq!((found, out.as_str()), (code, ""), "{args:?}: {err}");
        assert!(err.contains(message), "{args:?}: {err}");
    }
}

#[test]
fn a_lag_that_a_rare_class_cannot_have_leaves_only_that_class_out() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("store").to_string_lossy().into_owned();
    let record = ["record", "--scenario", "simple_spread", "--link", "dropout:0.005", "--episodes", "12"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    assert!(command.args(record).args(["--out", &store]).output().unwrap().status.success());
    let args = [store.as_str(), "--estimator", "gaussian", "--permutations", "0", "--format", "json"];
    let (code, out, err) = run(&[&args[..], &["--lag", "22"]].concat());
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("[+22]") && err.contains(" lost left out: no pair 22 rows apart: "), "{err}");
    assert!(err.contains(" samples has so many after it; give a smaller --lag"), "{err}");
    let (code, out, err) = run(&[&args[..], &["--lag", "25"]].concat());
    assert!(code == 1 && out.is_empty() && err.contains("no pair 25 rows apart: the longest episode has 2"), "{err}");
    assert!(!err.contains("--time"), "{err}");
}

#[test]
fn all_pairs_leaves_out_what_is_empty_and_fails_only_when_nothing_is_left() {
    let dir = tempfile::tempdir().unwrap();
    let mut text = "a,b,c,d,none\n".to_owned();
    for i in 0..60 {
        let (c, d) =
            if i % 2 == 0 { ((i % 9).to_string(), String::new()) } else { (String::new(), (i % 8).to_string()) };
        writeln!(text, "{i},{},{c},{d},", i * i % 11).unwrap();
    }
    let table = write(dir.path(), "gaps.csv", &text);
    let args = [table.as_str(), "--all-pairs", "--estimator", "gaussian", "--permutations", "0", "--format", "csv"];
    let (code, out, err) = run(&args);
    assert_eq!((code, out.lines().count()), (0, 1 + 5), "{err}");
    assert!(err.contains("note: left out: column \"none\" is empty"), "{err}");
    assert!(err.contains("note: left out: no rows: all 60 rows have a missing value in c, d: "), "{err}");
    let (code, out, err) = run(&[&args[..], &["--x", "c,d"]].concat());
    assert!(code == 1 && out.is_empty() && err.contains("no rows: all 60 rows have a missing value in c, d"), "{err}");
    let (code, _, err) = run(&[&args[..], &["--x", "a,none"]].concat());
    assert!(code == 1 && err.contains("no rows: all 60 rows have a missing value in a, none"), "{err}");
}

#[test]
fn a_picture_never_takes_the_results_away() {
    let dir = tempfile::tempdir().unwrap();
    let mut text = "a,b\n".to_owned();
    (0..60).for_each(|i| writeln!(text, "{i},{i}").unwrap());
    let table = write(dir.path(), "copy.csv", &text);
    let at = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let args = [table.as_str(), "--all-pairs", "--estimator", "gaussian", "--permutations", "0"];
    // a copy has infinite information, which has no colour
    let (code, out, err) = run(&[&args[..], &["--plot", &at("copy.svg")]].concat());
    assert!(code == 0 && out.contains("infinite (copy)"), "{code}: {out}{err}");
    assert!(err.contains("note: no finite value to draw: ") && !dir.path().join("copy.svg").exists(), "{err}");
    let other = csv(dir.path());
    let args = [other.as_str(), "--all-pairs", "--x", "a,b", "--estimator", "gaussian", "--permutations", "0"];
    for name in ["new/deep/pairs.png", "newer/pairs.svg"] {
        let (code, _, err) = run(&[&args[..], &["--plot", &at(name)]].concat());
        assert!(code == 0 && dir.path().join(name).exists(), "{err}");
    }
    let (code, _, err) = run(&[&args[..], &["--plot", &at("newer/pairs.svg")]].concat());
    assert!(code == 2 && err.contains("give --force to replace it, or another --plot: "), "{code}: {err}");
    ccmarl::io::write_atomic(at("mine.svg").as_ref(), b"mine").unwrap();
    let (code, _, err) = run(&[&args[..], &["--force", "--plot", &at("mine.svg")]].concat());
    assert!(code == 1 && err.contains("remove it by hand, or give another --plot: "), "{code}: {err}");
    let (code, out, err) = run(&[&args[..], &["--plot", &format!("{other}/pairs.png")]].concat());
    assert!(code == 1 && out.contains("a ; b") && err.contains("could not create the directory"), "{code}: {out}{err}");
    // one cell would stand for several lags
    for (more, message) in [
        (&["--lag", "0,1", "--time", "t"][..], "--plot of --all-pairs draws one lag: name one pair"),
        (&["--lag", "1", "--time", "t"], "--plot of --all-pairs is for columns at the same time"),
    ] {
        let (code, out, err) = run(&[&args[..], more, &["--plot", &at("lags.svg")]].concat());
        assert!(code == 2 && out.is_empty() && err.contains(message), "{code}: {err}");
    }
}

#[test]
fn a_pair_and_lags_have_pictures_with_names_escaped_and_the_values_stay_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let mut rng = ccmarl::rng::Seeds::new(4).stream("pair");
    let mut text = "t,<b>&a,y,word\n".to_owned();
    for t in 0..300 {
        let x = ccmarl::rng::normal(&mut rng);
        writeln!(text, "{t},{x},{},{}", x + ccmarl::rng::normal(&mut rng), ["u", "<v>"][t % 2]).unwrap();
    }
    let table = write(dir.path(), "pair.csv", &text);
    let at = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let base = [table.as_str(), "--x", "<b>&a", "--y", "y", "--time", "t", "--permutations", "9", "--format", "json"];
    let pair = [&base[..], &["--estimator", "infonce,gaussian,club"]].concat();
    let (_, plain, _) = run(&pair);
    for name in ["pair.svg", "pair.png"] {
        let (code, out, err) = run(&[&pair[..], &["--plot", &at(name)]].concat());
        assert_eq!((code, &out), (0, &plain), "{err}");
        assert!(err.contains("drew 300 of 300 samples and their estimates: "), "{err}");
    }
    let svg = std::fs::read_to_string(at("pair.svg")).unwrap();
    assert!(svg.contains("&lt;b&gt;&amp;a") && !svg.contains("<b>"), "escaped");
    for words in ["training of infonce", "training of club", "infonce by number of samples", "300", "gaussian"] {
        assert!(svg.contains(&format!("\n{words}\n")), "{words}");
    }
    let (code, _, err) =
        run(&[&base[..], &["--lag", "0..3", "--estimator", "gaussian", "--plot", &at("lag.svg")]].concat());
    assert!(code == 0 && err.contains("drew 1 lines over lags: "), "{err}");
    assert!(std::fs::read_to_string(at("lag.svg")).unwrap().contains("&lt;b&gt;&amp;a ; y by lag"));
    // what cannot take the samples is left out of the picture, as of the rows
    let words = [table.as_str(), "--x", "word", "--y", "y", "--permutations", "0", "--estimator", "infonce,discrete"];
    let (code, _, err) = run(&[&words[..], &["--plot", &at("word.svg")]].concat());
    let svg = std::fs::read_to_string(at("word.svg")).unwrap();
    assert!(code == 0 && svg.contains("discrete by number of samples") && !svg.contains("training of"), "{err}");
    assert!(svg.contains("word (words in order, spread)"));
}

#[test]
fn a_table_that_memory_does_not_hold_is_read_once_and_says_what_was_estimated_how() {
    let dir = tempfile::tempdir().unwrap();
    let mut rng = ccmarl::rng::Seeds::new(5).stream("large");
    let mut text = "a,b,g,w,k\n".to_owned();
    for row in 0..3000 {
        let a = ccmarl::rng::normal(&mut rng);
        let b = a + ccmarl::rng::normal(&mut rng);
        let b = if row % 10 == 0 { String::new() } else { b.to_string() };
        writeln!(text, "{a},{b},{},{},{}", row / 100, if a > 0.0 { "up" } else { "down" }, row % 3).unwrap();
    }
    let table = write(dir.path(), "large.csv", &text);
    let base = [table.as_str(), "--x", "a", "--y", "b", "--estimator", "gaussian,ksg", "--permutations", "9"];
    let (whole, large) = (json(&base), json(&[&base[..], &["--memory", "0"]].concat()));
    let value = |row: &Value| row["value"].as_f64().unwrap();
    let text_of = |row: &Value| row["warnings"].to_string();
    assert!((value(&whole[0]) - value(&large[0])).abs() < 1e-10);
    assert_eq!((&large[0]["n"], &large[1]["n"]), (&2700.into(), &2700.into()));
    assert!(text_of(&large[0]).contains("note: all rows in one pass"), "{large:?}");
    assert!(text_of(&large[0]).contains("300 of 3000 rows left out: a missing value in a, b"), "{large:?}");
    // no more rows than the sample would have: all of them
    assert_eq!(value(&whole[1]), value(&large[1]));
    let few = json(&[&base[..], &["--sample", "500"]].concat());
    assert!(few.iter().all(|row| text_of(row).contains("note: estimated on 500 of 3000 rows, drawn at random")));
    assert!(few.iter().all(|row| (400..500).contains(&row["n"].as_u64().unwrap())), "{few:?}");
    assert_eq!(few, json(&[&base[..], &["--sample", "500", "--threads", "1"]].concat()));
    // words are counted; given, group and all pairs
    let counted = [&base[..1], &["--x", "w", "--y", "k", "--given", "g", "--estimator", "discrete,gaussian"]].concat();
    let (code, out, err) = run(&[&counted[..], &["--memory", "0", "--format", "csv"]].concat());
    assert!(code == 0 && out.contains("\ndiscrete,w,k,g,"), "{err}");
    assert!(err.contains("warning: no gaussian for w ; k | g: w holds words, not numbers"), "{err}");
    for more in [&["--group", "g"][..], &["--time", "k"]] {
        let rows = json(&[&base[..], &["--memory", "0"], more].concat());
        assert!(rows[0]["group"].as_str().unwrap() != "row" && !text_of(&rows[0]).contains("one pass"), "{rows:?}");
    }
    let pairs =
        json(&[&base[..1], &["--all-pairs", "--memory", "0", "--estimator", "gcmi", "--permutations", "0"]].concat());
    assert_eq!(pairs.len(), 6);
    let plot = dir.path().join("large.svg").to_string_lossy().into_owned();
    let (code, _, err) = run(&[&base[..], &["--memory", "0", "--plot", &plot]].concat());
    assert!(code == 0 && std::fs::read_to_string(plot).unwrap().contains("2000 points"), "{err}");
    // a first line that is blank, with either line end, is none in pieces either
    for blank in ["\n", "\r\n", "\n\n"] {
        let table = write(dir.path(), "blank.csv", &format!("{blank}{text}"));
        let args = [&[table.as_str()], &base[1..]].concat();
        let rows = [&args[..], &[&args[..], &["--memory", "0"]].concat()].map(json);
        assert_eq!([value(&rows[0][0]), value(&rows[1][1])], [value(&whole[0]), value(&whole[1])], "{blank:?}");
    }
    // who needs no words reads no more of them
    let mut words = String::new();
    for row in 0..40_000 {
        writeln!(words, "w{row},1").unwrap();
    }
    let many = write(dir.path(), "many.csv", &format!("a,b\n{words}"));
    let (code, _, err) = run(&[many.as_str(), "--x", "a", "--y", "b", "--estimator", "gaussian", "--memory", "0"]);
    assert!(code == 2 && err.contains("a holds words"), "{code}: {err}");
    for (code, args, message) in [
        (
            2,
            &["--memory", "0", "--lag", "1"][..],
            "--lag needs the rows in memory, and the table is larger than --memory",
        ),
        (2, &["--sample", "500", "--lag", "1"], "--lag needs neighbouring rows, which --sample takes apart"),
        (2, &["--sample", "5"], "5 is not in 10.."),
        (2, &["--memory", "0", "--given", "zz"], "no column \"zz\""),
    ] {
        let (found, out, err) = run(&[&base[..], args].concat());
        assert!(found == code && out.is_empty() && err.contains(message), "{args:?}: {err}");
    }
}

#[test]
fn missing_values_are_counted_copies_are_infinite_and_strict_fails_on_warnings() {
    let dir = tempfile::tempdir().unwrap();
    let mut text = "a,b,d\n,1,1\n2,NaN,3\n".to_owned();
    for i in 0..40 {
        writeln!(text, "{i}.5,{},{}", i * i % 11, 2 * i).unwrap();
    }
    let table = write(dir.path(), "gaps.csv", &text);
    let rows = json(&[&table, "--x", "a", "--y", "b", "--estimator", "gaussian"]);
    assert_eq!(
        (&rows[0]["n"], &rows[0]["warnings"][0]),
        (&40.into(), &"2 of 42 rows left out: a missing value in a, b".into())
    );
    let copy = [table.as_str(), "--x", "a", "--y", "d", "--estimator", "gaussian"];
    assert!(json(&copy)[0]["value"].is_null());
    let (code, out, err) = run(&[&copy[..], &["--strict"]].concat());
    assert_eq!(code, 1, "{err}");
    assert!(out.contains("infinite (copy)") && err.contains("carry warnings, and --strict was given"), "{out}{err}");
}

#[test]
fn parquet_with_vectors_and_nulls_reads_as_its_columns_and_the_three_outputs_agree() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.parquet");
    let n = 50_usize;
    let a: Vec<Option<f32>> = (0..n).map(|i| (i != 3).then_some((i * 7 % n) as f32)).collect();
    let b: Vec<bool> = (0..n).map(|i| i * 7 % n > 20).collect();
    let inner: Vec<Series> = (0..n).map(|i| Series::new("".into(), [(i * 7 % n) as f64, (i % 5) as f64])).collect();
    let columns = vec![Column::new("a".into(), a), Column::new("b".into(), b), Column::new("v".into(), inner)];
    let mut frame = DataFrame::new(n, columns).unwrap();
    ParquetWriter::new(std::fs::File::create(&path).unwrap()).finish(&mut frame).unwrap();
    let file = path.to_string_lossy().into_owned();
    let out = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let args = [file.as_str(), "--x", "a", "--y", "v,b", "--estimator", "gaussian"];
    let rows = json(&args);
    assert_eq!((&rows[0]["n"], &rows[0]["y"]), (&49.into(), &"v,b".into()));
    for (form, name) in [("json", "r.json"), ("csv", "r.csv"), ("parquet", "r.parquet")] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
        let output =
            command.arg("estimate-mi").args(args).args(["--format", form, "--out", &out(name)]).output().unwrap();
        assert_eq!(output.stdout, std::fs::read(out(name)).unwrap(), "{form}");
    }
    for name in ["s.json", "s.csv", "s.parquet"] {
        let (code, _, err) = run(&[&args[..], &["--out", &out(name)]].concat());
        assert_eq!(code, 0, "{err}");
    }
    let written: Vec<Value> = serde_json::from_slice(&std::fs::read(out("r.json")).unwrap()).unwrap();
    assert_eq!(written, rows);
    let keys = rows[0].as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    let csv = std::fs::read_to_string(out("r.csv")).unwrap();
    assert_eq!(csv.lines().next().unwrap(), keys.join(","));
    let frame = ParquetReader::new(std::fs::File::open(PathBuf::from(out("r.parquet"))).unwrap()).finish().unwrap();
    assert_eq!(frame.get_column_names().iter().map(ToString::to_string).collect::<Vec<_>>(), keys);
    assert_eq!(frame.height(), 1);
}

#[test]
fn a_damaged_parquet_file_is_an_error_and_never_a_panic() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.parquet");
    let a: Vec<f64> = (0..64).map(|i| f64::from(i * 7 % 64)).collect();
    let mut frame = DataFrame::new(64, vec![Column::new("a".into(), &a), Column::new("b".into(), &a)]).unwrap();
    let mut bytes = Vec::new();
    ParquetWriter::new(&mut bytes).finish(&mut frame).unwrap();
    let options =
        ccmarl::pairs::TableOptions { x: vec!["a".to_owned()], y: vec!["b".to_owned()], ..Default::default() };
    let footer = u32::from_le_bytes(bytes[bytes.len() - 8..bytes.len() - 4].try_into().unwrap()) as usize;
    for at in (bytes.len() - 8 - footer..bytes.len()).step_by(7) {
        let mut changed = bytes.clone();
        changed[at] ^= 0x55;
        ccmarl::io::write_atomic(&path, &changed).unwrap();
        // some flips change a name or a statistic that nobody reads; whatever comes back, it comes back
        drop(ccmarl::pairs::table(&path, &options));
        ccmarl::io::write_atomic(&path, &bytes[..at]).unwrap();
        assert!(ccmarl::pairs::table(&path, &options).is_err(), "truncated to {at} bytes");
    }
}

/// A copy of a fixed table with each text column coded by the sorted rank of its values.
fn coded(name: &str, dir: &Path) -> String {
    let text = std::fs::read_to_string(dataset(&format!("tables/{name}.csv"))).unwrap();
    let rows: Vec<Vec<&str>> = text.lines().map(|line| line.split(',').collect()).collect();
    let mut columns: Vec<Vec<String>> = Vec::new();
    for c in 0..rows[0].len() {
        let values: Vec<&str> = rows[1..].iter().map(|row| row[c]).collect();
        let mut levels = values.clone();
        levels.sort_unstable();
        levels.dedup();
        let rank = |v: &str| levels.iter().position(|l| *l == v).unwrap().to_string();
        let numeric = values.iter().all(|v| v.parse::<f64>().is_ok());
        columns.push(values.iter().map(|v| if numeric { (*v).to_owned() } else { rank(v) }).collect());
    }
    let mut out = rows[0].join(",") + "\n";
    for r in 0..rows.len() - 1 {
        out += &(columns.iter().map(|c| c[r].as_str()).collect::<Vec<_>>().join(",") + "\n");
    }
    let path = dir.join(format!("{name}.csv"));
    ccmarl::io::write_atomic(&path, out.as_bytes()).unwrap();
    path.to_string_lossy().into_owned()
}

#[test]
fn the_fixed_tables_give_their_golden_rows() {
    // gaussian is exact; trained estimators follow the CPU's kernels, so they are held to 1e-3
    let dir = tempfile::tempdir().unwrap();
    let cases: [(&str, &[&str]); 4] = [
        ("iris", &["--x", "petal_length", "--y", "petal_width"]),
        ("iris-sepal", &["--x", "sepal_length,sepal_width", "--y", "petal_length,petal_width"]),
        ("titanic", &["--x", "sex,class", "--y", "survived"]),
        ("playtennis", &["--x", "humidity", "--y", "play", "--estimator", "gaussian"]),
    ];
    for (case, args) in cases {
        let table = coded(case.split('-').next().unwrap(), dir.path());
        let found = json(&[&[table.as_str()], args].concat());
        let golden_path = dataset(&format!("tables/{case}.mi.json"));
        if std::env::var_os("CCMARL_MAKE_GOLDEN").is_some() {
            let text = serde_json::to_string_pretty(&found).unwrap() + "\n";
            ccmarl::io::write_atomic(Path::new(&golden_path), text.as_bytes()).unwrap();
        }
        let golden: Vec<Value> = serde_json::from_slice(&std::fs::read(golden_path).unwrap()).unwrap();
        assert_eq!(found.len(), golden.len(), "{case}");
        for (found, golden) in found.iter().zip(&golden) {
            assert_golden(case, found, golden);
        }
    }
    // fourteen days are too few to train on: said, not guessed
    let (code, _, err) =
        run(&[&coded("playtennis", dir.path()), "--x", "humidity", "--y", "play", "--estimator", "jsd"]);
    assert!(code == 1 && err.contains("needs at least"), "{code}: {err}");
}

#[test]
fn categories_have_their_exact_information() {
    // datasets/tables/README.md, recomputed there by its make.py
    let dir = tempfile::tempdir().unwrap();
    let tables = [dataset("tables/playtennis.csv"), coded("titanic", dir.path())];
    let cases = [
        (0, "outlook", "play", 0.246750),
        (0, "humidity", "play", 0.151836),
        (0, "wind", "play", 0.048127),
        (0, "temperature", "play", 0.029223),
        (1, "sex", "survived", 0.142391),
        (1, "class", "survived", 0.059288),
        (1, "age", "survived", 0.006411),
        (1, "class,age,sex", "survived", 0.220226),
    ];
    let given =
        [&tables[1], "--x", "class", "--y", "survived", "--given", "sex", "--estimator", "discrete", "--unit", "bits"];
    let rows = json(&given);
    assert!((rows[0]["value"].as_f64().unwrap() - 0.056126).abs() < 5e-7, "{}", rows[0]);
    assert_eq!((&rows[0]["given"], &rows[0]["unit"]), (&"sex".into(), &"bits".into()));
    let (_, out, _) = run(&given);
    assert!(out.contains("class ; survived | sex") && out.contains("bits"), "{out}");
    for (table, x, y, bits) in cases {
        let rows = json(&[&tables[table], "--x", x, "--y", y, "--estimator", "discrete", "--permutations", "0"]);
        let value = rows[0]["value"].as_f64().unwrap();
        assert!((value / std::f64::consts::LN_2 - bits).abs() < 5e-7, "{x}: {value} nats against {bits} bits");
        assert_eq!((&rows[0]["estimator"], &rows[1]["estimator"]), (&"discrete".into(), &"discrete-mm".into()));
    }
}

#[test]
fn nearest_neighbours_and_ranks_read_the_flowers() {
    let dir = tempfile::tempdir().unwrap();
    let table = coded("iris", dir.path());
    let value = |x: &str, y: &str, estimator: &str| {
        json(&[&table, "--x", x, "--y", y, "--estimator", estimator])[0]["value"].as_f64().unwrap()
    };
    // the authors' code (mixed_KSG with scipy's cKDTree) on the same standardised columns
    for (x, y, expected) in [
        ("petal_length", "species", 1.127144814761),
        ("petal_width", "species", 1.043073739296),
        ("sepal_length", "species", 0.725989925237),
        ("sepal_width", "species", 0.354164018143),
        ("petal_length", "petal_width", 1.551540715939),
    ] {
        let found = value(x, y, "ksg-mixed");
        assert!((found - expected).abs() < 1e-7, "{x}: {found} against {expected}");
    }
    assert!((value("petal_length", "petal_width", "gcmi") - 1.0).abs() < 0.3);
    // words are as far apart as codes that are far apart
    let words =
        json(&[&dataset("tables/iris.csv"), "--x", "petal_width", "--y", "species", "--estimator", "ksg-mixed"]);
    let found = words[0]["value"].as_f64().unwrap();
    assert!((found - 1.04).abs() < 0.1 && words[0]["warnings"][0].is_null(), "{}", words[0]);
    let (code, out, err) = run(&[&table, "--x", "petal_length", "--y", "petal_width", "--estimator", "ksg,ksg2:5"]);
    assert_eq!(code, 0, "{err}");
    assert!(
        out.contains("ksg1:3") && out.contains("ksg2:5") && out.contains("ksg-mixed and discrete are made for such"),
        "{out}"
    );
}

#[test]
fn auto_says_why_and_its_note_is_no_warning() {
    let dir = tempfile::tempdir().unwrap();
    let mut rng = ccmarl::rng::Seeds::new(4).stream("auto");
    let mut text = "a,b\n".to_owned();
    for _ in 0..600 {
        let a = ccmarl::rng::normal(&mut rng);
        writeln!(text, "{a},{}", a + ccmarl::rng::normal(&mut rng)).unwrap();
    }
    let table = write(dir.path(), "normal.csv", &text);
    let args = [table.as_str(), "--x", "a", "--y", "b", "--estimator", "auto", "--strict", "--permutations", "39"];
    let (code, out, err) = run(&args);
    assert_eq!(code, 0, "{out}{err}");
    assert!(
        out.contains("\nnote: ") && out.contains(" chosen: 2 continuous columns, 600 samples, the largest of gcmi"),
        "{out}"
    );
    let words = run(&[&dataset("tables/titanic.csv"), "--x", "sex", "--y", "survived", "--estimator", "auto"]).1;
    assert!(words.contains("note: discrete-mm chosen: sex and survived take few values"), "{words}");
}

#[test]
fn calibrate_prints_errors_and_refuses_unknown_tasks() {
    let calibrate = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
        let output = command.env_remove("COLUMNS").arg("calibrate").args(args).output().unwrap();
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
    };
    let args = ["--estimator", "gaussian,ksg", "--n", "500", "--seeds", "2", "--task", "dense-2-2,1v1-normal"];
    let (code, out, err) = calibrate(&args);
    assert_eq!(code, 0, "{err}");
    assert!(
        out.contains("multinormal-dense-2-2-0.5") && out.contains("0.2939") && out.contains("over all tasks"),
        "{out}"
    );
    let (_, json, _) = calibrate(&[&args[..], &["--format", "json"]].concat());
    let found: Value = serde_json::from_str(&json).unwrap();
    // 1v1-normal and its CDF twin, its wiggly and half-cube ones, and the dense one
    assert_eq!((found["tasks"].as_array().unwrap().len(), found["total"][0]["tasks"].as_u64()), (12, Some(6)));
    assert_eq!(found["checks"].as_array().unwrap().len(), 0);
    let (code, _, err) = calibrate(&["--task", "zzz"]);
    assert!(code == 2 && err.contains("no task contains zzz; the tasks are 1v1-normal-0.75"), "{err}");
    let (code, _, err) = calibrate(&["--task", "none"]);
    assert!(code == 2 && err.contains("--task none leaves only checks: give --checks a number"), "{err}");
    let (code, _, err) = calibrate(&["--task", "none", "--checks", "1", "--plot", "x.svg"]);
    assert!(code == 2 && err.contains("--plot draws tasks: leave out --task none"), "{err}");

    // checks: intervals of six, p-values of six; a file and a picture, which only ours replace
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).display().to_string();
    let (table, picture) = (at("rows.csv"), at("errors.svg"));
    let args = [&args[..], &["--checks", "3", "--out", &table, "--plot", &picture]].concat();
    let (code, out, err) = calibrate(&args);
    assert_eq!(code, 0, "{err}");
    for words in ["check", "p ≤ 0.05", "normal-2-2-0.75", "series-0.98-0.3"] {
        assert!(out.contains(words), "{words}: {out}");
    }
    let rows = std::fs::read_to_string(&table).unwrap();
    assert!(rows.starts_with("task,truth,estimator,kind,seeds,mean,deviation,error,covered,rejected\n"), "{rows}");
    // twelve of tasks and twenty-four of checks
    assert_eq!(rows.lines().count(), 1 + 12 + 24);
    assert!(std::fs::read_to_string(&picture).unwrap().contains("multinormal-dense-2-2-0.5"));
    let (code, _, err) = calibrate(&args);
    assert!(code == 2 && err.contains("output exists: give --force to replace it"), "{err}");
    assert_eq!(calibrate(&[&args[..], &["--force"]].concat()).0, 0);
    ccmarl::io::write_atomic(table.as_ref(), b"mine\n").unwrap();
    let (code, _, err) = calibrate(&[&args[..], &["--force"]].concat());
    assert!(code != 0 && std::fs::read_to_string(&table).unwrap() == "mine\n", "{err}");
    // no task has a value, and the checks have: they are shown, and there is nothing to draw
    let few = ["--estimator", "gaussian", "--n", "10", "--seeds", "1", "--task", "dense-25-25", "--checks", "2"];
    let (code, out, err) = calibrate(&[&few[..], &["--plot", &at("none.svg")]].concat());
    assert!(code == 0 && out.contains("normal-2-2-0.75"), "{err}");
    assert!(err.contains("note: no value of a task to draw: ") && !Path::new(&at("none.svg")).exists());
    let (code, _, err) = calibrate(&["--out", "rows.txt"]);
    assert!(code == 2 && err.contains("expected a name that ends in .json, .csv or .parquet"), "{err}");
}

fn assert_golden(case: &str, found: &Value, golden: &Value) {
    let name = golden["estimator"].as_str().unwrap();
    let tolerance = if name == "gaussian" { 1e-6 } else { 1e-3 };
    for (key, expected) in golden.as_object().unwrap() {
        match expected.as_f64() {
            Some(expected) if key != "p_value" || name == "gaussian" => {
                let value = found[key].as_f64().unwrap();
                let allowed = if key == "n_effective" { 1e-2 * expected } else { tolerance * expected.abs().max(1.0) };
                assert!((value - expected).abs() <= allowed, "{case} {name} {key}: {value} against {expected}");
            }
            Some(_) => {}
            None => assert_eq!(&found[key], expected, "{case} {name} {key}"),
        }
    }
}

#[test]
fn help_shows_examples() {
    let (code, out, _) = run(&["--help"]);
    assert_eq!(code, 0);
    for part in ["ccmarl estimate-mi data/tag", "--group", "--time", "--strict", "delivered and lost apart"] {
        assert!(out.contains(part), "{part}");
    }
}
