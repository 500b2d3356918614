//! Checkpoints: everything that decides how a run goes on.
//!
//! `checkpoint/actors.safetensors` is for users (`PyTorch`'s names and shapes); `checkpoint/state.safetensors` holds the
//! networks, targets, optimisers, replay, rings, tests and counters. One list, [`visit`], names all of it, for writing
//! and for reading. Generators need no state: every stream is named by the index of its episode or update.

use super::arrays::Arrays;
use super::config::TrainConfig;
use super::directory::CHECKPOINTS;
use super::estimator::Estimator;
use super::metrics::MetricsRow;
use super::protocol::{Best, TestRow};
use super::trainer::Trainer;
use super::{TrainError, difference};
use crate::nn::{Adam, Params};

/// The user's file of the actors as they stand.
const ACTORS: &str = "actors.safetensors";
/// The user's file of the best actors so far, under protocol `standard`.
pub(super) const BEST: &str = "best.safetensors";
const STATE: &str = "state.safetensors";
/// Name of the number below in the state, which is not part of [`visit`]: it says what `visit` will find.
const LAYOUT: &str = "layout";
/// What arrays the state has and how long they are. A change of [`visit`], of the columns of metrics or of a number's
/// meaning takes the next number.
const VERSION: u64 = 1;
/// All files of a checkpoint.
pub(super) const FILES: [&str; 3] = [ACTORS, BEST, STATE];

