//! The manifest: what a store holds, how it was made, and the digests that guard it.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest as _, Sha256};

use super::{AgentSpec, Layout, SCHEMA_VERSION, SchemaError};

/// What stands in `self_sha256` while the digest is taken.
pub const SELF_SHA256_PLACEHOLDER: &str = "0000000000000000000000000000000000000000000000000000000000000000";

/// One file of a store.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// File name inside the store's directory: a bare name, never a path.
    pub file: String,
    /// First episode, and one past the last.
    pub episodes: [u64; 2],
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256 of the file, 64 hex digits.
    pub sha256: String,
    /// SHA-256 over the content hashes of its episodes, 64 hex digits.
    pub content: String,
}

/// The manifest of a rollout store, the same JSON in every container.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Schema version of the data.
    pub schema_version: u32,
    /// Program version that wrote it.
    pub ccmarl: String,
    /// `rollouts`.
    pub kind: String,
    /// Seed of the recording.
    pub seed: u64,
    /// Episodes in the store.
    pub episodes: u64,
    /// Steps (rows with an action) in the store.
    pub steps: u64,
    /// Episodes that were to be recorded, while they are not all there; 0 in a complete store, or when nobody knew.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub planned: u64,
    /// In an unsealed manifest: what is making the store, unless it is a recording. `convert` does.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub task: String,
    /// In a store that was saved from a damaged one: the numbers that its episodes had there, as ranges \[from, to).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub kept: Vec<[u64; 2]>,
    /// Scenario name, profile and every constant.
    pub scenario: Value,
    /// Link prior and its parameters.
    pub link: Value,
    /// Policy and its parameters.
    pub policy: Value,
    /// Agents in order.
    pub agents: Vec<AgentSpec>,
    /// Names of the state vector's elements.
    pub state_fields: Vec<String>,
    /// SHA-256 over the content hashes of all episodes in order, 64 hex digits; empty until sealed.
    #[serde(default)]
    pub content: String,
    /// Files of a directory store; empty for a single file.
    #[serde(default)]
    pub parts: Vec<Part>,
    /// SHA-256 of this text with these digits written as zeros.
    #[serde(default)]
    pub self_sha256: String,
}

