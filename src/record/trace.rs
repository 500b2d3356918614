//! Recorded link bits for the `trace` link: from a store, or from a table of (episode, step, sender, receiver,
//! delivered).

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use polars::prelude::{Column, CsvReadOptions, DataFrame, DataType, ParquetReader, PolarsResult, SerReader as _};

use crate::io::IoError;
use crate::link::Trace;
use crate::registry::{RegistryError, did_you_mean};
use crate::storage::{self, EpisodeSource, TableForm};

/// Columns of a table of link bits.
const COLUMNS: [&str; 5] = ["episode", "step", "sender", "receiver", "delivered"];

/// The form whose columns have types.
const PARQUET: &str = "Parquet";

/// Most agents in a table: there are as many links as their square.
const MAX_AGENTS: u32 = 4096;

/// Reads the link bits of a rollout store, or of a CSV, TSV or Parquet table with the columns `episode`, `step`, `sender`,
/// `receiver` and `delivered` (true, false, 1 or 0). Episodes and steps count from 0 without gaps; every ordered pair of
/// the agents has one row in each; rows may stand in any order. Agents stand in the order of a store, or sorted (by
/// number, where all are numbers).
///
/// # Errors
/// [`RegistryError::Data`] that names column and row, what was expected and found.
pub fn read_trace(path: &Path) -> Result<Trace, RegistryError> {
    if !is_link_table(path)? {
        return from_source(storage::open(path).map_err(|e| data(&e))?.as_mut());
    }
    let form = form(path)?;
    if form == PARQUET {
        storage::check_table(path, TableForm::Parquet).map_err(|e| data(&e))?;
    }
    let (sha256, _) = crate::io::sha256_file(path).map_err(|e| data(&e))?;
    let table = Table::read(path, form)?;
    table.into_trace(sha256).map_err(|message| refused(&message, path))
}

/// Whether a path is a table of link bits, not a store: neither a directory nor an `.mcap`, and a Parquet file only if it
/// has a column `delivered`. Where nothing is, a store is missing.
///
/// # Errors
/// [`RegistryError::Data`] when a Parquet file is damaged.
pub fn is_link_table(path: &Path) -> Result<bool, RegistryError> {
    if !path.exists() || path.is_dir() || ends(path, "mcap") {
        return Ok(false);
    }
    let form = form(path)?;
    Ok(form != PARQUET || names(path, form)?.iter().any(|name| name == "delivered"))
}

/// `CSV`, `TSV` or [`PARQUET`].
fn form(path: &Path) -> Result<&'static str, RegistryError> {
    match storage::table_form(path).map_err(|e| data(&e))? {
        form @ (TableForm::Csv | TableForm::Tsv | TableForm::Parquet) => Ok(form.name()),
        form => Err(refused(&format!("expected a CSV, TSV or Parquet table, found {}", form.name()), path)),
    }
}

/// How text of this form is read: every cell as text, so that what is wrong with it can be said.
fn text_options(form: &str) -> CsvReadOptions {
    let separator = if form == "TSV" { b'\t' } else { b',' };
    let options = CsvReadOptions::default().with_infer_schema_length(Some(0));
    options.map_parse_options(|options| options.with_separator(separator))
}

fn ends(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension))
}

fn data(error: &impl std::fmt::Display) -> RegistryError {
    RegistryError::Data(error.to_string())
}

fn refused(message: &str, path: &Path) -> RegistryError {
    RegistryError::Data(format!("trace: {message}: {}", path.display()))
}

/// The link bits of every row of a store.
fn from_source(source: &mut dyn EpisodeSource) -> Result<Trace, RegistryError> {
    let layout = source.manifest().layout();
    let communicators = layout.communicators();
    let agents = communicators.iter().map(|&a| layout.agents[a].name.clone()).collect();
    let n = communicators.len();
    let (mut bits, mut starts, mut rows) = (Vec::new(), vec![0], 0);
    while let Some(episode) = source.next_episode().map_err(|e| data(&e))? {
        for row in episode.link.chunks_exact((n * n).max(1)) {
            bits.extend(row.iter().enumerate().filter(|(cell, _)| cell % (n + 1) != 0).map(|(_, &bit)| bit));
        }
        rows += episode.rows();
        starts.push(rows);
    }
    Ok(Trace { agents, starts, bits, sha256: source.manifest().content.clone() })
}

