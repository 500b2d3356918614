//! Which files a command line means.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::PairsError;

/// The paths, each once, in the order of the command line; one that does not exist and has `*`, `?` or `[` in it stands
/// for the files that it matches, in the order of their names.
///
/// # Errors
/// [`PairsError::NoFiles`] when a pattern is none, [`PairsError::NoMatch`] when it matches nothing.
pub fn matching(paths: &[PathBuf]) -> Result<Vec<PathBuf>, PairsError> {
    let (mut out, mut known) = (Vec::new(), BTreeSet::new());
    let mut add = |path: &Path| {
        if known.insert(path.canonicalize().unwrap_or_else(|_e| path.to_owned())) {
            out.push(path.to_owned());
        }
    };
    for path in paths {
        let text = path.to_string_lossy();
        if path.exists() || !text.contains(['*', '?', '[']) {
            add(path);
            continue;
        }
        let fail = |message: String| PairsError::NoFiles(format!("{message}: {}", path.display()));
        let found = glob::glob(&text).map_err(|error| fail(format!("not a pattern of file names: {error}")))?;
        let mut matched = false;
        for file in found {
            matched = true;
            add(&file.map_err(|error| fail(format!("a directory could not be read: {error}")))?);
        }
        if !matched {
            return Err(PairsError::NoMatch(path.clone()));
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_stand_for_files_in_order_and_each_file_is_there_once() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["b.csv", "a.csv", "c.tsv", "[d].csv"] {
            crate::io::write_atomic(&at(name), b"").unwrap();
        }
        let found = |names: &[&str]| matching(&names.iter().map(|name| at(name)).collect::<Vec<_>>());
        assert_eq!(found(&["*.csv"]).unwrap(), [at("[d].csv"), at("a.csv"), at("b.csv")]);
        assert_eq!(found(&["c.tsv", "?.csv", "./a.csv"]).unwrap(), [at("c.tsv"), at("a.csv"), at("b.csv")]);
        assert_eq!(found(&["a.csv", "a.*"]).unwrap(), [at("a.csv")]);
        // a name that is there is no pattern, and what is not there is told by who opens it
        assert_eq!(found(&["[d].csv", "none.csv"]).unwrap(), [at("[d].csv"), at("none.csv")]);
        let none = found(&["*.npy"]).unwrap_err().to_string();
        assert!(none.starts_with("no file matches: ") && none.ends_with("*.npy"), "{none}");
        let wrong = found(&["a[.csv"]).unwrap_err().to_string();
        assert!(wrong.starts_with("not a pattern of file names: "), "{wrong}");
    }
}
