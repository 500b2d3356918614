//! The page: one HTML file that needs nothing else. Every string is escaped by the template, except the SVG text of
//! [`crate::figure`], which escapes its own.

use askama::Template as _;

use crate::io::printable;
use crate::report::markdown::Grid;
use crate::report::{ReportError, Run};

/// A figure on the page.
pub(super) struct Picture {
    /// Name of its files, without extension.
    pub file: String,
    /// SVG text.
    pub svg: String,
    /// What it is.
    pub caption: String,
    /// What can be read off it.
    pub seen: String,
}

/// One part of the page: a task, or a file of estimates.
pub(super) struct Section {
    /// Anchor.
    pub id: String,
    /// Heading.
    pub title: String,
    /// Figures, in order.
    pub pictures: Vec<Picture>,
    /// Caption of the table, empty without one.
    pub caption: String,
    /// Its table.
    pub table: Option<Grid>,
    /// Files of the table, relative.
    pub files: Vec<String>,
    /// Notes below it.
    pub notes: Vec<String>,
}

/// A line of the provenance table.
struct Origin {
    path: String,
    algorithm: String,
    prior: String,
    seed: u64,
    steps: u64,
    ccmarl: String,
    config: String,
}

#[derive(askama::Template)]
#[template(path = "report.html")]
struct Page<'a> {
    title: &'a str,
    lead: &'a str,
    sections: &'a [Section],
    origins: Vec<Origin>,
    tables: &'a [(String, String)],
    command: &'a str,
    version: &'static str,
}

/// The page as HTML text.
///
/// # Errors
/// [`ReportError::Internal`] when the template fails.
pub(super) fn html(
    title: &str,
    lead: &str,
    sections: &[Section],
    runs: &[Run],
    mi: &[(String, String)],
    command: &str,
) -> Result<String, ReportError> {
    let origin = |r: &Run| Origin {
        path: printable(&r.path.display().to_string()),
        algorithm: printable(&r.algorithm),
        prior: printable(&r.prior.to_string()),
        seed: r.seed,
        steps: r.steps,
        ccmarl: printable(&r.ccmarl),
        config: r.config_sha256.chars().take(12).collect(),
    };
    let origins = runs.iter().map(origin).collect();
    let page = Page { title, lead, sections, origins, tables: mi, command, version: env!("CARGO_PKG_VERSION") };
    page.render().map_err(|e| ReportError::Internal(format!("page template: {e}")))
}
