//! # What it is
//! The scenario's oracle: a hand-written rule that sees the whole state. The upper reference row of every table.
//!
//! # Definition
//! What the scenario's file says under its oracle. Messages are the senders' observations.
//!
//! # Shapes and units
//! Actions as the scenario's decoder takes them.
//!
//! # Parameters
//! None.
//!
//! # When it fails
//! It is a good rule, not the best one: a trained policy may beat it.
//!
//! # Reference
//! This program.
//!
//! # Differences from the reference implementation
//! None.

use serde_json::{Map, Value};

use super::{Build, Policy, PolicyEpisode, View};
use crate::registry::Entry;
use crate::rng::Seeds;
use crate::scenario::Scenario;

/// The policy's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "scripted",
    summary: "the scenario's oracle, which sees everything",
    reference: "this program",
    value: None,
    build: |spec, _| {
        spec.no_params()?;
        Ok(Box::new(Scripted))
    },
};

struct Scripted;

struct Episode<'a> {
    scenario: &'a dyn Scenario,
}

impl Policy for Scripted {
    fn parameters(&self) -> Map<String, Value> {
        super::resolved(ENTRY.name, &[])
    }

    fn start<'a>(&'a self, scenario: &'a dyn Scenario, _seeds: &Seeds) -> Box<dyn PolicyEpisode + 'a> {
        Box::new(Episode { scenario })
    }
}

impl PolicyEpisode for Episode<'_> {
    fn send(&mut self, observations: &[f32], messages: &mut [f32]) {
        super::send_observations(self.scenario.agents(), observations, messages);
    }

    fn act(&mut self, view: &View<'_>, actions: &mut [f32]) {
        self.scenario.oracle(view.state, actions);
    }
}
