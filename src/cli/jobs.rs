//! Many jobs on a pool of threads: progress with ETA, and what is finished when a signal comes.

use std::io::IsTerminal as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use anyhow::Context as _;

use super::args::stop_or_end;
use super::ui;

/// How often signals are looked for.
const LOOK: Duration = Duration::from_millis(50);
/// Time between two lines about the jobs where stderr is no terminal.
pub(super) const LINE_EVERY: Duration = Duration::from_secs(10);

/// What jobs told before they ended, or before a signal.
pub(super) struct Gathered<T> {
    /// In the order in which the jobs finished.
    pub(super) told: Vec<T>,
    /// Whether a signal came before all had.
    pub(super) interrupted: bool,
}

/// Runs `work` on a pool of `threads` threads (0: one per core) and gathers the `total` things that it tells.
///
/// On SIGINT and SIGTERM it returns at once with what is there; the flag that `work` gets is raised, so that it starts
/// nothing new, and what still runs then ends with the process. A second signal ends the process.
pub(super) fn gather<T: Send + 'static>(
    threads: u16,
    total: usize,
    what: &'static str,
    work: impl FnOnce(&AtomicBool, &(dyn Fn(T) + Sync)) + Send + 'static,
) -> anyhow::Result<Gathered<T>> {
    let stop = stop_or_end()?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build();
    let pool = pool.context("could not start threads")?;
    let (tell, told) = channel();
    // whoever listens may have left: then nobody needs the rest
    let worker = std::thread::spawn(move || pool.install(|| work(stop, &|job| drop(tell.send(job)))));
    let bar = ui::progress(total as u64, what);
    let (plain, started, mut said) = (!std::io::stderr().is_terminal(), Instant::now(), Instant::now());
    let mut out = Gathered { told: Vec::new(), interrupted: false };
    loop {
        match told.recv_timeout(LOOK) {
            Ok(job) => {
                out.told.push(job);
                bar.inc(1);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                if let Err(panic) = worker.join() {
                    std::panic::resume_unwind(panic);
                }
                break;
            }
        }
        if stop.load(Ordering::SeqCst) {
            out.told.extend(told.try_iter());
            break;
        }
        if plain && said.elapsed() >= LINE_EVERY {
            ui::say(&line(what, out.told.len(), total, started.elapsed()));
            said = Instant::now();
        }
    }
    bar.finish_and_clear();
    out.interrupted = out.told.len() < total;
    Ok(out)
}

/// One line about jobs: how many are finished, and how long the others take if they are alike.
pub(super) fn line(what: &str, done: usize, total: usize, elapsed: Duration) -> String {
    let left = elapsed.as_secs_f64() / done as f64 * (total - done.min(total)) as f64;
    let eta = if left.is_finite() {
        indicatif::HumanDuration(Duration::from_secs(left as u64)).to_string()
    } else {
        "unknown".to_owned()
    };
    format!("{what}: {done} of {total}, ETA {eta}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_about_jobs_says_how_many_and_how_long_still() {
        assert_eq!(line("estimating", 3, 12, Duration::from_mins(1)), "estimating: 3 of 12, ETA 3 minutes");
        assert_eq!(line("estimating", 0, 12, Duration::from_mins(1)), "estimating: 0 of 12, ETA unknown");
    }
}
