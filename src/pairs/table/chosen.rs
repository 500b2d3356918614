//! Samples of the columns that were chosen.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use super::TableOptions;
use super::numbers::{notes, numbers};
use super::order::{Order, episodes, texts};
use super::rows::Part;
use super::several::Table;
use crate::pairs::PairsError;
use crate::schema::{Columns, Exchange, NOTE, SampleLabels, Samples};

/// Columns that sets of samples of one part have alike: those of the same rows in the same order.
#[derive(Default)]
pub(super) struct Shared(Vec<Choice>);

/// Rows in an order, and the columns picked so.
struct Choice {
    rows: Vec<usize>,
    starts: Arc<[usize]>,
    columns: BTreeMap<Vec<String>, Arc<Columns>>,
}

/// Most choices that are remembered: columns with gaps have one per pair, and each costs a number per row.
const CHOICES: usize = 4;

impl Shared {
    fn of(&mut self, rows: &[usize], starts: Vec<usize>) -> &mut Choice {
        let found = self.0.iter().position(|choice| choice.rows == rows && *choice.starts == starts[..]);
        let at = found.unwrap_or_else(|| {
            if self.0.len() == CHOICES {
                self.0.remove(0);
            }
            self.0.push(Choice { rows: rows.to_vec(), starts: starts.into(), columns: BTreeMap::new() });
            self.0.len() - 1
        });
        &mut self.0[at]
    }
}

impl Choice {
    fn pick(&mut self, columns: &Columns, named: &[String]) -> Arc<Columns> {
        let rows = &self.rows;
        let picked = self.columns.entry(named.to_vec()).or_insert_with(|| {
            let data = rows.iter().flat_map(|&r| columns.row(r).iter().copied()).collect();
            Arc::new(Columns { data, ..columns.without_rows() })
        });
        Arc::clone(picked)
    }
}

/// The chosen columns of a table, as numbers.
pub(super) struct Chosen<'a> {
    options: &'a TableOptions,
    x: Columns,
    y: Columns,
    z: Columns,
    group: Option<Vec<Option<String>>>,
    time: Option<Order>,
    /// The rows that a condition keeps, where the others are still there.
    wanted: Option<Vec<bool>>,
    notes: Vec<String>,
    path: PathBuf,
}

impl<'a> Chosen<'a> {
    pub(super) fn of(table: &Table, options: &'a TableOptions) -> Result<Self, PairsError> {
        let used = options.x.iter().chain(&options.y).chain(&options.given);
        let used: Vec<&str> = used.map(String::as_str).collect();
        let notes = table.notes().iter().cloned().chain(notes(table, &used)?);
        Ok(Self {
            options,
            x: numbers(table, &options.x)?,
            y: numbers(table, &options.y)?,
            z: numbers(table, &options.given)?,
            group: options.group.as_deref().map(|name| texts(table, name)).transpose()?,
            time: options.time.as_deref().map(|name| Order::of(table, name)).transpose()?,
            wanted: table.wanted().map(<[bool]>::to_vec),
            notes: notes.map(|note| format!("{NOTE}{note}")).collect(),
            path: table.path(),
        })
    }

    /// The samples among the rows of a part. Rows with a missing value are left out and counted in the notes.
    pub(super) fn samples(&self, part: &Part) -> Result<Samples, PairsError> {
        self.lagged(part, &self.ordered(part)?, &mut Shared::default(), 0)
    }

    /// The same at every lag of the options, as far as there are any: y stands `lag` rows later in the same episode,
    /// counted in all rows of the part, whether they have values or not. Columns that other samples of this part have alike
    /// are shared with them.
    pub(super) fn at_lags(&self, part: &Part, shared: &mut Shared) -> Vec<Result<Samples, PairsError>> {
        match self.ordered(part) {
            Ok(ordered) => {
                let mut set =
                    |&lag: &usize| self.lagged(part, &ordered, shared, lag).and_then(|set| self.several(part, set));
                self.options.lags().iter().map(&mut set).collect()
            }
            Err(error) => vec![Err(error)],
        }
    }

