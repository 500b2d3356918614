//! Arguments that several commands share.

use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::Value;

use crate::Error;
use crate::registry::{RegistryError, Spec};
use crate::scenario::SCENARIOS;

/// Which scenario, and how it is changed.
#[derive(Debug, clap::Args)]
pub(super) struct ScenarioArgs {
    /// Scenario: name or name:agents
    #[arg(long)]
    pub(super) scenario: Option<String>,
    /// Number of agents under policy control [default: the scenario's]
    #[arg(long)]
    pub(super) agents: Option<u32>,
    /// Scenario parameter, as often as needed: key=value
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(super) overrides: Vec<String>,
}

impl ScenarioArgs {
    /// The scenario as named, or `base`, with `--agents` and `--set`; `None` when neither names one.
    pub(super) fn spec(&self, base: Option<Spec>) -> Result<Option<Spec>, Error> {
        let named = match &self.scenario {
            Some(text) => Some(Spec::parse("scenario", SCENARIOS, text)?),
            None => base,
        };
        let Some(mut spec) = named else { return Ok(None) };
        if let Some(agents) = self.agents {
            spec = spec.with("agents", agents);
        }
        for pair in &self.overrides {
            let Some((key, value)) = pair.split_once('=') else {
                let message = format!("--set takes key=value, found {pair:?}");
                return Err(RegistryError::Params { name: spec.name, message }.into());
            };
            let value = serde_json::from_str::<Value>(value).unwrap_or_else(|_| Value::from(value));
            spec = spec.with(key, value);
        }
        Ok(Some(spec))
    }
}

/// A flag that SIGINT and SIGTERM raise, so that a command can end in good order (exit code 4). One per process.
pub(super) fn stop_flag() -> anyhow::Result<&'static AtomicBool> {
    static STOP: AtomicBool = AtomicBool::new(false);
    match ctrlc::set_handler(|| STOP.store(true, Ordering::Relaxed)) {
        Ok(()) | Err(ctrlc::Error::MultipleHandlers) => Ok(&STOP),
        Err(error) => Err(error.into()),
    }
}
