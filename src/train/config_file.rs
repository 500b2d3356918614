//! A configuration file: read over what is given beside it, and its faults shown where they are.

use std::path::Path;

use super::TrainError;
use super::config::TrainConfig;
use crate::io::{IoError, printable, read_text};
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
    /// Reads a TOML file, which may leave out what is given beside it; a typo is refused with its line. Scenario and prior
    /// are not built: that is [`TrainConfig::check_plugins`], once all that is given is laid over the file.
    ///
    /// # Errors
    /// [`TrainError::Io`], [`TrainError::Config`].
    pub fn read(path: &Path, given: Given<'_>) -> Result<Self, TrainError> {
        Self::from_text(&file_text(path)?, path, given)
    }

    /// Reads a run's own file. What its scenario and prior need (the trace of a prior) may be gone when the run itself is
    /// still good.
    ///
    /// # Errors
    /// As [`TrainConfig::read`].
    pub fn parse(path: &Path) -> Result<Self, TrainError> {
        Self::read(path, Given::default())
    }

    /// Builds scenario and prior. What one is refused for that stands in the file at `path` as it is here, as `read` from
    /// there says, is told with its line.
    ///
    /// # Errors
    /// [`TrainError::Config`] for what the file says, [`TrainError::Registry`] for what was given beside it.
    pub fn check_plugins(&self, path: &Path, read: &Self) -> Result<(), TrainError> {
        // a plugin's parameters are its own: what it refuses has no place in the file until it is looked for
        let placed = |error: RegistryError, own: bool| {
            if !own {
                return error.into();
            }
            let line = file_text(path).ok().and_then(|text| line_of(&text, &error.to_string()));
            let message = line.map_or_else(|| error.to_string(), |line| format!("line {line}: {error}"));
            TrainError::Config { message, excerpt: String::new(), path: path.to_owned() }
        };
        let scenario =
            crate::scenario::build(&self.scenario).map_err(|error| placed(error, self.scenario == read.scenario))?;
        let Some(prior) = &self.prior else { return Ok(()) };
        let built = crate::record::build_link(prior, scenario.as_ref());
        built.map(|_| ()).map_err(|error| placed(error, self.prior == read.prior))
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
            let message = error.message().trim().replace('\n', "; ");
            let place = error.span().and_then(|span| place(text, span.start.checked_sub(before.len())?));
            let (at, excerpt) = match place {
                // nothing that stands there is wrong
                Some((line, column, _)) if message.starts_with("missing field") => {
                    (format!("line {line}, column {column}: "), String::new())
                }
                Some((line, column, code)) => (format!("line {line}, column {column}: "), excerpt(line, column, code)),
                None => Default::default(),
            };
            TrainError::Config { message: format!("{at}{message}"), excerpt, path: path.to_owned() }
        })
    }
}

/// A file's text without the mark that some editors put before it.
fn file_text(path: &Path) -> Result<String, IoError> {
    let mut text = read_text(path, LIMIT)?;
    if text.starts_with('\u{feff}') {
        text.drain(..'\u{feff}'.len_utf8());
    }
    Ok(text)
}

/// A line as it is shown, a tab as one space and what a terminal obeys escaped, and a mark below its column.
fn excerpt(line: usize, column: usize, code: &str) -> String {
    let shown = |characters: usize| printable(&code.chars().take(characters).collect::<String>().replace('\t', " "));
    let (width, at) = (line.to_string().len(), shown(column - 1).chars().count() + 1);
    let mark = if column > SHOWN { String::new() } else { format!("{:>at$}", "^") };
    format!("{line} | {}\n{:width$} | {mark}", shown(SHOWN), "")
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mark_stands_below_its_place_behind_a_tab_and_behind_what_is_shown_escaped() {
        assert_eq!(excerpt(12, 3, "\ta = 1"), "12 |  a = 1\n   |   ^");
        assert_eq!(excerpt(3, 3, "\u{1b}ab"), format!("3 | \\u{{1b}}ab\n  | {:>8}", "^"));
        assert_eq!(excerpt(3, 161, &"é".repeat(200)), format!("3 | {}\n  | ", "é".repeat(160)));
    }
}
