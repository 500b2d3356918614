//! What is taken out of stores: tables of pairs, and summaries by shards.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use ccmarl::storage;
use polars::prelude::*;

/// Records a small tag store and gives its path.
fn recorded(folder: &Path, name: &str, episodes: u32) -> PathBuf {
    let path = folder.join(name);
    let episodes = episodes.to_string();
    let scenario = ["--scenario", "simple_tag", "--set", "steps=3", "--link", "dropout:0.3", "--seed", "5"];
    let output = run(&[&["record", "--episodes", &episodes, "--out", path.to_str().unwrap()], &scenario[..]].concat());
    assert!(output.status.success(), "{output:?}");
    path
}

fn run(arguments: &[&str]) -> Output {
    assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(arguments).output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn pairs_have_one_row_per_step_and_link_with_what_was_sent_and_done() {
    let folder = tempfile::tempdir().unwrap();
    let mut expected = Vec::new();
    for form in ["store", "store.mcap"] {
        let store = recorded(folder.path(), form, 20);
        let table = folder.path().join(format!("{form}.pairs.parquet"));
        let (store, out) = (store.to_str().unwrap(), table.to_str().unwrap());
        assert!(run(&["pairs", store, "--out", out]).status.success());
        let frame = ParquetReader::new(fs::File::open(&table).unwrap()).finish().unwrap();
        assert_eq!(
            (frame.height(), frame.get_column_names().iter().map(|n| n.as_str()).collect::<Vec<_>>().join(" ")),
            (20 * 3 * 6, COLUMNS.to_owned())
        );
        let text = |column: &str, row| frame.column(column).unwrap().str().unwrap().get(row).unwrap().to_owned();
        let floats = |column: &str, row| -> Vec<f32> {
            let values = frame.column(column).unwrap().array().unwrap().get_as_series(row).unwrap();
            values.f32().unwrap().into_no_null_iter().collect()
        };
        let mut source = storage::open(Path::new(store)).unwrap();
        let layout = source.manifest().layout();
        let mut row = 0;
        while let Some(episode) = source.next_episode().unwrap() {
            for step in 0..3 {
                for (sender, receiver) in layout.links() {
                    assert_eq!(frame.column("episode").unwrap().i64().unwrap().get(row), Some(episode.index as i64));
                    assert_eq!(frame.column("step").unwrap().i32().unwrap().get(row), Some(step as i32));
                    assert_eq!(text("sender", row), layout.agents[sender].name);
                    assert_eq!(text("receiver", row), layout.agents[receiver].name);
                    let delivered = episode.delivered(3, step, sender, receiver);
                    assert_eq!(frame.column("delivered").unwrap().bool().unwrap().get(row), Some(delivered));
                    assert_eq!(floats("message", row), episode.messages[sender].row(step));
                    assert_eq!(floats("action", row), episode.actions[receiver].row(step));
                    row += 1;
                }
            }
        }
        expected.push(fs::read(&table).unwrap());
    }
    assert_eq!(expected[0].len(), expected[1].len());
}

const COLUMNS: &str = "episode step sender receiver delivered message action";

#[test]
fn pairs_replace_only_what_ccmarl_wrote_and_need_links() {
    let folder = tempfile::tempdir().unwrap();
    let store = recorded(folder.path(), "store", 2);
    let (store, out) = (store.to_str().unwrap(), folder.path().join("pairs.parquet"));
    let pairs = |store: &str, more: &[&str]| run(&[&["pairs", store, "--out", out.to_str().unwrap()], more].concat());
    ccmarl::io::write_atomic(&out, b"somebody's thesis").unwrap();
    let refused = pairs(store, &["--force"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("refusing to replace what ccmarl did not make"), "{refused:?}");
    assert_eq!(fs::read(&out).unwrap(), b"somebody's thesis");
    fs::remove_file(&out).unwrap();
    assert!(pairs(store, &[]).status.success());
    let exists = pairs(store, &[]);
    assert_eq!((exists.status.code(), stderr(&exists).contains("give --force")), (Some(2), true));
    assert!(pairs(store, &["--force"]).status.success());
    let lonely = folder.path().join("lonely");
    let lonely = lonely.to_str().unwrap();
    assert!(run(&["record", "--scenario", "simple_spread:1", "--episodes", "1", "--out", lonely]).status.success());
    let none = pairs(lonely, &["--force"]);
    assert!(stderr(&none).contains("no links: expected two or more communicators"), "{none:?}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3, "nothing is left beside the outputs");
}

#[test]
fn shards_in_any_order_print_what_one_pass_prints_and_none_may_be_missing() {
    let folder = tempfile::tempdir().unwrap();
    // one form that passes over whole parts, one that cannot
    for (form, episodes) in [("store", 9001), ("store.mcap", 5)] {
        let store = recorded(folder.path(), form, episodes);
        let store = store.to_str().unwrap();
        let file = |i: usize| folder.path().join(format!("{form}.{i}.json")).to_str().unwrap().to_owned();
        let parts: Vec<String> = (0..7).map(file).collect();
        for (i, part) in parts.iter().enumerate() {
            let output = run(&["inspect", store, "--shard", &format!("{i}/7"), "--out", part]);
            assert!(output.status.success() && output.stdout.is_empty(), "{output:?}");
        }
        let merge = |order: &[usize]| {
            let files: Vec<&str> = order.iter().map(|&i| parts[i].as_str()).collect();
            run(&[&["inspect", "--format", "json", "--merge"], &files[..]].concat())
        };
        let one = run(&["inspect", store, "--format", "json"]);
        for order in [[0, 1, 2, 3, 4, 5, 6], [3, 6, 0, 2, 5, 1, 4]] {
            let merged = merge(&order);
            assert!(merged.status.success(), "{merged:?}");
            assert_eq!(String::from_utf8_lossy(&merged.stdout), String::from_utf8_lossy(&one.stdout));
        }
        for (order, fault) in [
            (&[0, 1, 2, 4, 5, 6][..], "shard 3/7 is missing"),
            (&[1, 2], "shard 0/7 is missing"),
            (&[0, 1, 2, 3, 4, 5], "shard 6/7 is missing"),
            (&[0, 1, 1, 2, 3, 4, 5, 6], "shard 1/7 is given twice"),
        ] {
            let refused = merge(order);
            assert_eq!((refused.status.code(), refused.stdout.is_empty()), (Some(2), true));
            assert!(stderr(&refused).contains(fault), "{refused:?}");
        }
    }
    let part = |form: &str, i| folder.path().join(format!("{form}.{i}.json")).to_str().unwrap().to_owned();
    let mixed = run(&["inspect", "--merge", &part("store", 0), &part("store.mcap", 1)]);
    assert!(stderr(&mixed).contains("parts of different stores"), "{mixed:?}");
    let other = folder.path().join("store/manifest.json");
    let foreign = run(&["inspect", "--merge", other.to_str().unwrap()]);
    assert_eq!(foreign.status.code(), Some(1));
    assert!(stderr(&foreign).contains("not a part of `inspect --shard`"), "{foreign:?}");
}
