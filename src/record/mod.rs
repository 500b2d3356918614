//! Recording: scenario × policy × link → episodes, parallel over episodes, the same bytes for any number of threads.

use serde_json::{Map, Value};

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::scenario::{Scenario, World};

/// All policies that can be recorded.
pub const POLICIES: &[Entry<Build>] = &[];

/// Builds a policy for a scenario.
pub type Build = fn(&Spec, &dyn Scenario) -> Result<Box<dyn Policy>, RegistryError>;

/// Builds the policy that `spec` names.
///
/// # Errors
/// [`RegistryError`] for an unknown name, a parameter out of its range, or a run that does not fit the scenario.
pub fn build_policy(
    spec: &Spec,
    scenario: &dyn Scenario,
) -> Result<Box<dyn Policy>, RegistryError> {
    (crate::registry::find("policy", POLICIES, &spec.name)?.build)(spec, scenario)
}

/// Chooses messages and actions of the agents under policy control.
pub trait Policy: Send + Sync {
    /// Every parameter, resolved, for the manifest.
    fn parameters(&self) -> Map<String, Value>;

    /// Width of the message that agent `agent` sends; by default what the scenario says (its observation).
    fn message_width(&self, scenario: &dyn Scenario, agent: usize) -> usize {
        scenario.agents()[agent].message
    }

    /// The policy's state for one episode; `seeds` is the episode's own node of the seed tree.
    fn start<'a>(
        &'a self,
        scenario: &'a dyn Scenario,
        seeds: &Seeds,
    ) -> Box<dyn PolicyEpisode + 'a>;
}

/// What a policy sees at one step. Flat buffers concatenate the agents in order.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The world before the action.
    pub world: &'a World,
    /// `[Σ observation]`.
    pub observations: &'a [f32],
    /// `[Σ message]`, as sent, before the channel.
    pub messages: &'a [f32],
    /// Link bits `[sender][receiver]` over the communicators.
    pub link: &'a [bool],
}

/// One episode of a policy: per row `send`, then (but on the last row) `act`.
pub trait PolicyEpisode {
    /// Writes the communicators' messages `[Σ message]`; by default each sends its observation.
    fn send(&mut self, observations: &[f32], messages: &mut [f32]);

    /// Writes the actions of all agents under policy control into the flat `[Σ action]` buffer.
    fn act(&mut self, view: &View<'_>, actions: &mut [f32]);
}
