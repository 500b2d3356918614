//! Samples from named columns of a CSV, TSV or Parquet file.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use polars::prelude::{Column, CsvReadOptions, DataFrame, DataType, ParquetReader, PolarsError, SerReader as _};

use super::PairsError;
use crate::io::IoError;
use crate::registry::did_you_mean;
use crate::schema::{Columns, Exchange, SampleLabels, Samples};

/// What a name begins with that is a pattern.
const PATTERN: &str = "regex:";
/// Blocks into which one series is cut.
const BLOCKS: usize = 50;

/// Which columns to read, and what an episode is. `regex:PATTERN` stands for all columns whose name it matches.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TableOptions {
    /// Columns of x; a vector column counts as many as it is long.
    pub x: Vec<String>,
    /// Columns of y.
    pub y: Vec<String>,
    /// Columns of z, given which x and y are compared; none: no condition.
    pub given: Vec<String>,
    /// Rows of equal value are one episode.
    pub group: Option<String>,
    /// Order of the rows within an episode; without `group` all rows are one series.
    pub time: Option<String>,
}

/// Whether a path is a rollout store: a directory, an `.mcap` file, or Parquet with the key `ccmarl.manifest`.
///
/// # Errors
/// [`IoError::Missing`] when nothing is there; [`PairsError::Unreadable`] for a damaged `.parquet` file.
pub fn is_store(path: &Path) -> Result<bool, PairsError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    if path.is_dir() || path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mcap")) {
        return Ok(true);
    }
    caught(path, |form| {
        if form != "Parquet" {
            return Ok(false);
        }
        let mut reader = ParquetReader::new(File::open(path).map_err(IoError::os("open", path))?);
        let metadata = reader.get_metadata().map_err(unreadable(form, path))?;
        Ok(metadata.key_value_metadata().iter().flatten().any(|kv| kv.key == "ccmarl.manifest"))
    })
}

/// Samples from the named columns. Rows with a missing value are left out and counted in the notes.
///
/// # Errors
/// [`PairsError`] that names column and row.
pub fn table(path: &Path, options: &TableOptions) -> Result<Samples, PairsError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    caught(path, |form| {
        let options = expanded(path, form, options)?;
        let frame = read(path, form, &wanted(&options))?;
        samples(&frame, path, &options)
    })
}

/// One set of samples per unordered pair of the columns `options.x`, or of all columns of numbers or words; and what was
/// left out: empty columns, and pairs without a common row. The file is read once; rows with a missing value are left out
/// pair by pair.
///
/// # Errors
/// As [`table()`]; [`PairsError::NoPairs`]; [`PairsError::NoRows`] when no pair is left.
pub fn all_pairs(path: &Path, options: &TableOptions) -> Result<(Vec<Samples>, Vec<String>), PairsError> {
    if !path.exists() {
        return Err(IoError::Missing(path.to_owned()).into());
    }
    caught(path, |form| {
        let mut options = expanded(path, form, options)?;
        let chosen = !options.x.is_empty();
        if !chosen {
            options.x = names(path, form)?;
        }
        let frame = read(path, form, &wanted(&options))?;
        let others: Vec<&String> = options.given.iter().chain(&options.group).chain(&options.time).collect();
        let usable = |name: &&String| {
            let kind = frame.column(name).map(|c| c.dtype().clone());
            let readable = kind.is_ok_and(|kind| is_numeric(&kind) || kind == DataType::String);
            chosen || (readable && !others.contains(name))
        };
        let columns: Vec<String> = options.x.iter().filter(usable).cloned().collect();
        if columns.len() < 2 {
            return Err(PairsError::NoPairs { found: columns.len(), path: path.to_owned() });
        }
        let is_empty = |name: &String| frame.column(name).is_ok_and(|c| c.null_count() == frame.height());
        let (empty, full): (Vec<String>, Vec<String>) = columns.into_iter().partition(is_empty);
        let (mut sets, mut last) = (Vec::new(), None);
        let mut left_out: Vec<String> = empty.iter().map(|name| format!("column {name:?} is empty")).collect();
        for (i, j) in (0..full.len()).flat_map(|i| (i + 1..full.len()).map(move |j| (i, j))) {
            let (x, y) = (vec![full[i].clone()], vec![full[j].clone()]);
            match samples(&frame, path, &TableOptions { x, y, ..options.clone() }) {
                Ok(set) => sets.push(set),
                Err(error @ PairsError::NoRows { .. }) => {
                    left_out.push(error.to_string());
                    last = Some(error);
                }
                Err(error) => return Err(error),
            }
        }
        if !sets.is_empty() {
            return Ok((sets, left_out));
        }
        let columns = full.into_iter().chain(empty).collect::<Vec<_>>().join(", ");
        Err(last.unwrap_or_else(|| PairsError::NoRows { rows: frame.height(), columns, path: path.to_owned() }))
    })
}

