//! What two configurations differ in.

use std::collections::BTreeMap;

use super::TrainError;
use super::config::TrainConfig;

/// One line per setting that differs, `steps` excepted: a run may be continued for longer.
pub(super) fn between(old: &TrainConfig, new: &TrainConfig) -> Result<Vec<String>, TrainError> {
    let (old, new) = (settings(old)?, settings(new)?);
    let keys: std::collections::BTreeSet<&String> = old.keys().chain(new.keys()).collect();
    let shown = |map: &BTreeMap<String, String>, key: &str| map.get(key).map_or("unset".to_owned(), Clone::clone);
    let line = |key: &String| format!("{key} was {}, is {}", shown(&old, key), shown(&new, key));
    Ok(keys.into_iter().filter(|key| *key != "steps" && old.get(*key) != new.get(*key)).map(line).collect())
}

/// Every setting under its dotted name, as config.toml writes it.
fn settings(config: &TrainConfig) -> Result<BTreeMap<String, String>, TrainError> {
    let read = toml::from_str(&config.to_toml()?);
    let table = read.map_err(|e| TrainError::Value { name: "config".to_owned(), message: e.to_string() })?;
    Ok(crate::registry::dotted(&table))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::Spec;

    #[test]
    fn every_changed_setting_is_named_with_both_values_but_not_the_steps() {
        let old = TrainConfig::new(Spec::new("simple_spread").with("agents", 3), "maddpg");
        let mut new = old.clone();
        (new.steps, new.seed, new.maddpg.gamma) = (7, 2, 0.5);
        new.scenario = Spec::new("simple_spread");
        let lines = between(&old, &new).unwrap();
        assert_eq!(lines, ["maddpg.gamma was 0.95, is 0.5", "scenario.agents was 3, is unset", "seed was 1, is 2"]);
        assert_eq!(between(&old, &old).unwrap(), [""; 0]);
    }
}
