//! Warm starts: a store's episodes in replay and rings, as if they had been rolled out here.

use super::{TrainError, Trainer};
use crate::scenario;
use crate::schema::AgentSpec;
use crate::storage::EpisodeSource;

impl Trainer {
    /// Fills replay and rings from a store, oldest episode first.
    ///
    /// # Errors
    /// [`TrainError::Store`] when its agents, its world or its lengths do not fit, [`TrainError::Storage`] when it cannot
    /// be read.
    pub fn warm_start(&mut self, source: &mut dyn EpisodeSource) -> Result<u64, TrainError> {
        let (own, other) = (&self.layout.agents, &source.manifest().agents);
        if own != other {
            let at = own.iter().zip(other).position(|(a, b)| a != b).unwrap_or(own.len().min(other.len()));
            let name = |agents: &[AgentSpec]| {
                agents.get(at).map_or_else(
                    || "nobody".to_owned(),
                    |a| {
                        format!(
                            "{} (observation {}, message {}, action {})",
                            a.name, a.observation, a.message, a.action
                        )
                    },
                )
            };
            return Err(TrainError::Store(format!(
                "agent {at} is {} here and {} in the store",
                name(own),
                name(other)
            )));
        }
        let world = source.manifest().scenario.as_object();
        let differences = world.map(|world| scenario::differences(world, self.scenario.as_ref(), "in the store"));
        if let Some(differences) = differences.filter(|found| !found.is_empty()) {
            return Err(TrainError::Store(format!("another world: {}", differences.join(", "))));
        }
        if self.dumie.is_none() {
            return self.replay.fill(source); // rings need episodes, replay does not
        }
        let mut episodes = 0;
        while let Some(episode) = source.next_episode()? {
            self.observe(&episode)?;
            episodes += 1;
        }
        Ok(episodes)
    }
}