/// All columns that the options name.
fn wanted(options: &TableOptions) -> Vec<&str> {
    let keys = options.group.iter().chain(&options.time);
    options.x.iter().chain(&options.y).chain(&options.given).chain(keys).map(String::as_str).collect()
}

/// The options with every `regex:PATTERN` replaced by the columns that it matches, in the order of the file.
fn expanded(path: &Path, form: &'static str, options: &TableOptions) -> Result<TableOptions, PairsError> {
    if form == "Parquet" {
        crate::storage::check_table(path)?;
    }
    let mut out = options.clone();
    for list in [&mut out.x, &mut out.y, &mut out.given] {
        if !list.iter().any(|name| name.starts_with(PATTERN)) {
            continue;
        }
        let known = names(path, form)?;
        let mut found = Vec::new();
        for name in &*list {
            let Some(pattern) = name.strip_prefix(PATTERN) else {
                found.push(name.clone());
                continue;
            };
            let wrong =
                |message: String| PairsError::Pattern { pattern: pattern.to_owned(), message, path: path.to_owned() };
            let matcher = regex::Regex::new(pattern).map_err(|e| {
                wrong(format!("not a regular expression: {}", e.to_string().lines().last().unwrap_or_default()))
            })?;
            let matched: Vec<&String> = known.iter().filter(|name| matcher.is_match(name)).collect();
            if matched.is_empty() {
                let all = known.iter().take(40).map(String::as_str).collect::<Vec<_>>().join(", ");
                return Err(wrong(format!("matches no column; the columns are {all}")));
            }
            found.extend(matched.into_iter().cloned());
        }
        *list = found;
    }
    Ok(out)
}

fn samples(frame: &DataFrame, path: &Path, options: &TableOptions) -> Result<Samples, PairsError> {
    let [x, y, z] = [&options.x, &options.y, &options.given].map(|names| numbers(frame, names, path));
    let (x, y, z) = (x?, y?, z?);
    let height = frame.height();
    let group = options.group.as_deref().map(|name| texts(frame, name, path)).transpose()?;
    let time = options.time.as_deref().map(|name| Order::of(frame, name, path)).transpose()?;
    let whole = |r: usize| {
        let values = || x.row(r).iter().chain(y.row(r)).chain(z.row(r));
        values().all(|v| !v.is_nan())
            && group.as_ref().is_none_or(|g| g[r].is_some())
            && time.as_ref().is_none_or(|t| t.has(r))
    };
    let mut rows: Vec<usize> = (0..height).filter(|&r| whole(r)).collect();
    let columns = wanted(options).join(", ");
    if rows.is_empty() {
        return Err(PairsError::NoRows { rows: height, columns, path: path.to_owned() });
    }
    if height > u32::MAX as usize {
        return Err(PairsError::TooManyRows);
    }
    let mut notes = Vec::new();
    if rows.len() < height {
        notes.push(format!("{} of {height} rows left out: a missing value in {columns}", height - rows.len()));
    }
    if let Some(time) = &time {
        rows.sort_by(|&a, &b| time.compare(a, b));
    }
    let (starts, label) = episodes(&mut rows, group.as_deref(), options);
    let pick = |columns: &Columns| {
        let data = rows.iter().flat_map(|&r| columns.row(r).iter().copied()).collect();
        Arc::new(Columns { data, names: columns.names.clone(), words: columns.words.clone() })
    };
    Ok(Samples {
        x: pick(&x),
        y: pick(&y),
        z: (!options.given.is_empty()).then(|| pick(&z)),
        starts: starts.into(),
        rows: (0..rows.len() as u32).collect(),
        exchange: if group.is_none() && time.is_some() { Exchange::Shift } else { Exchange::Episodes },
        labels: SampleLabels {
            x: options.x.join(","),
            y: options.y.join(","),
            given: (!options.given.is_empty()).then(|| options.given.join(",")),
            group: label,
            ..SampleLabels::default()
        },
        notes,
    })
}

/// Puts the rows of an episode together (in order of first appearance) and says where episodes start.
fn episodes(rows: &mut [usize], group: Option<&[Option<String>]>, options: &TableOptions) -> (Vec<usize>, String) {
    let n = rows.len();
    let Some(keys) = group else {
        return match &options.time {
            Some(time) => {
                let blocks = BLOCKS.min(n);
                ((0..=blocks).map(|b| b * n / blocks).collect(), format!("blocks of {time}"))
            }
            None => ((0..=n).collect(), "row".to_owned()),
        };
    };
    let mut first = std::collections::BTreeMap::new();
    for &r in rows.iter() {
        let next = first.len();
        first.entry(keys[r].as_deref()).or_insert(next);
    }
    rows.sort_by_key(|&r| first.get(&keys[r].as_deref()));
    let mut starts: Vec<usize> = (0..n).filter(|&i| i == 0 || keys[rows[i]] != keys[rows[i - 1]]).collect();
    starts.push(n);
    (starts, options.group.clone().unwrap_or_default())
}

