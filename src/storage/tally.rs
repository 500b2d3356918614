//! What every container counts and checks alike: episode order, schema, finite numbers, and the digests of content.

use std::path::Path;

use rayon::prelude::*;
use sha2::{Digest as _, Sha256};

use super::StorageError;
use crate::schema::{Episode, Layout, Manifest, SchemaError, hex};

/// A running count of episodes and steps, and the digest over their content hashes in order.
#[derive(Clone, Debug, Default)]
pub(super) struct Tally {
    /// Episodes so far.
    pub(super) episodes: u64,
    /// Steps so far.
    pub(super) steps: u64,
    content: Sha256,
    /// Whether episodes were passed over, so that steps and digest are not those of the store.
    skipped: bool,
    /// Whether episodes were counted without their content hash.
    unhashed: bool,
}

impl Tally {
    /// Checks the next episode of a store and returns its content hash. `self` counts the whole store.
    pub(super) fn check(&self, layout: &Layout, episode: &Episode) -> Result<[u8; 32], SchemaError> {
        check(layout, episode, self.episodes)
    }

    /// Checks the next episodes of a store, side by side, and returns their content hashes.
    pub(super) fn check_all(&self, layout: &Layout, episodes: &[Episode]) -> Result<Vec<[u8; 32]>, SchemaError> {
        self.check_each(layout, episodes).into_iter().collect()
    }

    /// The same, one by one.
    pub(super) fn check_each(&self, layout: &Layout, episodes: &[Episode]) -> Vec<Result<[u8; 32], SchemaError>> {
        let expected = (self.episodes..).zip(episodes).collect::<Vec<_>>();
        expected.into_par_iter().map(|(index, episode)| check(layout, episode, index)).collect()
    }

    /// Counts an episode with this content hash.
    pub(super) fn add(&mut self, episode: &Episode, hash: &[u8; 32]) {
        self.episodes += 1;
        self.steps += episode.steps as u64;
        self.content.update(hash);
    }

    /// Counts episodes whose content hash nobody computed.
    pub(super) fn count(&mut self, episodes: u64, steps: u64) {
        self.episodes += episodes;
        self.steps += steps;
        self.unhashed = true;
    }

    /// Passes over the episodes before number `episode`.
    pub(super) fn skip_to(&mut self, episode: u64) {
        (self.episodes, self.skipped) = (episode, true);
    }

    /// The digest so far, 64 hex digits.
    pub(super) fn content(&self) -> String {
        hex(&self.content.clone().finalize())
    }

    /// Fills the counts and the digest into the manifest of a recording that ends.
    pub(super) fn seal(&self, manifest: &mut Manifest, path: &Path) -> Result<(), StorageError> {
        if self.episodes == 0 {
            let message = "no episode was recorded, and a store holds at least one".to_owned();
            return Err(StorageError::NotAStore { message, path: path.to_owned() });
        }
        manifest.episodes = self.episodes;
        manifest.steps = self.steps;
        manifest.content = self.content();
        manifest.task.clear();
        if manifest.planned <= self.episodes {
            manifest.planned = 0; // all there
        }
        Ok(())
    }

    /// Compares what was read with what the manifest says; after a skip, only how many episodes there are, and without
    /// content hashes, only episodes and steps.
    pub(super) fn compare(&self, manifest: &Manifest, path: &Path) -> Result<(), StorageError> {
        let damaged = |message: String| Err(StorageError::Damaged { message, path: path.to_owned() });
        if self.episodes != manifest.episodes {
            return damaged(format!("expected {} episodes, found {}", manifest.episodes, self.episodes));
        }
        if self.skipped {
            return Ok(());
        }
        if self.steps != manifest.steps {
            return damaged(format!("expected {} steps, found {}", manifest.steps, self.steps));
        }
        if !self.unhashed && self.content() != manifest.content {
            return damaged("the episodes do not have the content digest of the manifest".to_owned());
        }
        Ok(())
    }
}

/// Checks an episode that must have number `expected`; its content hash.
pub(super) fn check(layout: &Layout, episode: &Episode, expected: u64) -> Result<[u8; 32], SchemaError> {
    let value = |column: &str, message: String| SchemaError::Value { column: column.to_owned(), message };
    if episode.index != expected {
        let message = format!("expected episode {expected}, found {}", episode.index);
        return Err(value("episode", message));
    }
    if episode.steps >= i32::MAX as usize {
        return Err(value("step", format!("{} steps are more than a step number holds", episode.steps)));
    }
    episode.check(layout)?;
    finite(layout, episode)?;
    Ok(episode.content_hash())
}

/// Refuses NaN and infinities: no sum or estimate over them would mean anything.
fn finite(layout: &Layout, e: &Episode) -> Result<(), SchemaError> {
    let fail = |column: String, width: usize, at: usize, value: f64| {
        let (step, element) = (at / width.max(1), at % width.max(1));
        let message = format!("step {step}, element {element}: found {value}, but a store holds finite numbers only");
        Err(SchemaError::Value { column, message })
    };
    // The whole column first, without an early exit: this loop runs on vectors of floats.
    if !e.state.iter().fold(true, |all, v| all & v.is_finite())
        && let Some(at) = e.state.iter().position(|v| !v.is_finite())
    {
        return fail("state".to_owned(), layout.state_fields.len(), at, e.state[at]);
    }
    let check = |kind: &str, agent: &str, width: usize, data: &[f32]| {
        if data.iter().fold(true, |all, v| all & v.is_finite()) {
            return Ok(());
        }
        match data.iter().position(|v| !v.is_finite()) {
            Some(at) => fail(format!("{kind}{agent}"), width, at, f64::from(data[at])),
            None => Ok(()),
        }
    };
    check("reward", "", 1, &e.reward)?;
    for (i, a) in layout.agents.iter().enumerate() {
        check("observation.", &a.name, a.observation, &e.observations[i].data)?;
        check("message.", &a.name, a.message, &e.messages[i].data)?;
        check("action.", &a.name, a.action, &e.actions[i].data)?;
        check("reward.", &a.name, 1, &e.rewards[i])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_digests_that_differ_are_named() {
        let layout = Layout { agents: Vec::new(), state_fields: Vec::new() };
        let manifest = |episodes: u64, steps: u64| Manifest {
            episodes,
            steps,
            ..Manifest::new(1, serde_json::Value::Null, serde_json::Value::Null, serde_json::Value::Null, &layout)
        };
        let tally = Tally { episodes: 2, steps: 5, ..Tally::default() };
        let compared = |m: &Manifest| tally.compare(m, Path::new("x")).unwrap_err().to_string();
        assert_eq!(compared(&manifest(3, 5)), "damaged: expected 3 episodes, found 2: x");
        assert_eq!(compared(&manifest(2, 6)), "damaged: expected 6 steps, found 5: x");
        let digest = "damaged: the episodes do not have the content digest of the manifest: x";
        assert_eq!(compared(&manifest(2, 5)), digest);
        let long = Episode { steps: i32::MAX as usize, ..Episode::default() };
        let error = check(&layout, &long, 0).unwrap_err().to_string();
        assert_eq!(error, "column step: 2147483647 steps are more than a step number holds");
    }
}
