//! Warm starts: a store's episodes in replay and rings, as if they had been rolled out here.
//!
//! What the store says was sent decides nothing where encoders make the messages: replay keeps none, and the rings get
//! what this run's encoders make of the stored observations. So replay, and with equal networks the loss of the next
//! minibatch, are those of the run that recorded the store, to the bit. The rings are that run's, to the bit, where
//! messages are observations, or as long as its encoders have not learned; then only their messages differ.

use super::{TrainError, Trainer};
use crate::scenario;
use crate::schema::{AgentSpec, Episode, Matrix};
use crate::storage::EpisodeSource;

impl Trainer {
    /// Fills replay and rings from a store, oldest episode first; messages that encoders make, from the observations.
    ///
    /// # Errors
    /// [`TrainError::Store`] when its agents, its world or its lengths do not fit, or it has messages that this run could
    /// not send; [`TrainError::Storage`] when it cannot be read.
    pub fn warm_start(&mut self, source: &mut dyn EpisodeSource) -> Result<u64, TrainError> {
        self.check_agents(&source.manifest().agents)?;
        let world = source.manifest().scenario.as_object();
        let differences = world.map(|world| scenario::differences(world, self.scenario.as_ref(), "in the store"));
        if let Some(differences) = differences.filter(|found| !found.is_empty()) {
            return Err(TrainError::Store(format!("another world: {}", differences.join(", "))));
        }
        if self.dumie.is_none() {
            return self.replay.fill(source); // rings need episodes, replay does not
        }
        let mut episodes = 0;
        while let Some(mut episode) = source.next_episode()? {
            self.send_anew(&mut episode);
            self.observe(&episode)?;
            episodes += 1;
        }
        Ok(episodes)
    }

    /// Checks that the store has this run's agents; what they sent may differ where encoders make it anew.
    fn check_agents(&self, other: &[AgentSpec]) -> Result<(), TrainError> {
        let (own, encodes) = (&self.layout.agents, self.learner.actors.encodes());
        let same = |a: &AgentSpec, b: &AgentSpec| {
            let message = if encodes && a.learner { a.message } else { b.message };
            *a == AgentSpec { message, ..b.clone() }
        };
        if own.len() == other.len() && own.iter().zip(other).all(|(a, b)| same(a, b)) {
            return Ok(());
        }
        let at = own.iter().zip(other).position(|(a, b)| !same(a, b)).unwrap_or(own.len().min(other.len()));
        let name = |agents: &[AgentSpec]| {
            agents.get(at).map_or_else(
                || "nobody".to_owned(),
                |a| format!("{} (observation {}, message {}, action {})", a.name, a.observation, a.message, a.action),
            )
        };
        Err(TrainError::Store(format!("agent {at} is {} here and {} in the store", name(own), name(other))))
    }

    /// Where encoders make the messages, puts those of this run's in place of what was sent.
    fn send_anew(&mut self, episode: &mut Episode) {
        let learners = self.layout.learners();
        let Some(mut senders) = self.learner.senders() else { return };
        for (j, agent) in learners.into_iter().enumerate() {
            let sent = senders.encode_of(j, &episode.observations[agent].data, episode.steps + 1);
            episode.messages[agent] = Matrix { data: sent.to_vec(), width: self.layout.agents[agent].message };
        }
    }
}