/// Runs what touches a foreign file's data; a panic in there becomes an error of ours.
fn caught<T>(path: &Path, read: impl FnOnce(&'static str) -> Result<T, PairsError>) -> Result<T, PairsError> {
    let form = crate::storage::table_form(path)?;
    crate::io::caught(|| read(form)).unwrap_or_else(|| {
        Err(PairsError::Unreadable { form, message: "the file is damaged".to_owned(), path: path.to_owned() })
    })
}

/// The first line of what polars has to say.
fn unreadable(form: &'static str, path: &Path) -> impl Fn(PolarsError) -> PairsError {
    let path = path.to_owned();
    move |error| {
        let message = error.to_string().lines().next().unwrap_or_default().to_owned();
        PairsError::Unreadable { form, message, path: path.clone() }
    }
}

/// How text of this form is read.
fn text_options(form: &str) -> CsvReadOptions {
    let separator = if form == "TSV" { b'\t' } else { b',' };
    CsvReadOptions::default().map_parse_options(|options| options.with_separator(separator))
}

/// The names of the file's columns.
fn names(path: &Path, form: &'static str) -> Result<Vec<String>, PairsError> {
    let file = File::open(path).map_err(IoError::os("open", path))?;
    let unreadable = unreadable(form, path);
    if form == "Parquet" {
        let schema = ParquetReader::new(file).schema().map_err(&unreadable)?;
        return Ok(schema.iter_names().map(ToString::to_string).collect());
    }
    let options = text_options(form).with_n_rows(Some(0)).with_infer_schema_length(Some(0));
    let frame = options.into_reader_with_file_handle(file).finish().map_err(&unreadable)?;
    Ok(frame.get_column_names().into_iter().map(ToString::to_string).collect())
}

/// The wanted columns of the file.
fn read(path: &Path, form: &'static str, wanted: &[&str]) -> Result<DataFrame, PairsError> {
    let open = || File::open(path).map_err(IoError::os("open", path));
    let (names, unreadable) = (names(path, form)?, unreadable(form, path));
    if let Some(&name) = wanted.iter().find(|w| !names.iter().any(|n| n == *w)) {
        let hint = did_you_mean(name, names.iter().map(String::as_str));
        return Err(PairsError::UnknownColumn { name: name.to_owned(), hint, path: path.to_owned() });
    }
    let mut columns: Vec<&str> = wanted.to_vec();
    columns.sort_unstable();
    columns.dedup();
    let frame = if form == "Parquet" {
        let columns = columns.iter().map(|c| (*c).to_owned()).collect();
        ParquetReader::new(open()?).with_columns(Some(columns)).finish()
    } else {
        // the whole file decides a column's type: a float in the last row must not be an error
        let columns = columns.iter().map(|&c| c.into()).collect();
        let options = text_options(form).with_infer_schema_length(None).with_columns(Some(columns));
        options.into_reader_with_file_handle(open()?).finish()
    };
    frame.map_err(unreadable)
}

fn is_numeric(kind: &DataType) -> bool {
    kind.is_primitive_numeric() || kind.is_bool()
}

fn column<'a>(frame: &'a DataFrame, name: &str, path: &Path) -> Result<&'a Column, PairsError> {
    frame.column(name).map_err(unreadable("table", path))
}

fn not_numeric(frame: &DataFrame, column: &Column, path: &Path) -> PairsError {
    let numeric: Vec<&str> =
        frame.columns().iter().filter(|c| is_numeric(c.dtype())).map(|c| c.name().as_str()).collect();
    let hint = if numeric.is_empty() {
        "none of the columns asked for is numeric".to_owned()
    } else {
        format!("of the columns asked for, {} are numeric", numeric.join(", "))
    };
    let kind = if column.dtype() == &DataType::String { "text".to_owned() } else { column.dtype().to_string() };
    PairsError::NotNumeric { name: column.name().to_string(), kind, hint, path: path.to_owned() }
}

/// A column of words as the ranks of its words, a missing one NaN; `None` for any other column.
fn ranks(column: &Column) -> Option<Vec<f64>> {
    let words = column.str().ok()?;
    let mut levels: Vec<&str> = words.iter().flatten().collect();
    levels.sort_unstable();
    levels.dedup();
    let rank = |word: Option<&str>| word.map_or(f64::NAN, |word| levels.partition_point(|l| *l < word) as f64);
    Some(words.iter().map(rank).collect())
}

