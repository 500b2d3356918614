//! A configuration file: read over what is given beside it, and its faults shown where they are.

use std::path::Path;

use super::TrainError;
use super::config::TrainConfig;
use crate::registry::{RegistryError, Spec};

/// Largest configuration file that is read, bytes.
const LIMIT: u64 = 1 << 20;

/// Most characters of a line that are shown.
const SHOWN: usize = 160;

/// What is given beside a configuration file, which may then leave it out.
#[derive(Clone, Copy, Debug, Default)]
pub struct Given<'a> {
    /// The algorithm.
    pub algorithm: Option<&'a str>,
    /// The scenario.
    pub scenario: Option<&'a Spec>,
}

impl TrainConfig {
    /// Reads a TOML file, which may leave out what is given beside it; a typo is refused with its line, in the tables of
    /// plugins too.
    ///
    /// # Errors
    /// [`TrainError::Io`], [`TrainError::Config`].
    pub fn read(path: &Path, given: Given<'_>) -> Result<Self, TrainError> {
        let text = crate::io::read_text(path, LIMIT)?;
        let config = Self::from_text(&text, path, given)?;
        // a plugin's parameters are its own: what it refuses has no place in the file until it is looked for
        config.check_plugins().map_err(|error| {
            let line = line_of(&text, &error.to_string());
            let message = line.map_or_else(|| error.to_string(), |line| format!("line {line}: {error}"));
            TrainError::Config { message, excerpt: String::new(), path: path.to_owned() }
        })?;
        Ok(config)
    }

    /// Reads a run's own file, without building its scenario and prior: what those need (the trace of a prior) may be
    /// gone when the run itself is still good.
    ///
    /// # Errors
    /// As [`TrainConfig::read`].
    pub fn parse(path: &Path) -> Result<Self, TrainError> {
        Self::from_text(&crate::io::read_text(path, LIMIT)?, path, Given::default())
    }

    fn from_text(text: &str, path: &Path, given: Given<'_>) -> Result<Self, TrainError> {
        // what is given stands before the text where that does not have it, so that places in the text are known; a text
        // that is no TOML is left to tell its fault
        let has = |key: &str| text.parse::<toml::Table>().map_or(true, |table| table.contains_key(key));
        let given = [("algorithm", given.algorithm), ("scenario", given.scenario.map(|spec| spec.name.as_str()))];
        let missing = given.into_iter().filter(|(key, _)| !has(key));
        let line = |(key, value): (&str, Option<&str>)| Some(format!("{key} = {}\n", toml::Value::from(value?)));
        let before: String = missing.filter_map(line).collect();
        toml::from_str(&format!("{before}{text}")).map_err(|error| {
            let place = error.span().and_then(|span| place(text, span.start.checked_sub(before.len())?));
            let (at, excerpt) = match place {
                Some((line, column, code)) => {
                    let (width, code) = (line.to_string().len(), code.chars().take(SHOWN).collect::<String>());
                    let mark = if column > SHOWN { String::new() } else { format!("{:>column$}", "^") };
                    (format!("line {line}, column {column}: "), format!("{line} | {code}\n{:width$} | {mark}", ""))
                }
                None => Default::default(),
            };
            let message = format!("{at}{}", error.message().trim().replace('\n', "; "));
            TrainError::Config { message, excerpt, path: path.to_owned() }
        })
    }

    fn check_plugins(&self) -> Result<(), RegistryError> {
        let scenario = crate::scenario::build(&self.scenario)?;
        self.prior.as_ref().map_or(Ok(()), |prior| crate::record::build_link(prior, scenario.as_ref()).map(|_| ()))
    }
}

/// Line and column (in characters) of a byte of `text`, from 1, and the line itself.
fn place(text: &str, at: usize) -> Option<(usize, usize, &str)> {
    let before = text.get(..at)?;
    let start = before.rfind('\n').map_or(0, |end| end + 1);
    let line = before.matches('\n').count() + 1;
    Some((line, before[start..].chars().count() + 1, text[start..].lines().next().unwrap_or("")))
}

/// The first line of `text` that gives a value to a name which `error` quotes: a key or a plugin.
fn line_of(text: &str, error: &str) -> Option<usize> {
    let quoted: Vec<&str> = error.split(['`', '"']).skip(1).step_by(2).collect();
    // "simple_spread: agents: …" quotes nothing: the words before colons are names too
    let words = error.split(": ").map(|word| word.split(' ').next().unwrap_or(word));
    let names = quoted.into_iter().chain(words);
    let gives = |line: &str, name: &str| {
        let code = line.split('#').next().unwrap_or(line);
        code.match_indices(name).any(|(at, _)| {
            let whole = |c: Option<char>| c.is_none_or(|c| !c.is_alphanumeric() && c != '_' && c != '-');
            whole(code[..at].chars().next_back()) && whole(code[at + name.len()..].chars().next())
        })
    };
    names
        .filter(|name| !name.is_empty())
        .find_map(|name| text.lines().position(|line| gives(line, name)))
        .map(|line| line + 1)
}
