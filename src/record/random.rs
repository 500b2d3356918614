//! # What it is
//! Actions that look at nothing: the lowest reference row of every table.
//!
//! # Definition
//! Every action component is uniform over its range ([-1, 1), or [0, 1) for decoder `mpe2`), independent; a discrete action
//! is one of all, equally likely. Messages are the senders' observations.
//!
//! # Shapes and units
//! Actions as the scenario's decoder takes them.
//!
//! # Parameters
//! None.
//!
//! # When it fails
//! Under `mpe5` its force is triangular on [-2, 2], not uniform: returns differ from `force2`.
//!
//! # Reference
//! Common practice.
//!
//! # Differences from the reference implementation
//! None.

use serde_json::{Map, Value};

use super::{Build, Policy, PolicyEpisode, View};
use crate::registry::Entry;
use crate::rng::{Seeds, Stream};
use crate::scenario::Scenario;

/// The policy's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "random",
    summary: "uniform actions; messages are observations",
    reference: "common practice",
    value: None,
    build: |spec, _| {
        spec.no_params()?;
        Ok(Box::new(Random))
    },
};

struct Random;

struct Episode<'a> {
    scenario: &'a dyn Scenario,
    /// Per agent under policy control: where its action lies, and its own stream.
    actors: Vec<(std::ops::Range<usize>, Stream)>,
}

impl Policy for Random {
    fn parameters(&self) -> Map<String, Value> {
        super::resolved(ENTRY.name, &[])
    }

    fn start<'a>(&'a self, scenario: &'a dyn Scenario, seeds: &Seeds) -> Box<dyn PolicyEpisode + 'a> {
        let spans = super::policy_actions(scenario.agents());
        let actors = spans.into_iter().zip(0..).map(|(span, i)| (span, seeds.indexed_stream("agent", i))).collect();
        Box::new(Episode { scenario, actors })
    }
}

impl PolicyEpisode for Episode<'_> {
    fn send(&mut self, observations: &[f32], messages: &mut [f32]) {
        super::send_observations(self.scenario.agents(), observations, messages);
    }

    fn act(&mut self, _view: &View<'_>, actions: &mut [f32]) {
        let space = self.scenario.space();
        for (span, stream) in &mut self.actors {
            space.sample(stream, &mut actions[span.clone()]);
        }
    }
}
