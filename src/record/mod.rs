//! Recording: scenario × policy × link → episodes, parallel over episodes, the same bytes for any number of threads.

mod probe;
mod random;
mod resimulate;
mod rollout;
mod run;
mod scripted;
mod trace;

use serde_json::{Map, Value};

pub use resimulate::{Difference, FLOAT_TOLERANCE, Resimulation, STATE_TOLERANCE, scenario_of};
pub use rollout::{EpisodeReturn, Options, Recorded, Recording, loss_rate, returns};
pub use run::{ActionNoise, Trained};
pub use trace::{is_link_table, read_trace};

use crate::link::{self, Link, Setting};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::scenario::Scenario;
use crate::schema::{AgentSpec, Controller};
use crate::storage::StorageError;

/// All policies that can be recorded.
pub const POLICIES: &[Entry<Build>] = &[probe::ENTRY, random::ENTRY, run::ENTRY, scripted::ENTRY];

/// What goes wrong when recording.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Nothing to record.
    #[error("expected at least 1 episode, found 0: give --episodes")]
    NoEpisodes,
    /// The store.
    #[error(transparent)]
    Storage(#[from] StorageError),
    /// A scenario that the manifest names cannot be built.
    #[error(transparent)]
    Scenario(#[from] RegistryError),
    /// The store's columns, states or actions are not those of its scenario.
    #[error("the store does not fit the scenario that its manifest names: {0}")]
    Mismatch(String),
    /// A link that ends before the recording does.
    #[error(
        "the trace behind the link holds {found} episodes, and {needed} are asked for: ask for {found} or fewer, or set its `cycle` to start again"
    )]
    LinkEnds {
        /// Episodes it has.
        found: u64,
        /// Episodes asked for.
        needed: u64,
    },
    /// The operating system gave no threads.
    #[error("could not start {threads} threads: {reason}: give fewer with --threads")]
    Threads {
        /// How many were asked for; 0 for one per core.
        threads: usize,
        /// The reason given.
        reason: String,
    },
}

/// Builds a policy for a scenario.
pub type Build = fn(&Spec, &dyn Scenario) -> Result<Box<dyn Policy>, RegistryError>;

/// Builds the policy that `spec` names.
///
/// # Errors
/// [`RegistryError`] for an unknown name, a parameter out of its range, or a run that does not fit the scenario.
pub fn build_policy(spec: &Spec, scenario: &dyn Scenario) -> Result<Box<dyn Policy>, RegistryError> {
    (crate::registry::find("policy", POLICIES, &spec.name)?.build)(spec, scenario)
}

/// What a link may want to know about a scenario.
pub fn link_setting(scenario: &dyn Scenario) -> Setting {
    let layout = scenario.layout();
    let names: Vec<String> = layout.communicators().iter().map(|&a| layout.agents[a].name.clone()).collect();
    let body_fields = names.first().map(|name| layout.body_fields(name)).unwrap_or_default();
    let mut setting = Setting::new(scenario.link_unit(), read_trace);
    (setting.communicators, setting.body_fields, setting.steps) = (names, body_fields, scenario.steps());
    setting
}

/// Builds a link for a scenario.
///
/// # Errors
/// [`RegistryError`] for an unknown name, a parameter out of its range, a file that cannot be used, or a link that does
/// not fit the scenario.
pub fn build_link(spec: &Spec, scenario: &dyn Scenario) -> Result<Box<dyn Link>, RegistryError> {
    link::build(spec, &link_setting(scenario))
}

/// Refuses to play more episodes than the link has.
///
/// # Errors
/// [`RecordError::LinkEnds`].
pub fn check_link(link: &dyn Link, needed: u64) -> Result<(), RecordError> {
    match link.episodes() {
        Some(found) if found < needed => Err(RecordError::LinkEnds { found, needed }),
        _ => Ok(()),
    }
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
    fn start<'a>(&'a self, scenario: &'a dyn Scenario, seeds: &Seeds) -> Box<dyn PolicyEpisode + 'a>;

    /// The policy's state for episodes that are played together, number `first` and on, each with its own node. What
    /// an episode does must not depend on the others; a policy that gains from many rows at once says how.
    fn start_together<'a>(
        &'a self,
        scenario: &'a dyn Scenario,
        _first: u64,
        nodes: &[Seeds],
    ) -> Box<dyn PolicyEpisode + 'a> {
        Box::new(OneByOne {
            widths: Widths::of(scenario, self.message_widths(scenario)),
            episodes: nodes.iter().map(|seeds| self.start(scenario, seeds)).collect(),
        })
    }

    /// What every agent sends, element counts.
    fn message_widths(&self, scenario: &dyn Scenario) -> Vec<usize> {
        let width =
            |(i, agent): (usize, &AgentSpec)| if agent.communicator { self.message_width(scenario, i) } else { 0 };
        scenario.agents().iter().enumerate().map(width).collect()
    }
}