/// Runs what touches a foreign file; a panic in there, and what polars says, become errors of ours.
fn caught<T>(path: &Path, form: &str, read: impl FnOnce() -> PolarsResult<T>) -> Result<T, RegistryError> {
    let fail = |message: &str| refused(&format!("not a readable {form} table: {message}"), path);
    match crate::io::caught(read) {
        Some(Ok(value)) => Ok(value),
        Some(Err(error)) => Err(fail(error.to_string().lines().next().unwrap_or_default())),
        None => Err(fail("the file is damaged")),
    }
}

/// The names of a file's columns.
fn names(path: &Path, form: &str) -> Result<Vec<String>, RegistryError> {
    let file = File::open(path).map_err(IoError::os("open", path)).map_err(|e| data(&e))?;
    caught(path, form, || {
        if form == PARQUET {
            return Ok(ParquetReader::new(file).schema()?.iter_names().map(ToString::to_string).collect());
        }
        let frame = text_options(form).with_n_rows(Some(0)).into_reader_with_file_handle(file).finish()?;
        Ok(frame.get_column_names().into_iter().map(ToString::to_string).collect())
    })
}

/// A table of link bits, row by row.
struct Table {
    episodes: Vec<u64>,
    steps: Vec<u64>,
    /// Numbers of agents in `names`.
    senders: Vec<u32>,
    receivers: Vec<u32>,
    delivered: Vec<bool>,
    names: BTreeMap<String, u32>,
}

