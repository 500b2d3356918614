//! MCAP: fields of topics as columns, see [`crate::storage::topic_columns`].

use std::path::{Path, PathBuf};

use polars::prelude::{Column, DataFrame, NamedFrom as _, Series};

use super::form::{TableFile, unreadable};
use crate::pairs::PairsError;
use crate::storage::{Cell, topic_columns, topic_names};

/// The messages of an MCAP file.
pub(super) struct Topics(PathBuf);

impl Topics {
    pub(super) fn new(path: &Path) -> Self {
        Self(path.to_owned())
    }
}

impl TableFile for Topics {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        Ok(topic_names(&self.0)?)
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        let columns = topic_columns(&self.0, columns)?;
        let rows = columns.first().map_or(0, |(_, cells)| cells.len());
        let series = columns.into_iter().map(|(name, cells)| {
            let found = series(&name, &cells);
            found.map(Column::from).ok_or_else(|| {
                let message = format!("column {name} holds different things in different messages");
                PairsError::Unreadable { form: "MCAP", message, path: self.0.clone() }
            })
        });
        DataFrame::new(rows, series.collect::<Result<_, _>>()?).map_err(unreadable("MCAP", &self.0))
    }
}

/// The cells, if they are numbers, or all text, or all truth values.
fn series(name: &str, cells: &[Option<Cell>]) -> Option<Series> {
    let all = |fits: fn(&Cell) -> bool| cells.iter().flatten().all(fits);
    let name = name.into();
    if all(|cell| matches!(cell, Cell::Integer(_))) {
        let value = |cell: &Cell| if let Cell::Integer(value) = cell { Some(*value) } else { None };
        return Some(Series::new(name, cells.iter().map(|cell| cell.as_ref().and_then(value)).collect::<Vec<_>>()));
    }
    if all(|cell| matches!(cell, Cell::Integer(_) | Cell::Float(_))) {
        let value = |cell: &Cell| match cell {
            Cell::Integer(value) => Some(*value as f64),
            Cell::Float(value) => Some(*value),
            _ => None,
        };
        return Some(Series::new(name, cells.iter().map(|cell| cell.as_ref().and_then(value)).collect::<Vec<_>>()));
    }
    if all(|cell| matches!(cell, Cell::Truth(_))) {
        let value = |cell: &Cell| if let Cell::Truth(value) = cell { Some(*value) } else { None };
        return Some(Series::new(name, cells.iter().map(|cell| cell.as_ref().and_then(value)).collect::<Vec<_>>()));
    }
    if all(|cell| matches!(cell, Cell::Text(_))) {
        let value = |cell: &Cell| if let Cell::Text(value) = cell { Some(value.clone()) } else { None };
        return Some(Series::new(name, cells.iter().map(|cell| cell.as_ref().and_then(value)).collect::<Vec<_>>()));
    }
    None
}
