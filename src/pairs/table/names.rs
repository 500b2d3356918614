//! Columns by pattern.

use std::path::{Path, PathBuf};

use super::TableOptions;
use super::form::{TableFile, caught};
use crate::pairs::PairsError;

/// What a name begins with that is a pattern.
const PATTERN: &str = "regex:";

/// The options with every `regex:PATTERN` replaced by the columns that it matches, in the order of the file.
pub(super) fn expanded(file: &dyn TableFile, path: &Path, options: &TableOptions) -> Result<TableOptions, PairsError> {
    let mut out = options.clone();
    for list in [&mut out.x, &mut out.y, &mut out.given] {
        if !list.iter().any(|name| name.starts_with(PATTERN)) {
            continue;
        }
        let known = file.names()?;
        let mut found = Vec::new();
        for name in &*list {
            let Some(pattern) = name.strip_prefix(PATTERN) else {
                found.push(name.clone());
                continue;
            };
            let wrong =
                |message: String| PairsError::Pattern { pattern: pattern.to_owned(), message, path: path.to_owned() };
            let matcher = regex::Regex::new(pattern).map_err(|e| {
                wrong(format!("not a regular expression: {}", e.to_string().lines().last().unwrap_or_default()))
            })?;
            let matched: Vec<&String> = known.iter().filter(|name| matcher.is_match(name)).collect();
            if matched.is_empty() {
                let all = known.iter().take(40).map(String::as_str).collect::<Vec<_>>().join(", ");
                return Err(wrong(format!("matches no column; the columns are {all}")));
            }
            found.extend(matched.into_iter().cloned());
        }
        *list = found;
    }
    Ok(out)
}

/// All columns of the first file that can be read; and what is said of the others.
pub(super) fn of_first(paths: &[PathBuf]) -> Result<(Vec<String>, Vec<String>), PairsError> {
    let path = paths.first().ok_or_else(|| PairsError::NoFiles("no file was named".to_owned()))?;
    caught(path, |file| {
        let unusable = file.unusable()?;
        let mut names = file.names()?;
        names.retain(|name| !unusable.iter().any(|(other, _)| other == name));
        let said = unusable.into_iter().map(|(name, kind)| format!("column {name:?} holds {kind}"));
        Ok((names, said.collect()))
    })
}
