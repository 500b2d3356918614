//! Checkpoints: everything that decides how a run goes on, as safetensors.
//!
//! `checkpoint/actors.safetensors` is for users (`PyTorch`'s names and shapes); `checkpoint/state.safetensors` holds the
//! networks, targets, optimisers, replay, rings and counters. Generators need no state: every stream is named by the
//! index of its episode or update.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

use super::metrics::{METRIC_COLUMNS, Means, MetricsRow};
use super::replay::Ring;
use super::run::Trainer;
use super::{TrainError, config::TrainConfig};
use crate::nn::{Adam, Params};

/// Counters, as JSON in the file's metadata.
#[derive(Debug, Serialize, Deserialize)]
struct Counters {
    config: TrainConfig,
    step: u64,
    update: u64,
    episode: u64,
    replay_pushed: u64,
    /// Per estimator.
    ring_pushed: Vec<u64>,
    /// Steps of the actors' optimiser, of the critic's, then of each estimator's.
    adam: Vec<u64>,
}

type Tensors = BTreeMap<String, Tensor>;

fn put(tensors: &mut Tensors, name: &str, values: &[f32]) -> Result<(), TrainError> {
    let tensor = Tensor::from_slice(values, values.len(), &Device::Cpu).map_err(crate::nn::NnError::from)?;
    tensors.insert(name.to_owned(), tensor);
    Ok(())
}

fn put_adam(tensors: &mut Tensors, name: &str, adam: &Adam) -> Result<(), TrainError> {
    put(tensors, &format!("{name}.m"), &adam.m)?;
    put(tensors, &format!("{name}.v"), &adam.v)
}

/// Writes both files.
pub(super) fn save(trainer: &Trainer) -> Result<(), TrainError> {
    let dir = trainer.dir.join("checkpoint");
    let learner = &trainer.learner;
    let actors = learner.actors.to_bytes(&learner.params.actors.read(), trainer.step)?;
    crate::io::write_atomic(&dir.join("actors.safetensors"), &actors)?;

    let mut tensors = Tensors::new();
    put(&mut tensors, "actors", &learner.params.actors.read())?;
    put(&mut tensors, "critic", &learner.params.critic.read())?;
    put(&mut tensors, "target_actors", &learner.params.target_actors.read())?;
    put(&mut tensors, "target_critic", &learner.params.target_critic.read())?;
    put_adam(&mut tensors, "actor_adam", &learner.actor_adam)?;
    put_adam(&mut tensors, "critic_adam", &learner.critic_adam)?;
    let replay = &trainer.replay;
    put(&mut tensors, "replay.observations", &replay.observations)?;
    put(&mut tensors, "replay.actions", &replay.actions)?;
    put(&mut tensors, "replay.reward", &replay.reward)?;
    put(&mut tensors, "replay.bonus", &replay.bonus)?;
    let candle = |e: candle_core::Error| TrainError::from(crate::nn::NnError::from(e));
    let bits: Vec<u8> = replay.link.iter().map(|&b| u8::from(b)).collect();
    tensors.insert("replay.link".to_owned(), Tensor::from_slice(&bits, bits.len(), &Device::Cpu).map_err(candle)?);
    let (mut adam, mut ring_pushed) = (vec![learner.actor_adam.t, learner.critic_adam.t], Vec::new());
    if let Some(dumie) = &trainer.dumie {
        for (name, estimator) in dumie.named() {
            put(&mut tensors, &name, &estimator.params.read())?;
            put_adam(&mut tensors, &format!("{name}_adam"), &estimator.adam)?;
            put(&mut tensors, &format!("{name}_ring.messages"), &estimator.ring.messages)?;
            put(&mut tensors, &format!("{name}_ring.actions"), &estimator.ring.actions)?;
            let [messages, actions] = estimator.fresh();
            put(&mut tensors, &format!("{name}_fresh.messages"), messages)?;
            put(&mut tensors, &format!("{name}_fresh.actions"), actions)?;
            adam.push(estimator.adam.t);
            ring_pushed.push(estimator.ring.pushed);
        }
    }
    let doubles = |tensors: &mut Tensors, name: &str, values: Vec<f64>| -> Result<(), TrainError> {
        let len = values.len();
        tensors.insert(name.to_owned(), Tensor::from_vec(values, len, &Device::Cpu).map_err(candle)?);
        Ok(())
    };
    doubles(&mut tensors, "means", [trainer.means.sums, trainer.means.counts].concat())?;
    let rows = trainer.metrics.iter().flat_map(|r| {
        [r.step as f64, r.update as f64, r.episode as f64]
            .into_iter()
            .chain(r.values.iter().map(|v| v.unwrap_or(f64::NAN)))
    });
    doubles(&mut tensors, "metrics", rows.collect())?;
    let counters = Counters {
        config: trainer.config.clone(),
        step: trainer.step,
        update: trainer.update,
        episode: trainer.episode,
        replay_pushed: replay.pushed,
        ring_pushed,
        adam,
    };
    let json = serde_json::to_string(&counters)
        .map_err(|e| TrainError::Value { name: "checkpoint".to_owned(), message: e.to_string() })?;
    let metadata = [("ccmarl.state".to_owned(), json)].into_iter().collect();
    let bytes = safetensors::serialize(tensors, Some(metadata)).map_err(crate::nn::NnError::from)?;
    Ok(crate::io::write_atomic(&dir.join("state.safetensors"), &bytes)?)
}

