//! # What it is
//! Any link, from a file: what `ccmarl fit-link --out` wrote, or a table written by hand.
//!
//! # Definition
//! The bits are those of the link in the file.
//!
//! # Shapes and units
//! A JSON document `{"kind": "ccmarl link", "link": {"name": …, …}, …}`; everything else in it is for the reader.
//!
//! # Parameters
//! `path` of the file (`file:link.json`). The manifest records the link itself and the file's SHA-256, so that what was
//! recorded can be made again without the file.
//!
//! # When it fails
//! The file is missing, over 16 MiB, not such a document, or its link does not fit the scenario.
//!
//! # Reference
//! The prior `f_θ` of arXiv 2512.03528, Eq. 1, in a form that can be handed on.
//!
//! # Differences from the reference implementation
//! None known.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Build, Link, LinkEpisode, Setting};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::hex;

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "file",
    summary: "a link that `ccmarl fit-link` wrote, or any other as JSON",
    reference: "arXiv 2512.03528, Eq. 1",
    value: Some("path"),
    build,
};

/// What `kind` says in such a file.
pub const FITTED_KIND: &str = "ccmarl link";

/// Largest file that is read, bytes.
pub const FITTED_LIMIT: u64 = 16 << 20;

/// From the command line: the path; from a manifest: the link too, and then the file is not read.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Params {
    path: PathBuf,
    #[serde(default)]
    sha256: Option<String>,
    #[serde(default)]
    link: Option<Spec>,
}

#[derive(Clone, Serialize)]
struct Resolved {
    path: PathBuf,
    sha256: String,
    link: Map<String, Value>,
}

struct Fitted {
    resolved: Resolved,
    link: Box<dyn Link>,
}

/// What of the document is read.
#[derive(Deserialize)]
struct Document {
    kind: String,
    link: Spec,
}

fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    let given: Params = spec.params()?;
    let (sha256, inner) = match (given.link, given.sha256) {
        (Some(link), Some(sha256)) => (sha256, link),
        (Some(_), None) => {
            return Err(spec
                .invalid("link stands without the sha256 of the file that it is from: give both, or the path alone"));
        }
        (None, sha256) => {
            let (found, document) = read(&given.path)?;
            if let Some(expected) = sha256.filter(|expected| *expected != found) {
                return Err(refused(
                    &format!("sha256 {expected} was recorded, found {found}: the file was changed"),
                    &given.path,
                ));
            }
            (found, document.link)
        }
    };
    let link = super::build_inner(spec, &inner, setting).map_err(|error| match error {
        RegistryError::Data(message) => RegistryError::Data(message),
        other => refused(&other.to_string(), &given.path),
    })?;
    let resolved = Resolved { path: given.path, sha256, link: link.parameters() };
    Ok(Box::new(Fitted { resolved, link }))
}

/// The file's SHA-256 and what it says.
fn read(path: &Path) -> Result<(String, Document), RegistryError> {
    use sha2::Digest as _;
    let text = crate::io::read_text(path, FITTED_LIMIT).map_err(|e| RegistryError::Data(e.to_string()))?;
    let document: Document = serde_json::from_str(&text).map_err(|e| {
        refused(
            &format!(
                "expected what `ccmarl fit-link --out` writes, {{\"kind\": {FITTED_KIND:?}, \"link\": {{…}}}}: {e}"
            ),
            path,
        )
    })?;
    if document.kind != FITTED_KIND {
        return Err(refused(&format!("kind: expected {FITTED_KIND:?}, found {:?}", document.kind), path));
    }
    Ok((hex(&sha2::Sha256::digest(text.as_bytes())), document))
}

fn refused(message: &str, path: &Path) -> RegistryError {
    RegistryError::Data(format!("link file: {message}: {}", path.display()))
}

impl Link for Fitted {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.resolved)
    }

    fn episodes(&self) -> Option<u64> {
        self.link.episodes()
    }

    fn start(&self, n: usize, episode: u64, seeds: &Seeds) -> Box<dyn LinkEpisode> {
        self.link.start(n, episode, seeds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{emit_rows, test_setting};

    fn file(text: &str) -> (tempfile::TempDir, Spec) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("link.json");
        crate::io::write_atomic(&path, text.as_bytes()).unwrap();
        (dir, Spec::new("file").with("path", path.to_str().unwrap()))
    }

    #[test]
    fn the_link_in_the_file_is_played_and_recorded_whole() {
        let (dir, spec) = file(r#"{"kind":"ccmarl link","link":{"name":"dropout","p":0.5},"fit":{"anything":1}}"#);
        let setting = test_setting(0.25);
        let link = build(&spec, &setting).unwrap();
        let alone = super::super::build(&Spec::new("dropout").with("p", 0.5), &setting).unwrap();
        assert_eq!(emit_rows(&*link, 3, 26, 5), emit_rows(&*alone, 3, 26, 5));
        assert_eq!(link.parameters()["link"], Value::Object(alone.parameters()));
        drop(dir);
        let again: Spec = serde_json::from_value(Value::Object(link.parameters())).unwrap();
        assert_eq!(build(&again, &setting).unwrap().parameters(), link.parameters(), "the file is gone");
        assert!(build(&spec, &setting).err().unwrap().to_string().starts_with("no such file or directory"));
    }

    #[test]
    fn a_digest_vouches_for_the_link_beside_it() {
        let (_dir, spec) = file(r#"{"kind":"ccmarl link","link":{"name":"dropout","p":0.5}}"#);
        let setting = test_setting(0.25);
        let other = spec.clone().with("link", serde_json::json!({"name": "perfect"}));
        let error = build(&other, &setting).err().unwrap().to_string();
        assert!(error.starts_with("file: link stands without the sha256 of the file that it is from"), "{error}");
        let sha256 = build(&spec, &setting).unwrap().parameters()["sha256"].clone();
        let vouched = build(&spec.clone().with("sha256", sha256), &setting).unwrap();
        assert_eq!(vouched.parameters()["link"]["name"], "dropout");
        let changed = build(&spec.with("sha256", "0".repeat(64)), &setting).err().unwrap().to_string();
        assert!(changed.contains("the file was changed"), "{changed}");
    }

    #[test]
    fn other_files_are_refused_with_what_is_needed() {
        let error = |text: &str| {
            let (_dir, spec) = file(text);
            build(&spec, &test_setting(0.25)).err().unwrap().to_string()
        };
        assert!(error("{").starts_with("link file: expected what `ccmarl fit-link --out` writes"), "{}", error("{"));
        let kind = error(r#"{"kind":"rollouts","link":"none"}"#);
        assert!(kind.starts_with("link file: kind: expected \"ccmarl link\", found \"rollouts\": /"), "{kind}");
        let range = error(r#"{"kind":"ccmarl link","link":{"name":"markov","matrix":[[1.5]]}}"#);
        assert!(range.starts_with("link file: markov: matrix row 0: probabilities must be in [0, 1]"), "{range}");
    }

    #[test]
    fn a_file_that_names_itself_ends() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("link.json");
        let text = serde_json::json!({"kind": FITTED_KIND, "link": {"name": "file", "path": path}}).to_string();
        crate::io::write_atomic(&path, text.as_bytes()).unwrap();
        let spec = Spec::new("file").with("path", path.to_str().unwrap());
        let error = build(&spec, &test_setting(0.25)).err().unwrap().to_string();
        assert!(error.contains("more than 4 deep"), "{error}");
    }
}
