//! What all particle scenarios take: profile, number of agents, laws of motion, limits that may be absent.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::{ActionSpace, Body, Decoder, Integration, Laws};
use crate::registry::{RegistryError, Spec};

/// Most agents of a scenario: observations grow as the square of it.
pub const MAX_AGENTS: usize = 1000;

/// A consistent set of defaults.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Profile {
    /// What the numbers of arXiv 2512.03528 come from, as far as it can be told.
    Paper,
    /// `PyPI` mpe2 1.1.1.
    Mpe2,
}

/// The parameters that every scenario has.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Common {
    /// Which defaults the others have.
    pub(super) profile: Profile,
    /// N; what it counts is the scenario's.
    pub(super) agents: usize,
    /// T: 1 to 10000.
    pub(super) steps: usize,
    /// From action to force.
    pub(super) decoder: Decoder,
    /// Whether actions are one of five moves (and one of the words).
    pub(super) discrete: bool,
    /// Seconds in a step: [1e-4, 1].
    pub(super) dt: f64,
    /// Share of velocity lost per step: [0, 1].
    pub(super) damping: f64,
    /// Force per unit of overlap: [0, 1e4].
    pub(super) contact_force: f64,
    /// Softness of contacts: [1e-9, 1].
    pub(super) contact_margin: f64,
    /// Order of integration.
    pub(super) integration: Integration,
    /// Half width of the square in which agents start: [0, 100].
    pub(super) arena: f64,
}

impl Common {
    /// The defaults of a profile.
    pub(super) fn of(profile: Profile, agents: usize) -> Self {
        let (decoder, integration) = match profile {
            Profile::Paper => (Decoder::Force2, Integration::VelocityFirst),
            Profile::Mpe2 => (Decoder::Mpe2, Integration::PositionFirst),
        };
        Self {
            profile,
            agents,
            steps: 25,
            decoder,
            discrete: false,
            dt: 0.1,
            damping: 0.25,
            contact_force: 100.0,
            contact_margin: 1e-3,
            integration,
            arena: 1.0,
        }
    }

    /// Checks every range; the scenario takes from `fewest` to `most` agents.
    pub(super) fn check(&self, spec: &Spec, fewest: usize, most: usize) -> Result<(), RegistryError> {
        if !(fewest..=most).contains(&self.agents) {
            return Err(spec.invalid(format!("agents must be in [{fewest}, {most}], found {}", self.agents)));
        }
        if !(1..=10_000).contains(&self.steps) {
            return Err(spec.invalid(format!("steps must be in [1, 10000], found {}", self.steps)));
        }
        if self.discrete && self.decoder == Decoder::Force2 {
            return Err(
                spec.invalid("discrete actions are moves of decoder mpe5 or mpe2, found force2: set decoder=mpe5")
            );
        }
        spec.in_range("dt", self.dt, 1e-4, 1.0)?;
        spec.in_range("damping", self.damping, 0.0, 1.0)?;
        spec.in_range("contact_force", self.contact_force, 0.0, 1e4)?;
        spec.in_range("contact_margin", self.contact_margin, 1e-9, 1.0)?;
        spec.in_range("arena", self.arena, 0.0, 100.0)
    }

    pub(super) fn laws(&self) -> Laws {
        Laws {
            dt: self.dt,
            damping: self.damping,
            contact_force: self.contact_force,
            contact_margin: self.contact_margin,
            integration: self.integration,
        }
    }

    pub(super) fn space(&self, words: usize) -> ActionSpace {
        ActionSpace { decoder: self.decoder, discrete: self.discrete, words }
    }
}

/// The bodies of the agents, where all are alike.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct AgentBodies {
    /// Gain from control to force: [0, 100].
    pub(super) accel: f64,
    /// Top speed: (0, 100], or none.
    pub(super) max_speed: Maybe,
    /// Radius of an agent: [0, 1].
    pub(super) agent_size: f64,
    /// Whether bodies push each other.
    pub(super) collide: bool,
}

impl AgentBodies {
    /// Bodies of this size, with the gain of the original code and no top speed.
    pub(super) fn of(agent_size: f64, collide: bool) -> Self {
        Self { accel: 5.0, max_speed: Maybe(None), agent_size, collide }
    }

    /// Checks every range.
    pub(super) fn check(&self, spec: &Spec) -> Result<(), RegistryError> {
        spec.in_range("accel", self.accel, 0.0, 100.0)?;
        self.max_speed.check(spec, "max_speed", f64::MIN_POSITIVE, 100.0)?;
        spec.in_range("agent_size", self.agent_size, 0.0, 1.0)
    }

    pub(super) fn body(&self) -> Body {
        let Self { accel, max_speed, agent_size: size, collide } = *self;
        Body { size, accel, max_speed: max_speed.or_infinite(), collide }
    }
}

/// Reads a scenario's parameters over the defaults of the profile they name.
pub(super) fn read<P: Serialize + DeserializeOwned>(spec: &Spec, of: fn(Profile) -> P) -> Result<P, RegistryError> {
    let profile = match spec.params.get("profile") {
        None => Profile::Paper,
        Some(named) => serde_json::from_value(named.clone())
            .map_err(|_error| spec.invalid(format!("profile must be \"paper\" or \"mpe2\", found {named}")))?,
    };
    spec.params_over(&of(profile))
}

/// A number that may be absent, written `none` (JSON `null` is read too; TOML has none).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Maybe(pub(super) Option<f64>);

impl Maybe {
    /// The number; infinite when absent, as a limit.
    pub(super) fn or_infinite(self) -> f64 {
        self.0.unwrap_or(f64::INFINITY)
    }

    /// Checks that the number, where there is one, lies in `[low, high]`.
    pub(super) fn check(self, spec: &Spec, key: &str, low: f64, high: f64) -> Result<(), RegistryError> {
        match self.0 {
            Some(value) if !(value >= low && value <= high) => {
                Err(spec.invalid(format!("{key} must be in [{low}, {high}] or none, found {value}")))
            }
            _ => Ok(()),
        }
    }
}

impl Serialize for Maybe {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            Some(value) => serializer.serialize_f64(value),
            None => serializer.serialize_str("none"),
        }
    }
}

impl<'de> Deserialize<'de> for Maybe {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        match serde_json::Value::deserialize(deserializer)? {
            serde_json::Value::Null => Ok(Self(None)),
            serde_json::Value::String(word) if word == "none" => Ok(Self(None)),
            other => match other.as_f64() {
                Some(value) => Ok(Self(Some(value))),
                None => Err(serde::de::Error::custom(format!("expected a number or none, found {other}"))),
            },
        }
    }
}