impl Table {
    fn read(path: &Path, form: &str) -> Result<Self, RegistryError> {
        let found = names(path, form)?;
        if let Some(missing) = COLUMNS.iter().find(|&&c| !found.iter().any(|f| f == c)) {
            let hint = did_you_mean(missing, found.iter().map(String::as_str));
            return Err(refused(&format!("no column {missing:?} (needed are {}): {hint}", COLUMNS.join(", ")), path));
        }
        let file = File::open(path).map_err(IoError::os("open", path)).map_err(|e| data(&e))?;
        let frame: DataFrame = caught(path, form, || {
            if form == PARQUET {
                let wanted = COLUMNS.map(ToOwned::to_owned).to_vec();
                return ParquetReader::new(file).with_columns(Some(wanted)).finish();
            }
            let columns = COLUMNS.map(Into::into).into();
            text_options(form).with_columns(Some(columns)).into_reader_with_file_handle(file).finish()
        })?;
        let column =
            |name: &'static str| -> Result<&Column, RegistryError> { caught(path, form, || frame.column(name)) };
        let whole = |name: &'static str| -> Result<Vec<u64>, RegistryError> {
            each(column(name)?, path, |text| text.parse().map_err(|_e| "a whole number from 0"))
        };
        let mut names = BTreeMap::new();
        let mut agents = |name: &'static str| -> Result<Vec<u32>, RegistryError> {
            each(column(name)?, path, |text| {
                let next = names.len() as u32;
                let known = names.get(text).copied();
                let number = known.unwrap_or_else(|| *names.entry(text.to_owned()).or_insert(next));
                if number < MAX_AGENTS { Ok(number) } else { Err("one of 4096 agents or fewer") }
            })
        };
        let (senders, receivers) = (agents("sender")?, agents("receiver")?);
        let delivered = each(column("delivered")?, path, |text| match text.to_ascii_lowercase().as_str() {
            "1" | "true" => Ok(true),
            "0" | "false" => Ok(false),
            _ => Err("true, false, 1 or 0"),
        })?;
        Ok(Self { episodes: whole("episode")?, steps: whole("step")?, senders, receivers, delivered, names })
    }

    /// Puts the rows in order and checks that none is missing or there twice.
    fn into_trace(self, sha256: String) -> Result<Trace, String> {
        let rows = self.delivered.len();
        if rows == 0 {
            return Err("it has no rows".to_owned());
        }
        let n = self.names.len();
        if n < 2 {
            return Err(format!("expected 2 to {MAX_AGENTS} agents among senders and receivers, found {n}"));
        }
        let mut agents: Vec<(&str, u32)> = self.names.iter().map(|(name, &number)| (name.as_str(), number)).collect();
        if agents.iter().all(|(name, _)| name.parse::<u64>().is_ok()) {
            agents.sort_by_key(|(name, _)| name.parse::<u64>().unwrap_or(u64::MAX));
        }
        let mut place = vec![0; n];
        agents.iter().enumerate().for_each(|(i, &(_, number))| place[number as usize] = i);
        let links = n * (n - 1);
        let mut keys = Vec::with_capacity(rows);
        for row in 0..rows {
            let (s, r) = (place[self.senders[row] as usize], place[self.receivers[row] as usize]);
            if s == r {
                return Err(format!("row {}: {:?} sends to itself: leave such rows out", row + 1, agents[s].0));
            }
            keys.push((self.episodes[row], self.steps[row], s * (n - 1) + r - usize::from(r > s), row));
        }
        keys.sort_unstable();
        let mut starts = vec![0];
        let mut want = (0, 0, 0);
        for &(episode, step, link, row) in &keys {
            if link == 0 && want.2 == 0 && (episode, step) == (want.0 + 1, 0) && want.1 > 0 {
                starts.push(starts[starts.len() - 1] + want.1 as usize);
                want = (episode, 0, 0);
            }
            if (episode, step, link) != want {
                let name = |link: usize| {
                    let (s, r) = (link / (n - 1), link % (n - 1));
                    format!("{} to {}", agents[s].0, agents[r + usize::from(r >= s)].0)
                };
                let (found, wanted) = (name(link), name(want.2));
                return Err(format!(
                    "row {}: found episode {episode} step {step} from {found} where episode {} step {} from {wanted} should \
                     come (sorted): episodes and steps count from 0, every ordered pair once in each",
                    row + 1,
                    want.0,
                    want.1
                ));
            }
            want = if link + 1 == links { (episode, step + 1, 0) } else { (episode, step, link + 1) };
        }
        if want.2 != 0 {
            return Err(format!("episode {} step {} lacks rows: every ordered pair has one", want.0, want.1));
        }
        starts.push(starts[starts.len() - 1] + want.1 as usize);
        let bits = keys.iter().map(|&(.., row)| self.delivered[row]).collect();
        Ok(Trace { agents: agents.into_iter().map(|(name, _)| name.to_owned()).collect(), starts, bits, sha256 })
    }
}

/// Reads a column cell by cell, as text without the blanks around it; an empty cell is an error, and so is one that
/// `read` refuses, with what it expected.
fn each<T>(
    column: &Column,
    path: &Path,
    mut read: impl FnMut(&str) -> Result<T, &'static str>,
) -> Result<Vec<T>, RegistryError> {
    let unfit = || refused(&format!("column {:?} holds {}", column.name(), column.dtype()), path);
    let cast = column.cast(&DataType::String).ok().ok_or_else(unfit)?;
    let values = cast.str().ok().ok_or_else(unfit)?;
    let cell = |(row, value): (usize, Option<&str>)| {
        let text = value.map(str::trim).ok_or("a value");
        let read = text.and_then(&mut read);
        read.map_err(|wanted| expected(column.name(), row, wanted, value.unwrap_or_default(), path))
    };
    values.iter().enumerate().map(cell).collect()
}