/// A part of a trainer's state. What is of fixed length must keep it.
enum Slot<'a> {
    Params(&'a Params),
    Fixed(&'a mut [f32]),
    FixedDoubles(&'a mut [f64]),
    Floats(&'a mut Vec<f32>),
    Doubles(&'a mut Vec<f64>),
    Bits(&'a mut Vec<bool>),
    Count(&'a mut u64),
}

type See<'s> = &'s mut dyn FnMut(&str, Slot<'_>) -> Result<(), String>;

/// Shows every part of the state, by name.
fn visit(trainer: &mut Trainer, see: See<'_>) -> Result<(), String> {
    see("step", Slot::Count(&mut trainer.step))?;
    see("update", Slot::Count(&mut trainer.update))?;
    see("episode", Slot::Count(&mut trainer.episode))?;
    let learner = &mut trainer.learner;
    see("actors", Slot::Params(&learner.params.actors))?;
    see("critic", Slot::Params(&learner.params.critic))?;
    see("target_actors", Slot::Params(&learner.params.target_actors))?;
    see("target_critic", Slot::Params(&learner.params.target_critic))?;
    visit_adam("actor_adam", &mut learner.actor_adam, see)?;
    visit_adam("critic_adam", &mut learner.critic_adam, see)?;
    visit_replay(trainer, see)?;
    if let Some(dumie) = &mut trainer.dumie {
        let names: Vec<String> = dumie.named().map(|(name, _)| name).collect();
        names.iter().zip(dumie.all_mut()).try_for_each(|(name, estimator)| visit_estimator(name, estimator, see))?;
    }
    see("means.sums", Slot::FixedDoubles(&mut trainer.means.sums))?;
    see("means.counts", Slot::FixedDoubles(&mut trainer.means.counts))?;
    let mut rows: Vec<f64> = trainer.metrics.iter().flat_map(MetricsRow::to_numbers).collect();
    see("metrics", Slot::Doubles(&mut rows))?;
    trainer.metrics = rows.chunks(MetricsRow::NUMBERS).map(MetricsRow::from_numbers).collect();
    let tests = &mut trainer.tests;
    let mut rows: Vec<f64> = tests.rows.iter().copied().flat_map(TestRow::to_numbers).collect();
    see("tests", Slot::Doubles(&mut rows))?;
    tests.rows = rows.chunks(TestRow::NUMBERS).map(TestRow::from_numbers).collect();
    see("best.actors", Slot::Floats(&mut tests.best.params))?;
    see("best.return", Slot::FixedDoubles(std::slice::from_mut(&mut tests.best.mean)))?;
    see("best.step", Slot::Count(&mut tests.best.step))
}

fn visit_adam(name: &str, adam: &mut Adam, see: See<'_>) -> Result<(), String> {
    see(&format!("{name}.m"), Slot::Fixed(&mut adam.m))?;
    see(&format!("{name}.v"), Slot::Fixed(&mut adam.v))?;
    see(&format!("{name}.t"), Slot::Count(&mut adam.t))
}

fn visit_replay(trainer: &mut Trainer, see: See<'_>) -> Result<(), String> {
    let replay = &mut trainer.replay;
    let mut pushed = replay.pushed;
    see("replay.pushed", Slot::Count(&mut pushed))?;
    let arrays = [
        ("replay.observations", &mut replay.observations),
        ("replay.actions", &mut replay.actions),
        ("replay.reward", &mut replay.reward),
        ("replay.bonus", &mut replay.bonus),
    ];
    let mut taken = arrays.map(|(name, values)| (name, std::mem::take(values)));
    let mut link = std::mem::take(&mut replay.link);
    taken.iter_mut().try_for_each(|(name, values)| see(name, Slot::Floats(values)))?;
    see("replay.link", Slot::Bits(&mut link))?;
    replay.restore(taken.map(|(_, values)| values), link, pushed)
}

fn visit_estimator(name: &str, estimator: &mut Estimator, see: See<'_>) -> Result<(), String> {
    see(name, Slot::Params(&estimator.params))?;
    visit_adam(&format!("{name}_adam"), &mut estimator.adam, see)?;
    let ring = &mut estimator.ring;
    see(&format!("{name}_ring.pushed"), Slot::Count(&mut ring.pushed))?;
    see(&format!("{name}_ring.messages"), Slot::Floats(&mut ring.messages))?;
    see(&format!("{name}_ring.actions"), Slot::Floats(&mut ring.actions))?;
    if ring.messages.len() != ring.len() * ring.widths[0] || ring.actions.len() != ring.len() * ring.widths[1] {
        return Err(format!("{name}_ring: its length does not fit its counter"));
    }
    let [mut messages, mut actions] = estimator.fresh().map(<[f32]>::to_vec);
    see(&format!("{name}_fresh.messages"), Slot::Floats(&mut messages))?;
    see(&format!("{name}_fresh.actions"), Slot::Floats(&mut actions))?;
    if estimator.restore_fresh(messages, actions) {
        Ok(())
    } else {
        Err(format!("{name}_fresh: its lengths do not fit"))
    }
}

/// Writes all files; the state, by which a run goes on, last.
pub(super) fn save(trainer: &mut Trainer) -> Result<(), TrainError> {
    let dir = trainer.dir.join(CHECKPOINTS);
    let learner = &trainer.learner;
    let actors = learner.actors.to_bytes(&learner.params.actors.read(), trainer.step)?;
    crate::io::write_atomic(&dir.join(ACTORS), &actors)?;
    if !trainer.tests.best.params.is_empty() {
        save_best(trainer, &trainer.tests.best)?;
    }
    let mut arrays = Arrays::default();
    arrays.put(LAYOUT, &[VERSION]);
    let inconsistent = |message| TrainError::Value { name: "checkpoint".to_owned(), message };
    visit(trainer, &mut |name, slot| {
        match slot {
            Slot::Params(params) => arrays.put(name, &params.read()),
            Slot::Fixed(values) => arrays.put(name, values),
            Slot::FixedDoubles(values) => arrays.put(name, values),
            Slot::Floats(values) => arrays.put(name, values),
            Slot::Doubles(values) => arrays.put(name, values),
            Slot::Bits(values) => arrays.put(name, values),
            Slot::Count(count) => arrays.put(name, &[*count]),
        }
        Ok(())
    })
    .map_err(inconsistent)?;
    let json = serde_json::to_string(&trainer.config).map_err(|e| inconsistent(e.to_string()))?;
    let bytes = arrays.to_bytes(&json).map_err(crate::nn::NnError::from)?;
    Ok(crate::io::write_atomic(&dir.join(STATE), &bytes)?)
}

/// Writes the user's file of the best actors.
pub(super) fn save_best(trainer: &Trainer, best: &Best) -> Result<(), TrainError> {
    let bytes = trainer.learner.actors.to_bytes(&best.params, best.step)?;
    Ok(crate::io::write_atomic(&trainer.dir.join(CHECKPOINTS).join(BEST), &bytes)?)
}

/// Brings a fresh trainer to where the checkpoint in its directory stands.
pub(super) fn load(trainer: &mut Trainer) -> Result<(), TrainError> {
    let path = trainer.dir.join(CHECKPOINTS).join(STATE);
    let fail = |message: String| TrainError::Resume { message, path: path.clone() };
    if !path.exists() {
        return Err(fail("there is no checkpoint; start without --resume".to_owned()));
    }
    let (arrays, json) = Arrays::read(&path).map_err(fail)?;
    let layout = arrays.get::<u64>(LAYOUT).ok().and_then(|found| found.first().copied());
    if layout != Some(VERSION) {
        let found = layout.map_or("none".to_owned(), |found| found.to_string());
        return Err(fail(format!(
            "the checkpoint was written by another version of the program (expected layout {VERSION}, found {found}): go on \
             with that version, or start a new run"
        )));
    }
    let config: TrainConfig = serde_json::from_str(&json).map_err(|e| fail(format!("its configuration: {e}")))?;
    let changed = difference::between(&config, &trainer.config)?;
    if !changed.is_empty() {
        let changed = changed.join("; ");
        return Err(fail(format!("the configuration changed: {changed}; give the old values, or start a new run")));
    }
    visit(trainer, &mut |name, slot| fill(&arrays, name, slot)).map_err(fail)?;
    let (done, asked) = (trainer.step, trainer.config.steps);
    if asked < done && config.steps != asked {
        let message = format!("the run has taken {done} steps, --steps {asked} lie behind it: give at least {done}");
        return Err(TrainError::Resume { message, path });
    }
    Ok(())
}

/// Fills a part of the state from the file's arrays.
fn fill(arrays: &Arrays, name: &str, slot: Slot<'_>) -> Result<(), String> {
    let length = |expected: usize, found: usize| {
        if expected == found { Ok(()) } else { Err(format!("{name}: expected {expected} elements, found {found}")) }
    };
    match slot {
        Slot::Params(params) => {
            let values = arrays.get::<f32>(name)?;
            length(params.len(), values.len())?;
            params.update(|p| p.copy_from_slice(&values)).map_err(|e| e.to_string())?;
        }
        Slot::Fixed(slice) => {
            let values = arrays.get(name)?;
            length(slice.len(), values.len())?;
            slice.copy_from_slice(&values);
        }
        Slot::FixedDoubles(slice) => {
            let values = arrays.get(name)?;
            length(slice.len(), values.len())?;
            slice.copy_from_slice(&values);
        }
        Slot::Floats(values) => *values = arrays.get(name)?,
        Slot::Doubles(values) => *values = arrays.get(name)?,
        Slot::Bits(values) => *values = arrays.get(name)?,
        Slot::Count(count) => {
            let values = arrays.get(name)?;
            length(1, values.len())?;
            *count = values[0];
        }
    }
    Ok(())
}
