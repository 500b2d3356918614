//! What all commands share on the terminal: results, tables, progress, errors.

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

/// How results are printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    /// For people.
    #[default]
    Table,
    /// For programs: one JSON document on stdout.
    Json,
}

/// The writer behind a broken pipe: the reader has left, which is no error.
#[derive(Debug, thiserror::Error)]
#[error("broken pipe")]
pub(super) struct BrokenPipe;

/// Prints `text` and a line end on stdout.
///
/// # Errors
/// [`BrokenPipe`] when the reader has left; the caller just ends.
pub(super) fn print(text: &str) -> anyhow::Result<()> {
    print_bytes(format!("{text}\n").as_bytes())
}

/// Writes a document to stdout as it is.
///
/// # Errors
/// [`BrokenPipe`] when the reader has left; the caller just ends.
pub(super) fn print_bytes(bytes: &[u8]) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(bytes).and_then(|()| out.flush()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Err(BrokenPipe.into()),
        other => Ok(other?),
    }
}

/// Prints a value as indented JSON on stdout.
///
/// # Errors
/// When stdout is closed.
pub(super) fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    print(&serde_json::to_string_pretty(value)?)
}

/// Prints a table on stdout; cells are shown with control characters escaped.
///
/// # Errors
/// When stdout is closed.
pub(super) fn print_table(header: &[&str], rows: &[Vec<String>]) -> anyhow::Result<()> {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::NOTHING);
    table.set_header(header.to_vec());
    for row in rows {
        table.add_row(row.iter().map(|cell| crate::io::printable(cell)).collect::<Vec<_>>());
    }
    let text = table.to_string();
    print(&text.lines().map(str::trim_end).collect::<Vec<_>>().join("\n"))
}

/// Says something to the user on stderr; control characters of the lines, which may come from a file, are escaped.
pub(super) fn say(text: &str) {
    for line in text.split('\n') {
        eprintln!("{}", crate::io::printable(line));
    }
}

/// A progress bar with rate and ETA on stderr; silent when stderr is no terminal.
pub(super) fn progress(total: u64, what: &'static str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(8));
    let template = "{msg:>14} {bar:32} {human_pos}/{human_len} {per_sec:.dim} ETA {eta}";
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar.set_message(what);
    bar.enable_steady_tick(Duration::from_millis(250));
    bar
}

/// Prints an error once, as one line, and gives its exit code: 2 when the user's words are at fault, else 1.
pub(super) fn report_error(error: &anyhow::Error) -> ExitCode {
    if error.is::<BrokenPipe>() {
        return ExitCode::SUCCESS;
    }
    eprintln!("error: {}", crate::io::printable(&format!("{error:#}")));
    let usage = error.chain().any(|e| e.downcast_ref::<crate::Error>().is_some_and(crate::Error::is_usage));
    ExitCode::from(if usage { 2 } else { 1 })
}
