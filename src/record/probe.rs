//! # What it is
//! Messages and actions of known mutual information: the ground truth for estimators on stores.
//!
//! # Definition
//! Every communicator sends m ~ N(0, 1). A receiver of k > 0 delivered messages acts
//! `a_0 = ρ Σ m / √k + √(1 − ρ²) ε`, else `a_0 = ε`, with ε ~ N(0, 1); other action components are independent N(0, 1).
//! With one sender `I(m; a_0)` = −½ ln(1 − ρ²) nats when delivered (0.4133 at ρ = 0.75). With more, each of the k delivered
//! messages shares −½ ln(1 − ρ²/k) with `a_0`, and over rows of mixed k the law is a mixture of these. A lost message
//! shares nothing.
//!
//! # Shapes and units
//! Messages `[1]`; actions as wide as the decoder's, not clamped to [-1, 1].
//!
//! # Parameters
//! `rho` in [-1, 1], required: `probe:0.75`.
//!
//! # When it fails
//! At |ρ| = 1 and one sender the action copies the message: information is infinite. Bodies drift far apart, so that
//! `distance` links soon lose everything.
//!
//! # Reference
//! The Gaussian channel; Cover and Thomas, ch. 8.
//!
//! # Differences from the reference implementation
//! None.

use serde::Deserialize;
use serde_json::{Map, Value};

use super::{Build, Policy, PolicyEpisode, View};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream, normal};
use crate::scenario::Scenario;
use crate::schema::{AgentSpec, Controller};

/// The policy's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "probe",
    summary: "Gaussian messages and actions of known mutual information (correlation rho)",
    reference: "the Gaussian channel, −½ ln(1 − ρ²) nats",
    value: Some("rho"),
    build,
};

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Probe {
    rho: f64,
}

fn build(spec: &Spec, scenario: &dyn Scenario) -> Result<Box<dyn Policy>, RegistryError> {
    let probe: Probe = spec.params()?;
    super::refuse_discrete(spec, scenario)?;
    spec.in_range("rho", probe.rho, -1.0, 1.0)?;
    Ok(Box::new(probe))
}

/// An agent's part in an episode.
struct Actor {
    /// Position among the communicators, for who communicates.
    communicator: Option<usize>,
    /// Where its action lies; empty for scripted agents.
    action: std::ops::Range<usize>,
    messages: Stream,
    noise: Stream,
}

struct Episode {
    rho: f64,
    communicators: usize,
    actors: Vec<Actor>,
}

impl Policy for Probe {
    fn parameters(&self) -> Map<String, Value> {
        super::resolved(ENTRY.name, &[("rho", Value::from(self.rho))])
    }

    fn message_width(&self, scenario: &dyn Scenario, agent: usize) -> usize {
        usize::from(scenario.agents()[agent].communicator)
    }

    fn start<'a>(&'a self, scenario: &'a dyn Scenario, seeds: &Seeds) -> Box<dyn PolicyEpisode + 'a> {
        let agents = scenario.agents();
        let mut communicators = 0;
        let spans = crate::scenario::offsets(agents, |a| a.action);
        let actor = |(i, agent): (usize, &AgentSpec)| {
            let own = agent.communicator.then_some(communicators);
            communicators += usize::from(agent.communicator);
            let policy = agent.controller == Controller::Policy;
            Actor {
                communicator: own,
                action: if policy { spans[i]..spans[i + 1] } else { 0..0 },
                messages: seeds.indexed_stream("message", i as u64),
                noise: seeds.indexed_stream("noise", i as u64),
            }
        };
        let actors = agents.iter().enumerate().map(actor).collect();
        Box::new(Episode { rho: self.rho, communicators, actors })
    }
}

impl PolicyEpisode for Episode {
    fn send(&mut self, _observations: &[f32], messages: &mut [f32]) {
        let senders = self.actors.iter_mut().filter(|a| a.communicator.is_some());
        for (message, sender) in messages.iter_mut().zip(senders) {
            *message = normal(&mut sender.messages) as f32;
        }
    }

    fn act(&mut self, view: &View<'_>, actions: &mut [f32]) {
        let n = self.communicators;
        for actor in &mut self.actors {
            let Some((first, others)) = actions[actor.action.clone()].split_first_mut() else { continue };
            let (mut sum, mut count) = (0.0, 0_u32);
            if let Some(receiver) = actor.communicator {
                for sender in (0..n).filter(|&s| s != receiver && view.link[s * n + receiver]) {
                    sum += f64::from(view.messages[sender]);
                    count += 1;
                }
            }
            let noise = normal(&mut actor.noise);
            *first = if count == 0 {
                noise
            } else {
                self.rho * sum / f64::from(count).sqrt() + (1.0 - self.rho * self.rho).sqrt() * noise
            } as f32;
            others.fill_with(|| normal(&mut actor.noise) as f32);
        }
    }
}
