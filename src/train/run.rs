//! A run from its start, or from its checkpoint, to its end: the directory, the waves, the checkpoints, the last test.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::config::TrainConfig;
use super::trainer::Trainer;
use super::{LastTest, TrainError, directory};

/// How a run is started.
#[derive(Debug, Default)]
pub struct Options<'a> {
    /// Store whose episodes fill replay and rings before the first step.
    pub warm_start: Option<&'a Path>,
    /// Store that takes the run's own rollouts; never replaced.
    pub record: Option<&'a Path>,
    /// Go on from the checkpoint in the run directory.
    pub resume: bool,
    /// Replace what is at the output paths, if it was made by this program.
    pub force: bool,
}

/// Where a run stands, for a progress line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Environment steps so far.
    pub step: u64,
    /// Mean training return of the last logging interval.
    pub return_mean: Option<f64>,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Report {
    /// Environment steps.
    pub steps: u64,
    /// Updates.
    pub updates: u64,
    /// Episodes.
    pub episodes: u64,
    /// Mean training return of the last logging interval, with exploration noise.
    pub return_mean: Option<f64>,
    /// Critic loss of the minibatch that the next update would draw.
    pub next_critic_loss: Option<f64>,
    /// Whether it was stopped before its last step.
    pub interrupted: bool,
    /// Whether it had taken its last step before: no step was left, only what of its tests was missing.
    pub was_finished: bool,
    /// Files of earlier tests that were removed when the run went on, and that it did not write anew.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub removed: Vec<&'static str>,
    /// What the tests found that belong to the end of the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test: Option<LastTest>,
}

/// Trains as `config` says into the run directory `dir`, which gets `config.toml`, `metrics.parquet`, `timings.parquet`,
/// `TensorBoard` events, `checkpoint/` and the tables of its tests. When `stop` turns true the run is saved after the
/// wave at hand and ends.
///
/// # Errors
/// [`TrainError`].
pub fn train(
    config: TrainConfig,
    dir: &Path,
    options: &Options<'_>,
    progress: &mut dyn FnMut(Progress),
    stop: &AtomicBool,
) -> Result<Report, TrainError> {
    let config = config.resolve()?;
    if !options.resume {
        directory::refuse_foreign(dir, options.force)?;
    }
    let _old = directory::hold(dir)?;
    let mut trainer = Trainer::new(config, dir)?;
    if options.resume {
        trainer.resume()?;
    }
    if let Some(path) = options.warm_start {
        trainer.warm_start(crate::storage::open(path)?.as_mut())?;
    }
    let mut sink = match options.record {
        Some(path) => Some(crate::storage::create(path, &trainer.manifest(), false)?), // data outlives a run
        None => None,
    };
    let was_finished = options.resume && trainer.step >= trainer.config.steps;
    // nothing that was there is touched before everything that can be refused has been
    let mut removed = Vec::new();
    let _new = if options.resume {
        directory::remove_leftovers(dir)?;
        if trainer.step < trainer.config.steps {
            removed = directory::remove_tests(&trainer)?;
        }
        directory::write_config(&trainer)?;
        None
    } else {
        directory::create(&mut trainer, options.force)?
    };
    let mut saved = trainer.update;
    while trainer.step < trainer.config.steps && !stop.load(Ordering::Relaxed) {
        trainer.advance(sink.as_deref_mut())?;
        if trainer.update - saved >= trainer.config.checkpoint_every {
            trainer.save()?;
            if let Some(sink) = &mut sink {
                sink.commit()?;
            }
            saved = trainer.update;
        }
        progress(Progress { step: trainer.step, return_mean: trainer.return_mean() });
    }
    trainer.save()?;
    if let Some(sink) = sink {
        sink.finish()?;
    }
    let interrupted = trainer.step < trainer.config.steps;
    let test = if interrupted { None } else { trainer.test_at_end()? };
    removed.retain(|name| !dir.join(name).exists());
    Ok(Report {
        steps: trainer.step,
        updates: trainer.update,
        episodes: trainer.episode,
        return_mean: trainer.return_mean(),
        next_critic_loss: trainer.next_critic_loss(),
        interrupted,
        was_finished,
        removed,
        test,
    })
}