/// Named columns side by side, vectors flattened, words ranked; a missing value is NaN.
fn numbers(frame: &DataFrame, names: &[String], path: &Path) -> Result<Columns, PairsError> {
    let mut parts: Vec<(usize, Vec<f64>)> = Vec::new();
    let mut out = Columns::default();
    for name in names {
        let column = column(frame, name, path)?;
        let words = ranks(column);
        let is_words = words.is_some();
        let (width, values) = words.map_or_else(|| flat(frame, column, path), |words| Ok((1, words)))?;
        // beyond this a square is no number any more, and a column would look constant
        if let Some(at) = values.iter().position(|v| v.abs() > 1e150) {
            return Err(PairsError::Infinite { name: name.clone(), row: at / width + 1, path: path.to_owned() });
        }
        out.words.extend(std::iter::repeat_n(is_words, width));
        if width == 1 && (is_words || is_numeric(column.dtype())) {
            out.names.push(name.clone());
        } else {
            out.names.extend((0..width).map(|i| format!("{name}[{i}]")));
        }
        parts.push((width, values));
    }
    for row in 0..frame.height() {
        for (width, values) in &parts {
            out.data.extend_from_slice(&values[row * width..(row + 1) * width]);
        }
    }
    Ok(out)
}

/// Width and row-major values of one column.
fn flat(frame: &DataFrame, column: &Column, path: &Path) -> Result<(usize, Vec<f64>), PairsError> {
    let unfit = || not_numeric(frame, column, path);
    let plain = |column: &Column| -> Result<Vec<f64>, PairsError> {
        let cast = column.cast(&DataType::Float64).ok().ok_or_else(unfit)?;
        Ok(cast.f64().ok().ok_or_else(unfit)?.iter().map(|v| v.unwrap_or(f64::NAN)).collect())
    };
    let vectors: Vec<Option<Vec<f64>>> = match column.dtype() {
        kind if is_numeric(kind) => return Ok((1, plain(column)?)),
        DataType::Array(inner, _) | DataType::List(inner) if is_numeric(inner) => {
            let list = column.cast(&DataType::List(Box::new(DataType::Float64))).ok().ok_or_else(unfit)?;
            let list = list.list().ok().ok_or_else(unfit)?.clone();
            (0..list.len())
                .map(|i| list.get_as_series(i).map(|s| plain(&s.into())).transpose())
                .collect::<Result<_, _>>()?
        }
        _ => return Err(unfit()),
    };
    let width = vectors.iter().flatten().map(Vec::len).next().unwrap_or(1).max(1);
    let mut data = Vec::with_capacity(vectors.len() * width);
    for (row, vector) in vectors.into_iter().enumerate() {
        let vector = vector.unwrap_or_else(|| vec![f64::NAN; width]);
        if vector.len() != width {
            let (name, path) = (column.name().to_string(), path.to_owned());
            return Err(PairsError::Ragged { name, row: row + 1, expected: width, found: vector.len(), path });
        }
        data.extend(vector);
    }
    Ok((width, data))
}

/// A column as text, for grouping.
fn texts(frame: &DataFrame, name: &str, path: &Path) -> Result<Vec<Option<String>>, PairsError> {
    let column = column(frame, name, path)?;
    let cast = column.cast(&DataType::String).ok().ok_or_else(|| not_numeric(frame, column, path))?;
    let values = cast.str().ok().ok_or_else(|| not_numeric(frame, column, path))?;
    Ok(values.iter().map(|v| v.map(str::to_owned)).collect())
}

/// A column that orders rows: numbers by size, text by its bytes (ISO dates sort rightly).
enum Order {
    Numbers(Vec<f64>),
    Texts(Vec<Option<String>>),
}

impl Order {
    fn of(frame: &DataFrame, name: &str, path: &Path) -> Result<Self, PairsError> {
        let column = column(frame, name, path)?;
        if column.dtype() == &DataType::String {
            return texts(frame, name, path).map(Self::Texts);
        }
        let (width, values) = flat(frame, column, path)?;
        if width == 1 { Ok(Self::Numbers(values)) } else { Err(not_numeric(frame, column, path)) }
    }

    fn has(&self, row: usize) -> bool {
        match self {
            Self::Numbers(values) => !values[row].is_nan(),
            Self::Texts(values) => values[row].is_some(),
        }
    }

    fn compare(&self, a: usize, b: usize) -> std::cmp::Ordering {
        match self {
            Self::Numbers(values) => values[a].total_cmp(&values[b]),
            Self::Texts(values) => values[a].cmp(&values[b]),
        }
    }
}