    /// One row of a part is no sample: its columns would only look constant.
    fn several(&self, part: &Part, set: Samples) -> Result<Samples, PairsError> {
        if part.within.is_some() && set.len() == 1 {
            return Err(PairsError::OneRow { columns: self.columns(), path: self.path.clone() });
        }
        Ok(set)
    }

    /// The rows of a part that have a place in an episode, in order.
    fn ordered(&self, part: &Part) -> Result<Ordered, PairsError> {
        let Self { group, time, options, .. } = self;
        let has_place =
            |&r: &usize| group.as_ref().is_none_or(|g| g[r].is_some()) && time.as_ref().is_none_or(|t| t.has(r));
        let mut rows: Vec<usize> = part.rows.iter().copied().filter(has_place).collect();
        if rows.is_empty() {
            return Err(self.no_rows(part));
        }
        if let Some(time) = time {
            rows.sort_by(|&a, &b| time.compare(a, b));
        }
        let mut starts = episodes(&mut rows, group.as_deref(), options).0;
        if self.exchange() == Exchange::Shift {
            starts = vec![0, rows.len()];
        }
        let ends = starts.windows(2).flat_map(|w| std::iter::repeat_n(w[1], w[1] - w[0])).collect();
        let uneven = time.as_ref().is_some_and(|time| !time.is_even(&rows, &starts));
        Ok(Ordered { rows, starts, ends, uneven })
    }

    fn exchange(&self) -> Exchange {
        if self.group.is_none() && self.time.is_some() { Exchange::Shift } else { Exchange::Episodes }
    }

    fn is_wanted(&self, row: usize) -> bool {
        self.wanted.as_ref().is_none_or(|wanted| wanted[row])
    }

    /// The columns that are read.
    fn columns(&self) -> String {
        let Self { options, .. } = self;
        let read = options.x.iter().chain(&options.y).chain(&options.given).chain(&options.group).chain(&options.time);
        read.map(String::as_str).collect::<Vec<_>>().join(", ")
    }

    fn no_rows(&self, part: &Part) -> PairsError {
        let rows = part.rows.iter().filter(|&&r| self.is_wanted(r)).count();
        PairsError::NoRows { rows, columns: self.columns(), path: self.path.clone() }
    }

    fn lagged(&self, part: &Part, ordered: &Ordered, shared: &mut Shared, lag: usize) -> Result<Samples, PairsError> {
        let Self { x, y, z, group, time, options, .. } = self;
        let Pairs { x_rows, y_rows, possible } = self.pairs(ordered, lag);
        let found = y_rows.iter().flatten().count();
        let all = if lag == 0 { part.rows.iter().filter(|&&r| self.is_wanted(r)).count() } else { possible };
        if found == 0 {
            return Err(match lag {
                0 => self.no_rows(part),
                _ if possible == 0 => self.too_short(ordered, lag),
                _ => {
                    PairsError::NoPairsApart { lag, pairs: possible, columns: self.columns(), path: self.path.clone() }
                }
            });
        }
        let mut notes = Vec::new();
        if found < all {
            let (left, columns) = (all - found, self.columns());
            let what = if lag == 0 { "rows".to_owned() } else { format!("pairs {lag} rows apart") };
            notes.push(format!("{left} of {all} {what} left out: a missing value in {columns}"));
        }
        notes.extend(self.notes.iter().chain(&part.note).cloned());
        notes.extend(self.mostly_distinct(&x_rows));
        let mut rows = x_rows;
        let (starts, mut label) = episodes(&mut rows, group.as_deref(), options);
        if let (Some(time), Some(name)) = (time, &options.time) {
            let ties = time.ties(&rows, &starts, self.exchange() == Exchange::Shift);
            if ties > 0 {
                notes.push(format!(
                    "{NOTE}{ties} of {} rows have the {name} of the row before: they stay in the file's order",
                    rows.len()
                ));
            }
            if lag > 0 && ordered.uneven {
                let step = if lag == 1 { "the next row".to_owned() } else { format!("{lag} rows later") };
                notes.push(format!("{NOTE}{name} is not evenly spaced: lag {lag} is {step}"));
            }
        }
        if let Some(within) = &part.within {
            label = format!("{label}, {within}");
        }
        let given = (!options.given.is_empty()).then(|| options.given.join(","));
        let choice = shared.of(&rows, starts);
        let y = if lag == 0 {
            choice.pick(y, &options.y)
        } else {
            let mut later = y.without_rows();
            for row in &y_rows {
                match row {
                    Some(row) => later.data.extend_from_slice(y.row(*row)),
                    // no sample, and never read
                    None => later.data.extend(std::iter::repeat_n(0.0, y.width())),
                }
            }
            Arc::new(later)
        };
        let suffix = if lag == 0 { String::new() } else { format!("[+{lag}]") };
        Ok(Samples {
            x: choice.pick(x, &options.x),
            y,
            z: given.is_some().then(|| choice.pick(z, &options.given)),
            starts: Arc::clone(&choice.starts),
            rows: (0..).zip(&y_rows).filter(|(_, row)| row.is_some()).map(|(at, _)| at).collect(),
            exchange: self.exchange(),
            labels: SampleLabels {
                x: options.x.join(","),
                y: options.y.join(",") + &suffix,
                given,
                group: label,
                within: part.within.clone(),
                ..SampleLabels::default()
            },
            notes,
        })
    }