/// Brings a fresh trainer to where the checkpoint in its directory stands.
pub(super) fn load(trainer: &mut Trainer) -> Result<(), TrainError> {
    let path = trainer.dir.join("checkpoint").join("state.safetensors");
    let fail = |message: String| TrainError::Resume { message, path: path.clone() };
    let bytes = std::fs::read(&path).map_err(|e| fail(format!("{e} (nothing to resume; start without --resume)")))?;
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).map_err(|e| fail(e.to_string()))?;
    let json = header.metadata().as_ref().and_then(|m| m.get("ccmarl.state")).cloned().unwrap_or_default();
    let counters: Counters = serde_json::from_str(&json).map_err(|e| fail(format!("its counters: {e}")))?;
    if let Some(difference) = difference(&counters.config, &trainer.config)? {
        return Err(fail(format!("the configuration changed: {difference}; resume with the old one, or start anew")));
    }
    let tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu).map_err(|e| fail(e.to_string()))?;
    let tensor = |name: &str| tensors.get(name).ok_or_else(|| fail(format!("{name} is missing")));
    let floats = |name: &str| -> Result<Vec<f32>, TrainError> {
        tensor(name)?.to_vec1::<f32>().map_err(|e| fail(format!("{name}: {e}")))
    };
    let doubles = |name: &str| -> Result<Vec<f64>, TrainError> {
        tensor(name)?.to_vec1::<f64>().map_err(|e| fail(format!("{name}: {e}")))
    };
    let params = |name: &str, params: &Params| -> Result<(), TrainError> {
        let values = floats(name)?;
        if values.len() != params.len() {
            return Err(fail(format!("{name}: expected {} parameters, found {}", params.len(), values.len())));
        }
        Ok(params.update(|p| p.copy_from_slice(&values))?)
    };
    let adam = |name: &str, adam: &mut Adam, t: u64| -> Result<(), TrainError> {
        let (m, v) = (floats(&format!("{name}.m"))?, floats(&format!("{name}.v"))?);
        if m.len() != adam.m.len() || v.len() != adam.v.len() {
            return Err(fail(format!("{name}: expected {} moments, found {}", adam.m.len(), m.len())));
        }
        (adam.m, adam.v, adam.t) = (m, v, t);
        Ok(())
    };
    let names: Vec<String> = trainer.dumie.iter().flat_map(|d| d.named().map(|(name, _)| name)).collect();
    if counters.adam.len() != 2 + names.len() || counters.ring_pushed.len() != names.len() {
        return Err(fail("its counters are not those of as many estimators".to_owned()));
    }
    let learner = &mut trainer.learner;
    params("actors", &learner.params.actors)?;
    params("critic", &learner.params.critic)?;
    params("target_actors", &learner.params.target_actors)?;
    params("target_critic", &learner.params.target_critic)?;
    adam("actor_adam", &mut learner.actor_adam, counters.adam[0])?;
    adam("critic_adam", &mut learner.critic_adam, counters.adam[1])?;
    let link = tensor("replay.link")?.to_vec1::<u8>().map_err(|e| fail(e.to_string()))?;
    trainer
        .replay
        .restore(
            [
                floats("replay.observations")?,
                floats("replay.actions")?,
                floats("replay.reward")?,
                floats("replay.bonus")?,
            ],
            link.iter().map(|&b| b != 0).collect(),
            counters.replay_pushed,
        )
        .map_err(fail)?;
    if let Some(dumie) = &mut trainer.dumie {
        for (at, (name, estimator)) in names.iter().zip(dumie.all_mut()).enumerate() {
            params(name, &estimator.params)?;
            adam(&format!("{name}_adam"), &mut estimator.adam, counters.adam[2 + at])?;
            let ring = Ring {
                pushed: counters.ring_pushed[at],
                messages: floats(&format!("{name}_ring.messages"))?,
                actions: floats(&format!("{name}_ring.actions"))?,
                ..estimator.ring.clone()
            };
            if ring.messages.len() != ring.len() * ring.widths[0] || ring.actions.len() != ring.len() * ring.widths[1] {
                return Err(fail(format!("{name}_ring: its length does not fit its counter")));
            }
            estimator.ring = ring;
            let fresh = |part: &str| floats(&format!("{name}_fresh.{part}"));
            if !estimator.restore_fresh(fresh("messages")?, fresh("actions")?) {
                return Err(fail(format!("{name}_fresh: its lengths do not fit")));
            }
        }
    }
    let means = doubles("means")?;
    let rows = doubles("metrics")?;
    let width = METRIC_COLUMNS.len();
    if means.len() != 2 * width || rows.len() % (width + 3) != 0 {
        return Err(fail("its metrics have another width".to_owned()));
    }
    trainer.means =
        Means { sums: std::array::from_fn(|i| means[i]), counts: std::array::from_fn(|i| means[width + i]) };
    trainer.metrics = rows
        .chunks_exact(width + 3)
        .map(|r| MetricsRow {
            step: r[0] as u64,
            update: r[1] as u64,
            episode: r[2] as u64,
            values: std::array::from_fn(|i| Some(r[3 + i]).filter(|v| !v.is_nan())),
        })
        .collect();
    (trainer.step, trainer.update, trainer.episode) = (counters.step, counters.update, counters.episode);
    Ok(())
}

/// The first line in which two configurations differ, `steps` excepted: a run may be continued for longer.
fn difference(old: &TrainConfig, new: &TrainConfig) -> Result<Option<String>, TrainError> {
    let (old, new) = (TrainConfig { steps: new.steps, ..old.clone() }.to_toml()?, new.to_toml()?);
    let only_in = |a: &str, b: &str| a.lines().find(|line| !b.lines().any(|other| other == *line)).map(str::to_owned);
    let changed = [only_in(&old, &new), only_in(&new, &old)];
    let shown = |line: &Option<String>| line.clone().unwrap_or_else(|| "nothing".to_owned());
    Ok((changed != [None, None]).then(|| format!("{:?} became {:?}", shown(&changed[0]), shown(&changed[1]))))
}
