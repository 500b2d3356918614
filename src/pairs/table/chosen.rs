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
            notes: notes.map(|note| format!("{NOTE}{note}")).collect(),
            path: table.path(),
        })
    }

    /// The samples among the rows of a part. Rows with a missing value are left out and counted in the notes.
    pub(super) fn samples(&self, part: &Part) -> Result<Samples, PairsError> {
        self.sharing(part, &mut Shared::default())
    }

    /// The same samples; columns that other samples of this part have alike are shared with them.
    pub(super) fn sharing(&self, part: &Part, shared: &mut Shared) -> Result<Samples, PairsError> {
        let Self { x, y, z, group, time, options, .. } = self;
        let whole = |r: usize| {
            let values = || x.row(r).iter().chain(y.row(r)).chain(z.row(r));
            values().all(|v| !v.is_nan())
                && group.as_ref().is_none_or(|g| g[r].is_some())
                && time.as_ref().is_none_or(|t| t.has(r))
        };
        let all = part.rows.len();
        let mut rows: Vec<usize> = part.rows.iter().copied().filter(|&r| whole(r)).collect();
        let read = options.x.iter().chain(&options.y).chain(&options.given).chain(&options.group).chain(&options.time);
        let columns = read.map(String::as_str).collect::<Vec<_>>().join(", ");
        if rows.is_empty() {
            return Err(PairsError::NoRows { rows: all, columns, path: self.path.clone() });
        }
        let mut notes = Vec::new();
        if rows.len() < all {
            notes.push(format!("{} of {all} rows left out: a missing value in {columns}", all - rows.len()));
        }
        notes.extend(self.notes.iter().chain(&part.note).cloned());
        if let Some(time) = time {
            rows.sort_by(|&a, &b| time.compare(a, b));
        }
        let (starts, mut label) = episodes(&mut rows, group.as_deref(), options);
        let exchange = if group.is_none() && time.is_some() { Exchange::Shift } else { Exchange::Episodes };
        if let (Some(time), Some(name)) = (time, &options.time) {
            let ties = time.ties(&rows, &starts, exchange == Exchange::Shift);
            if ties > 0 {
                notes.push(format!(
                    "{NOTE}{ties} of {} rows have the {name} of the row before: they stay in the file's order",
                    rows.len()
                ));
            }
        }
        if let Some(within) = &part.within {
            label = format!("{label}, {within}");
        }
        let given = (!options.given.is_empty()).then(|| options.given.join(","));
        let choice = shared.of(&rows, starts);
        Ok(Samples {
            x: choice.pick(x, &options.x),
            y: choice.pick(y, &options.y),
            z: given.is_some().then(|| choice.pick(z, &options.given)),
            starts: Arc::clone(&choice.starts),
            rows: (0..rows.len() as u32).collect(),
            exchange,
            labels: SampleLabels {
                x: options.x.join(","),
                y: options.y.join(","),
                given,
                group: label,
                within: part.within.clone(),
                ..SampleLabels::default()
            },
            notes,
        })
    }
}