    /// The rows whose values are there: x and z in a row, y in the row `lag` later. Rows without such a row behind them are
    /// no samples, but stay: a null test moves whole trajectories of x.
    fn pairs(&self, ordered: &Ordered, lag: usize) -> Pairs {
        let has = |columns: &Columns, row: usize| columns.row(row).iter().all(|v| !v.is_nan());
        let mut pairs = Pairs::default();
        for (at, &row) in ordered.rows.iter().enumerate() {
            let other = (at + lag < ordered.ends[at]).then(|| ordered.rows[at + lag]);
            if !self.is_wanted(row) || other.is_some_and(|other| !self.is_wanted(other)) {
                continue;
            }
            pairs.possible += usize::from(other.is_some());
            if has(&self.x, row) && has(&self.z, row) && other.is_none_or(|other| has(&self.y, other)) {
                pairs.x_rows.push(row);
                pairs.y_rows.push(other);
            }
        }
        pairs
    }

    /// A warning per column that was asked to be words and hardly has a word twice.
    fn mostly_distinct(&self, rows: &[usize]) -> Vec<String> {
        let mut out = Vec::new();
        for columns in [&self.x, &self.y, &self.z] {
            for (c, name) in columns.names.iter().enumerate().filter(|(_, name)| self.options.words.contains(name)) {
                let words = rows.iter().map(|&row| columns.row(row)[c].to_bits());
                let distinct = words.collect::<std::collections::BTreeSet<_>>().len();
                if distinct > 2 && 2 * distinct > rows.len() {
                    out.push(format!("--words {name}: {distinct} words in {} rows: a word that stands once says nothing of another; take it as numbers, or merge words", rows.len()));
                }
            }
        }
        out.dedup();
        out
    }

    fn too_short(&self, ordered: &Ordered, lag: usize) -> PairsError {
        let longest = ordered.starts.windows(2).map(|w| w[1] - w[0]).max().unwrap_or(0);
        let samples = ordered.rows.iter().filter(|&&row| self.is_wanted(row)).count();
        PairsError::NoLag { lag, longest, samples, remedy: "give --time or --group, or a smaller --lag" }
    }
}

/// Rows in order, of episodes that follow each other.
struct Ordered {
    rows: Vec<usize>,
    starts: Vec<usize>,
    /// Of each row, the place behind its episode.
    ends: Vec<usize>,
    /// Whether the steps of time differ.
    uneven: bool,
}

/// Rows of x, each with its row of y, if it has one; and how many such pairs there are, with their values or without.
#[derive(Default)]
struct Pairs {
    x_rows: Vec<usize>,
    y_rows: Vec<Option<usize>>,
    possible: usize,
}