fn expected(column: &str, row: usize, wanted: &str, found: &str, path: &Path) -> RegistryError {
    refused(&format!("column {column}, row {}: expected {wanted}, found {found:?}", row + 1), path)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads the text as a file `t.csv`.
    fn read(text: &str) -> Result<Trace, String> {
        let dir = tempfile::tempdir().map_err(|e| e.to_string())?;
        let path = dir.path().join("t.csv");
        crate::io::write_atomic(&path, text.as_bytes()).map_err(|e| e.to_string())?;
        read_trace(&path).map_err(|e| e.to_string().replace(path.to_string_lossy().as_ref(), "t.csv"))
    }

    const HEAD: &str = "episode,step,sender,receiver,delivered\n";

    #[test]
    fn rows_in_any_order_become_a_trace() {
        let rows = "0,1,b,a,0\n1,0,a,b,true\n0,0,a,b,1\n0,0,b,a,FALSE\n0,1,a,b,0\n1,0,b,a,1\n";
        let trace = read(&format!("{HEAD}{rows}")).unwrap();
        assert_eq!((trace.agents.join(" "), trace.starts.clone()), ("a b".to_owned(), vec![0, 2, 3]));
        assert_eq!(trace.bits, [true, false, false, false, true, true]);
        assert_eq!(trace.sha256.len(), 64);
        let more = "delivered,x,receiver,sender,step,episode\n1,7,10,9,0,0\n0,7,9,10,0,0\n";
        assert_eq!(read(more).unwrap().agents, ["9", "10"], "numbers sort as numbers, columns stand anywhere");
    }

    #[test]
    fn tsv_is_read_and_parquet_is_known_by_its_first_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        let text = format!("{HEAD}0,0,a,b,1\n0,0,b,a,0\n").replace(',', "\t");
        for name in ["t.tsv", "t.TAB"] {
            crate::io::write_atomic(&path(name), text.as_bytes()).unwrap();
            assert_eq!(read_trace(&path(name)).unwrap().bits, [true, false]);
        }
        let mut frame = polars::prelude::df!("episode" => [0, 0], "step" => [0, 0], "sender" => ["a", "b"],
            "receiver" => ["b", "a"], "delivered" => [true, false])
        .unwrap();
        let mut bytes = Vec::new();
        polars::prelude::ParquetWriter::new(&mut bytes).finish(&mut frame).unwrap();
        crate::io::write_atomic(&path("bits.data"), &bytes).unwrap();
        assert!(is_link_table(&path("bits.data")).unwrap());
        assert_eq!(read_trace(&path("bits.data")).unwrap().bits, [true, false]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let error = |rows: &str| read(&format!("{HEAD}{rows}")).unwrap_err();
        assert_eq!(
            error("0,0,a,b,maybe\n"),
            "trace: column delivered, row 1: expected true, false, 1 or 0, found \"maybe\": t.csv"
        );
        assert_eq!(
            error("0,0,a,b,0.5\n"),
            "trace: column delivered, row 1: expected true, false, 1 or 0, found \"0.5\": t.csv"
        );
        assert_eq!(
            error("0,0,a,b,1\n-1,0,b,a,1\n"),
            "trace: column episode, row 2: expected a whole number from 0, found \"-1\": t.csv"
        );
        assert_eq!(error("0,,a,b,1\n"), "trace: column step, row 1: expected a value, found \"\": t.csv");
        assert_eq!(error("0,0,a,a,1\n0,0,a,b,1\n"), "trace: row 1: \"a\" sends to itself: leave such rows out: t.csv");
        assert_eq!(error("0,0,a,b,1\n"), "trace: episode 0 step 0 lacks rows: every ordered pair has one: t.csv");
        let twice = error("0,0,a,b,1\n0,0,a,b,1\n0,0,b,a,1\n");
        assert!(
            twice.starts_with("trace: row 2: found episode 0 step 0 from a to b where episode 0 step 0 from b to a"),
            "{twice}"
        );
        let gap = error("0,0,a,b,1\n0,0,b,a,1\n2,0,a,b,1\n2,0,b,a,1\n");
        assert!(gap.contains("found episode 2 step 0 from a to b where episode 0 step 1"), "{gap}");
        assert!(error("").contains("it has no rows"), "{}", error(""));
        let column = read("episode,step,sender,reciever,delivered\n").unwrap_err();
        assert!(column.contains("no column \"receiver\"") && column.contains("did you mean reciever?"), "{column}");
        assert!(read_trace(Path::new("nowhere.csv")).unwrap_err().to_string().starts_with("no such file or directory"));
    }
}
