//! What all commands share on the terminal: results, tables, progress, errors.

use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::time::{Duration, Instant};

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

/// Says when something unfinished lies beside a store.
pub(super) fn say_left_beside(store: &std::path::Path) {
    if let Some(left) = crate::storage::left_beside(store) {
        let (left, store) = (left.display(), store.display());
        say(&format!(
            "note: beside it lies what did not finish; `ccmarl recover --force {store}` puts its whole episodes in place of \
             this store: {left}"
        ));
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

/// Seconds between two lines about a long run where stderr is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// How far a long run is: a bar with rate and ETA on a terminal, else a plain line every [`LINE_EVERY`].
pub(super) struct Live {
    bar: ProgressBar,
    total: u64,
    plain: bool,
    /// When the last line was said, and at which step.
    said: Option<(Instant, u64)>,
}

impl Live {
    /// For a run of `total` steps.
    pub(super) fn new(total: u64, what: &'static str) -> Self {
        Self { bar: progress(total, what), total, plain: !std::io::stderr().is_terminal(), said: None }
    }

    /// Tells where the run stands.
    pub(super) fn at(&mut self, step: u64, return_mean: Option<f64>) {
        let Some((since, from)) = self.said else {
            // a resumed run starts in the middle: the steps before were not this process's
            self.bar.set_position(step);
            self.bar.reset_eta();
            self.said = Some((Instant::now(), step));
            return;
        };
        self.bar.set_position(step);
        if let Some(mean) = return_mean {
            self.bar.set_message(format!("return {mean:8.1}"));
        }
        if self.plain && since.elapsed() >= LINE_EVERY {
            say(&run_line(step, self.total, (step - from) as f64 / since.elapsed().as_secs_f64(), return_mean));
            self.said = Some((Instant::now(), step));
        }
    }

    /// Takes the bar away.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// One line about a run: how far, how it does, how fast, how long still.
fn run_line(step: u64, total: u64, rate: f64, return_mean: Option<f64>) -> String {
    let share = 100.0 * step as f64 / total.max(1) as f64;
    let earned = return_mean.map_or(String::new(), |mean| format!(", return {mean:.1}"));
    let left = total.saturating_sub(step) as f64 / rate;
    let eta = if left.is_finite() {
        indicatif::HumanDuration(Duration::from_secs(left as u64)).to_string()
    } else {
        "unknown".to_owned()
    };
    format!("step {step} of {total} ({share:.0} %){earned}, {rate:.0} steps/s, ETA {eta}")
}

/// An error with its causes, each of them once: some tell their cause themselves.
fn one_line(error: &anyhow::Error) -> String {
    let mut text = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

/// Prints an error once, as one line, and gives its exit code: 2 when the user's words are at fault, else 1.
pub(super) fn report_error(error: &anyhow::Error) -> ExitCode {
    if error.is::<BrokenPipe>() {
        return ExitCode::SUCCESS;
    }
    eprintln!("error: {}", crate::io::printable(&one_line(error)));
    let own = || error.chain().filter_map(|e| e.downcast_ref::<crate::Error>());
    for line in own().filter_map(crate::Error::excerpt).flat_map(str::lines) {
        eprintln!("  {}", crate::io::printable(line));
    }
    let usage = own().any(crate::Error::is_usage);
    ExitCode::from(if usage { 2 } else { 1 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_that_an_error_tells_itself_is_not_told_again() {
        let source = || std::io::Error::other("is a directory");
        let own = crate::io::IoError::os("read", std::path::Path::new("d"))(source());
        assert_eq!(one_line(&crate::Error::from(own).into()), "could not read: is a directory: d");
        assert_eq!(
            one_line(&anyhow::Error::from(source()).context("could not start")),
            "could not start: is a directory"
        );
    }

    #[test]
    fn a_line_about_a_run_says_how_far_how_well_how_fast_and_how_long_still() {
        let line = run_line(1_000_000, 4_000_000, 25_000.0, Some(-161.44));
        assert_eq!(line, "step 1000000 of 4000000 (25 %), return -161.4, 25000 steps/s, ETA 2 minutes");
        assert_eq!(run_line(25, 100, 0.0, None), "step 25 of 100 (25 %), 0 steps/s, ETA unknown");
    }
}
