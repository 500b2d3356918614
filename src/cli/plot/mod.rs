//! Pictures of estimates: a heat map of links or of pairs of columns, values over lags, or everything about one pair.

mod heatmap;
mod lags;
mod pair;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{outputs, ui};
use crate::Error;
use crate::figure::{self, Data, FIGURES};
use crate::io::read_bytes;
use crate::mi::{Estimate, Plan};
use crate::registry::find;
use crate::schema::Samples;

/// Where a picture goes.
pub(super) struct Target {
    path: PathBuf,
    is_png: bool,
}

/// Checks the name before anything is computed.
pub(super) fn target(path: &Path, force: bool) -> Result<Target, Error> {
    let ends = |with: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(with));
    if !ends("svg") && !ends("png") {
        let message = format!("--plot: expected a name that ends in .svg or .png, found {}", path.display());
        return Err(Error::Usage(message));
    }
    outputs::check(path, force, outputs::is_picture)?;
    Ok(Target { path: path.to_owned(), is_png: ends("png") })
}

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
    target: &Target,
) -> anyhow::Result<bool> {
    let (figure, drawn) = match (view, samples.first()) {
        (View::Matrix, _) | (_, None) => ("mi-heatmap", heatmap::data(rows)),
        (View::Lags, _) => ("mi-by-lag", lags::data(rows)),
        (View::Pair, Some(own)) => match pair::pieces(samples, plan, failed, threads)? {
            Some(pieces) => ("mi-pair", Some(pair::data(rows, own, plan.seed, pieces))),
            None => return Ok(false),
        },
    };
    let place = target.path.display();
    let Some((data, what)) = drawn else {
        ui::say(&format!("note: no finite value to draw: {place}"));
        return Ok(true);
    };
    save(figure, &data, target)?;
    ui::say(&format!("drew {what}: {place}"));
    Ok(true)
}

fn save(figure: &str, data: &Data, target: &Target) -> anyhow::Result<()> {
    let entry = find("figure", FIGURES, figure)?;
    if target.is_png {
        let folder = tempfile::tempdir()?;
        let whole = folder.path().join("figure.png");
        figure::png(entry, data, &whole)?;
        outputs::write_png(&target.path, &read_bytes(&whole, u64::MAX - 1).map_err(Error::from)?)?;
    } else {
        outputs::write_svg(&target.path, figure::svg(entry, data)?)?;
    }
    Ok(())
}
