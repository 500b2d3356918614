//! Lags of tables with missing values and conditions, against a count of the rows by hand.

use std::fmt::Write as _;
use std::path::PathBuf;

use ccmarl::pairs::{Predicate, TableOptions, tables};
use ccmarl::rng::{Seeds, below};
use ccmarl::schema::Samples;
use proptest::prelude::*;

use super::estimate_mi::run;

fn options(group: Option<&str>, lags: &[usize], filter: Option<&str>) -> TableOptions {
    TableOptions {
        x: vec!["x".to_owned()],
        y: vec!["y".to_owned()],
        time: Some("t".to_owned()),
        group: group.map(str::to_owned),
        lags: lags.to_vec(),
        filter: filter.map(|text| Predicate::parse(text).unwrap()),
        ..TableOptions::default()
    }
}

fn pairs(set: &Samples) -> Vec<(f64, f64)> {
    set.rows.iter().map(|&r| (set.x.row(r as usize)[0], set.y.row(r as usize)[0])).collect()
}

/// One row: time, group, x and y, each of which may be missing.
type Row = (usize, usize, Option<f64>, Option<f64>);

fn table(rows: &[Row]) -> (tempfile::TempDir, PathBuf) {
    let cell = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
    let mut text = "t,g,x,y\n".to_owned();
    for &(t, g, x, y) in rows {
        writeln!(text, "{t},{g},{},{}", cell(x), cell(y)).unwrap();
    }
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.csv");
    ccmarl::io::write_atomic(path.as_ref(), text.as_bytes()).unwrap();
    (dir, path)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]
    #[test]
    fn rows_without_values_and_rows_refused_are_counted_but_not_used(seed in 0_u64..1000, grouped in any::<bool>()) {
        let mut rng = Seeds::new(seed).stream("lags");
        let mut rows: Vec<Row> = (0..60)
            .map(|t| {
                let mut value = |v: f64| (below(&mut rng, 5) > 0).then_some(v);
                (t, t % 3, value(t as f64), value(1000.0 + t as f64))
            })
            .collect();
        (1..rows.len()).for_each(|at| rows.swap(at, below(&mut rng, at + 1)));
        let (_dir, path) = table(&rows);
        let filter = "NOT t BETWEEN 20 AND 24 AND (t < 50 OR x IS NULL OR x <> 55)";
        let kept = |row: &Row| !(20..=24).contains(&row.0) && row.2 != Some(55.0);
        let group = grouped.then_some("g");
        let sets = tables(&[path], &options(group, &[0, 1, 4], Some(filter))).unwrap().0;
        prop_assert_eq!(sets.len(), 3);
        for (set, lag) in sets.iter().zip([0, 1, 4]) {
            let later = |row: &Row| rows.iter().find(|other| other.0 == row.0 + lag * if grouped { 3 } else { 1 });
            let mut expected: Vec<(f64, f64)> = Vec::new();
            for row in rows.iter().filter(|row| kept(row)) {
                if let Some((x, y)) = row.2.zip(later(row).filter(|row| kept(row)).and_then(|row| row.3)) {
                    expected.push((x, y));
                }
            }
            let mut found = pairs(set);
            expected.sort_by(|a, b| a.partial_cmp(b).unwrap());
            found.sort_by(|a, b| a.partial_cmp(b).unwrap());
            prop_assert_eq!(found, expected, "lag {}", lag);
            prop_assert!(set.x.data.iter().chain(&set.y.data).all(|v| !v.is_nan()));
            prop_assert!(!set.notes.iter().any(|note| note.contains("evenly")));
        }
    }
}

#[test]
fn complete_rows_keep_the_trajectories_and_lag_0_is_what_it_is_without_a_lag() {
    let rows: Vec<Row> = (0..9).map(|t| (t, t / 5, Some(t as f64), Some(100.0 + t as f64))).collect();
    let (_dir, path) = table(&rows);
    let sets = tables(std::slice::from_ref(&path), &options(Some("g"), &[0, 2], None)).unwrap().0;
    assert_eq!(pairs(&sets[1]), [(0.0, 102.0), (1.0, 103.0), (2.0, 104.0), (5.0, 107.0), (6.0, 108.0)]);
    assert_eq!((&*sets[1].starts, sets[1].x.rows(), sets[1].labels.y.as_str()), (&[0, 5, 9][..], 9, "y[+2]"));
    assert!(std::sync::Arc::ptr_eq(&sets[0].x, &sets[1].x));
    assert_eq!(sets[0], ccmarl::pairs::table(&path, &options(Some("g"), &[], None)).unwrap());
}

#[test]
fn what_is_left_out_and_uneven_times_are_told() {
    let rows: Vec<Row> = (0..8).map(|t| (t + t / 4, 0, (t != 2).then_some(t as f64), Some(t as f64))).collect();
    let (_dir, path) = table(&rows);
    let sets = tables(std::slice::from_ref(&path), &options(None, &[1, 2], None)).unwrap().0;
    assert_eq!(sets[0].notes[1], "note: t is not evenly spaced: lag 1 is the next row");
    assert_eq!(sets[1].notes[1], "note: t is not evenly spaced: lag 2 is 2 rows later");
    assert!(sets[0].notes[0].starts_with("1 of 7 pairs 1 rows apart left out: a missing value in x"), "{:?}", sets[0]);
    let path = path.to_str().unwrap();
    let (code, _, err) = run(&[path, "--x", "x", "--y", "y", "--time", "t", "--where", "t % 2 = 0", "--lag", "9"]);
    assert!(code == 1 && err.contains("no pair 9 rows apart: the longest episode has 8 rows"), "{err}");
    let rows: Vec<Row> = (0..8).map(|t| (t, 0, (t % 2 == 0).then_some(1.0), (t % 2 == 0).then_some(1.0))).collect();
    let (_dir, path) = table(&rows);
    let (code, _, err) = run(&[path.to_str().unwrap(), "--x", "x", "--y", "y", "--time", "t", "--lag", "1"]);
    assert!(code == 1 && err.contains("no pair 1 rows apart: all 7 have a missing value in x"), "{err}");
}