impl Manifest {
    /// An unsealed manifest for a recording that is about to start.
    pub fn new(seed: u64, scenario: Value, link: Value, policy: Value, layout: &Layout) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            ccmarl: env!("CARGO_PKG_VERSION").to_owned(),
            kind: "rollouts".to_owned(),
            seed,
            episodes: 0,
            steps: 0,
            planned: 0,
            task: String::new(),
            kept: Vec::new(),
            scenario,
            link,
            policy,
            agents: layout.agents.clone(),
            state_fields: layout.state_fields.clone(),
            content: String::new(),
            parts: Vec::new(),
            self_sha256: String::new(),
        }
    }

    /// The shape of its episodes.
    pub fn layout(&self) -> Layout {
        Layout { agents: self.agents.clone(), state_fields: self.state_fields.clone() }
    }

    /// The manifest of a recording of the same episodes that is about to start.
    #[must_use]
    pub fn unsealed(&self) -> Self {
        let planned = if self.planned == 0 { self.episodes } else { self.planned };
        let (content, parts, self_sha256) = (String::new(), Vec::new(), String::new());
        Self { episodes: 0, steps: 0, planned, content, parts, self_sha256, ..self.clone() }
    }

    /// The JSON text with `self_sha256` filled in.
    ///
    /// # Errors
    /// [`SchemaError::Manifest`] when it cannot be written as JSON.
    pub fn sealed_json(&self) -> Result<String, SchemaError> {
        let zeroed = Self { self_sha256: SELF_SHA256_PLACEHOLDER.to_owned(), ..self.clone() };
        let text = serde_json::to_string_pretty(&zeroed).map_err(|e| SchemaError::Manifest(e.to_string()))? + "\n";
        let digest = hex(&Sha256::digest(text.as_bytes()));
        Ok(text.replacen(
            &format!("\"self_sha256\": \"{SELF_SHA256_PLACEHOLDER}\""),
            &format!("\"self_sha256\": \"{digest}\""),
            1,
        ))
    }

    /// Reads and checks a manifest: version, layout, part names, and `self_sha256` over the text.
    ///
    /// # Errors
    /// [`SchemaError::Version`] for a newer schema, [`SchemaError::Manifest`] for anything else.
    pub fn parse(text: &str) -> Result<Self, SchemaError> {
        let manifest = Self::read(text)?;
        let zeroed = text.replacen(&manifest.self_sha256, SELF_SHA256_PLACEHOLDER, 1);
        let digest = hex(&Sha256::digest(zeroed.as_bytes()));
        if manifest.self_sha256.len() != 64 || manifest.self_sha256 != digest {
            let message = "self_sha256 does not match its text: the manifest was changed or damaged";
            return Err(SchemaError::Manifest(message.to_owned()));
        }
        manifest.check()?;
        Ok(manifest)
    }

    /// Reads a manifest whose `self_sha256` may be wrong, to say more about a damaged store; everything else is checked.
    ///
    /// # Errors
    /// As [`Manifest::parse`], but for the digest.
    pub fn parse_damaged(text: &str) -> Result<Self, SchemaError> {
        let manifest = Self::read(text)?;
        manifest.check()?;
        Ok(manifest)
    }

    fn read(text: &str) -> Result<Self, SchemaError> {
        #[derive(Deserialize)]
        struct VersionOnly {
            schema_version: u32,
        }
        let fail = |m: String| SchemaError::Manifest(m);
        let version: VersionOnly = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        if version.schema_version > SCHEMA_VERSION {
            return Err(SchemaError::Version { found: version.schema_version });
        }
        serde_json::from_str(text).map_err(|e| fail(e.to_string()))
    }

    /// Kind, layout and part names.
    fn check(&self) -> Result<(), SchemaError> {
        let fail = |m: String| SchemaError::Manifest(m);
        if self.kind != "rollouts" {
            return Err(fail(format!("kind: expected \"rollouts\", found {:?}", self.kind)));
        }
        self.layout().check()?;
        for part in &self.parts {
            let bare = !part.file.is_empty()
                && part.file.len() <= 255
                && !part.file.starts_with('.')
                && part.file.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.'));
            if !bare {
                return Err(fail(format!("part name {:?} is not a plain file name inside the store", part.file)));
            }
        }
        Ok(())
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde asks for")]
fn is_zero(value: &u64) -> bool {
    *value == 0
}

/// Lower-case hex of a digest.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut s, b| {
        for nibble in [b >> 4, b & 15] {
            s.push(char::from_digit(u32::from(nibble), 16).unwrap_or('0'));
        }
        s
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::Controller;

    fn manifest() -> Manifest {
        let agent = AgentSpec {
            name: "agent_0".to_owned(),
            team: "team".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 4,
            message: 4,
            action: 2,
        };
        let layout = Layout { agents: vec![agent], state_fields: vec!["agent_0.x".to_owned()] };
        Manifest::new(1, Value::Null, Value::Null, Value::Null, &layout)
    }

    #[test]
    fn a_sealed_manifest_reads_back() {
        let text = manifest().sealed_json().unwrap();
        let read = Manifest::parse(&text).unwrap();
        assert_eq!(Manifest { self_sha256: String::new(), ..read }, manifest());
    }

    #[test]
    fn every_flipped_bit_of_a_manifest_is_an_error() {
        let text = manifest().sealed_json().unwrap().into_bytes();
        for bit in 0..text.len() * 8 {
            let mut changed = text.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            if let Ok(changed) = String::from_utf8(changed) {
                assert!(Manifest::parse(&changed).is_err(), "bit {bit} went unnoticed");
            }
        }
    }

    #[test]
    fn a_newer_version_names_the_remedy() {
        let text = manifest().sealed_json().unwrap().replace("\"schema_version\": 1", "\"schema_version\": 2");
        let error = Manifest::parse(&text).unwrap_err().to_string();
        assert!(error.contains("schema version 2 is newer") && error.contains("install"), "{error}");
    }

    #[test]
    fn a_part_outside_the_directory_is_refused() {
        for file in ["../x.parquet", "/etc/passwd", "a/b.parquet", "", ".hidden", "a\u{1b}[2J"] {
            let mut m = manifest();
            let part = Part {
                file: file.to_owned(),
                episodes: [0, 1],
                bytes: 0,
                sha256: String::new(),
                content: String::new(),
            };
            m.parts.push(part);
            assert!(Manifest::parse(&m.sealed_json().unwrap()).is_err(), "{file:?} was accepted");
        }
    }
}
