//! A heat map of estimates: links of a store, or pairs of a table's columns.

use crate::figure::{Cell, Data};
use crate::mi::Estimate;

/// The values of the first estimator that has a finite one, and what they are; `None` where none has.
pub(super) fn data(rows: &[Estimate]) -> Option<(Data, String)> {
    let first = rows.iter().find(|r| r.value.is_finite())?;
    let of_links = first.sender.is_some();
    let chosen = rows.iter().filter(|r| r.estimator == first.estimator);
    let cell = |row: &Estimate| {
        let panel = match row.delivered {
            Some(true) => "delivered",
            Some(false) => "lost",
            None => "",
        };
        let ends = if of_links {
            (row.sender.clone(), row.receiver.clone())
        } else {
            (Some(row.x.clone()), Some(row.y.clone()))
        };
        let (sender, receiver) = (ends.0.unwrap_or_default(), ends.1.unwrap_or_default());
        Cell { panel: panel.to_owned(), sender, receiver, value: row.value }
    };
    let mut cells: Vec<Cell> = chosen.map(cell).collect();
    if !of_links {
        // information has no direction; the diagonal stays empty
        let mirrored = |c: &Cell| Cell { sender: c.receiver.clone(), receiver: c.sender.clone(), ..c.clone() };
        let mut names: Vec<String> =
            cells.iter().map(|c| c.sender.clone()).chain(cells.iter().map(|c| c.receiver.clone())).collect();
        let mut seen = std::collections::BTreeSet::new();
        names.retain(|name| seen.insert(name.clone()));
        let diagonal =
            names.into_iter().map(|n| Cell { panel: String::new(), sender: n.clone(), receiver: n, value: f64::NAN });
        // the diagonal first: it sets the order of rows and columns
        cells = diagonal.chain(cells.iter().map(mirrored)).chain(cells.iter().cloned()).collect();
    }
    let data = Data {
        title: "Mutual information".to_owned(),
        subtitle: format!("{}: {}, {}", first.estimator, first.kind.name(), first.unit.name()),
        unit: format!("mutual information, {}", first.unit.name()),
        cells,
        axes: if of_links { <[String; 2]>::default() } else { ["column".to_owned(), "column".to_owned()] },
        ..Data::default()
    };
    let count = rows.iter().filter(|r| r.estimator == first.estimator).count();
    Some((data, format!("{count} values of {}", first.estimator)))
}
