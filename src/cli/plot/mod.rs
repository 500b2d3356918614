//! Pictures of estimates: a heat map of links or of pairs of columns, values over lags, or everything about one pair.

mod heatmap;
mod lags;
mod pair;

use std::sync::Arc;

use super::outputs::Picture;
use super::ui;
use crate::mi::{Estimate, Plan};
use crate::schema::Samples;

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum View {
    /// A value per link, or per pair of columns.
    Matrix,
    /// Values over lags.
    Lags,
    /// One pair of columns.
    Pair,
}

/// Draws estimates, and says what it drew, or that nothing has a place in a picture; `false` when a signal came first.
/// Estimators of the plan that `failed` are left out.
pub(super) fn draw(
    view: View,
    rows: &[Estimate],
    failed: &[&str],
    (samples, plan): (&Arc<Vec<Samples>>, &Arc<Plan>),
    threads: u16,
    target: &Picture,
) -> anyhow::Result<bool> {
    let (figure, drawn) = match (view, samples.first()) {
        (View::Matrix, _) | (_, None) => ("mi-heatmap", heatmap::data(rows)),
        (View::Lags, _) => ("mi-by-lag", lags::data(rows)),
        (View::Pair, Some(own)) => match pair::pieces(samples, plan, failed, threads)? {
            Some(pieces) => ("mi-pair", Some(pair::data(rows, own, plan.seed, pieces))),
            None => return Ok(false),
        },
    };
    let place = target.path().display();
    let Some((data, what)) = drawn else {
        ui::say(&format!("note: no finite value to draw: {place}"));
        return Ok(true);
    };
    target.draw(figure, &data)?;
    ui::say(&format!("drew {what}: {place}"));
    Ok(true)
}