/// What a policy sees at one step. Flat buffers concatenate the agents in order, and worlds one after the other.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The worlds' states before the action.
    pub state: &'a [f64],
    /// `[Σ observation]` per world.
    pub observations: &'a [f32],
    /// `[Σ message]` per world, as sent, before the channel.
    pub messages: &'a [f32],
    /// Link bits `[sender][receiver]` over the communicators, per world.
    pub link: &'a [bool],
}

/// One episode of a policy, or several together: per row `send`, then (but on the last row) `act`.
pub trait PolicyEpisode {
    /// Writes the communicators' messages `[Σ message]`; by default each sends its observation.
    fn send(&mut self, observations: &[f32], messages: &mut [f32]);

    /// Writes the actions of all agents under policy control into the flat `[Σ action]` buffer.
    fn act(&mut self, view: &View<'_>, actions: &mut [f32]);
}

/// Elements of one world's part of each flat buffer.
#[derive(Clone, Copy, Debug)]
struct Widths {
    state: usize,
    observations: usize,
    messages: usize,
    link: usize,
    actions: usize,
}

impl Widths {
    fn of(scenario: &dyn Scenario, messages: Vec<usize>) -> Self {
        let agents = scenario.agents();
        let communicators = agents.iter().filter(|a| a.communicator).count();
        Self {
            state: scenario.shape().width(),
            observations: agents.iter().map(|a| a.observation).sum(),
            messages: messages.into_iter().sum(),
            link: communicators * communicators,
            actions: agents.iter().map(|a| a.action).sum(),
        }
    }
}

/// World `world`'s part of a flat buffer.
fn part<T>(buffer: &[T], width: usize, world: usize) -> &[T] {
    &buffer[world * width..(world + 1) * width]
}

/// World `world`'s part of a flat buffer, to write.
fn part_mut<T>(buffer: &mut [T], width: usize, world: usize) -> &mut [T] {
    &mut buffer[world * width..(world + 1) * width]
}

/// Episodes that are played together by a policy that acts in one world at a time.
struct OneByOne<'a> {
    widths: Widths,
    episodes: Vec<Box<dyn PolicyEpisode + 'a>>,
}

impl PolicyEpisode for OneByOne<'_> {
    fn send(&mut self, observations: &[f32], messages: &mut [f32]) {
        let w = self.widths;
        for (world, episode) in self.episodes.iter_mut().enumerate() {
            episode.send(part(observations, w.observations, world), part_mut(messages, w.messages, world));
        }
    }

    fn act(&mut self, view: &View<'_>, actions: &mut [f32]) {
        let w = self.widths;
        for (world, episode) in self.episodes.iter_mut().enumerate() {
            let own = View {
                state: part(view.state, w.state, world),
                observations: part(view.observations, w.observations, world),
                messages: part(view.messages, w.messages, world),
                link: part(view.link, w.link, world),
            };
            episode.act(&own, part_mut(actions, w.actions, world));
        }
    }
}

/// Copies each sender's observation into its message: the default content of messages.
pub fn send_observations(agents: &[AgentSpec], observations: &[f32], messages: &mut [f32]) {
    let (mut o, mut m) = (0, 0);
    for agent in agents {
        messages[m..m + agent.message].copy_from_slice(&observations[o..o + agent.message]);
        o += agent.observation;
        m += agent.message;
    }
}

/// Refuses a scenario of discrete actions, for policies whose actions are vectors.
fn refuse_discrete(spec: &Spec, scenario: &dyn Scenario) -> Result<(), RegistryError> {
    if scenario.space().discrete {
        return Err(spec.invalid("its actions are continuous, the scenario's are discrete: set discrete=false"));
    }
    Ok(())
}

/// Where the actions of each agent under policy control lie in the flat buffer.
fn policy_actions(agents: &[AgentSpec]) -> Vec<std::ops::Range<usize>> {
    let offsets = crate::scenario::offsets(agents, |a| a.action);
    let spans = offsets.windows(2).map(|w| w[0]..w[1]);
    spans.zip(agents).filter(|(_, a)| a.controller == Controller::Policy).map(|(span, _)| span).collect()
}

/// Parameters as the manifest records them: the name, then the given fields.
fn resolved(name: &str, fields: &[(&str, Value)]) -> Map<String, Value> {
    let fields = fields.iter().map(|(k, v)| ((*k).to_owned(), v.clone()));
    std::iter::once(("name".to_owned(), Value::from(name))).chain(fields).collect()
}
