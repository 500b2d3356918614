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

/// Raised by SIGINT and SIGTERM.
static STOP: AtomicBool = AtomicBool::new(false);
/// Whether a command ends by itself when [`STOP`] is raised.
static ENDS_ITSELF: AtomicBool = AtomicBool::new(false);
/// Whether a second signal ends the process even so.
static SECOND_ENDS: AtomicBool = AtomicBool::new(false);

/// A flag that SIGINT and SIGTERM raise, so that a command can end in good order (exit code 4). One per process.
pub(super) fn stop_flag() -> anyhow::Result<&'static AtomicBool> {
    ENDS_ITSELF.store(true, Ordering::SeqCst);
    handle_signals()?;
    Ok(&STOP)
}

/// As [`stop_flag`], for commands that lose nothing when a second signal ends the process; a command around this one
/// that has a [`stop_flag`] goes before.
pub(super) fn stop_or_end() -> anyhow::Result<&'static AtomicBool> {
    if !ENDS_ITSELF.load(Ordering::SeqCst) {
        SECOND_ENDS.store(true, Ordering::SeqCst);
    }
    stop_flag()
}

/// Lets SIGINT and SIGTERM end the process with exit code 4, for commands whose outputs appear whole at their end; a
/// command around this one that has a [`stop_flag`] goes before.
pub(super) fn end_on_signals() -> anyhow::Result<()> {
    handle_signals()
}

fn handle_signals() -> anyhow::Result<()> {
    #[expect(clippy::exit, reason = "the handler's thread cannot return to the command's")]
    let handler = || {
        let again = STOP.swap(true, Ordering::SeqCst);
        if !ENDS_ITSELF.load(Ordering::SeqCst) {
            super::ui::say("interrupted: nothing was written");
            std::process::exit(4);
        }
        if again && SECOND_ENDS.load(Ordering::SeqCst) {
            super::ui::say("interrupted again: ended at once");
            std::process::exit(4);
        }
    };
    match ctrlc::set_handler(handler) {
        Ok(()) | Err(ctrlc::Error::MultipleHandlers) => Ok(()),
        Err(error) => Err(error.into()),
    }
}
