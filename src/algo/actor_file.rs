//! The file of a team: its networks under `PyTorch`'s names, and in its head what a reader must know.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device};
use candle_nn::VarBuilder;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use sha2::{Digest as _, Sha256};

use super::config::Messages;
use super::{Actors, RunPolicyError};
use crate::nn::{Activation, Mlp, NnError, from_tensors, to_tensors};
use crate::schema::hex;

/// Version of the actor file.
const FILE_VERSION: u32 = 1;

/// Metadata key that holds the [`Header`] as JSON.
const HEADER: &str = "ccmarl.actors";

/// What a reader of the actor file must know beside the tensors.
#[derive(Serialize, Deserialize)]
struct Header {
    version: u32,
    learners: Vec<String>,
    observation: Vec<usize>,
    messages: MessagesText,
    /// Width of each learner's message, where encoders make them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    message: Vec<usize>,
    hidden_activation: String,
    output_activation: String,
    /// Environment steps that trained them.
    steps: u64,
    /// The scenario that they were trained in, every constant.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    scenario: Map<String, Value>,
    /// SHA-256 of all parameters in order, little-endian.
    sha256: String,
}

/// What a message is, as the header says it: whether the sender's observation enters the networks, or a word.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum MessagesText {
    Flag(bool),
    Word(Messages),
}

impl From<Messages> for MessagesText {
    fn from(messages: Messages) -> Self {
        match messages {
            Messages::Observation => Self::Flag(true),
            Messages::Off => Self::Flag(false),
            Messages::Encoder => Self::Word(messages),
        }
    }
}

impl From<MessagesText> for Messages {
    fn from(text: MessagesText) -> Self {
        match text {
            MessagesText::Flag(true) => Self::Observation,
            MessagesText::Flag(false) => Self::Off,
            MessagesText::Word(messages) => messages,
        }
    }
}

impl Header {
    fn to_json(&self) -> Result<String, NnError> {
        serde_json::to_string(self).map_err(|e| candle_core::Error::Msg(e.to_string()).into())
    }
}

/// SHA-256 of parameters, little-endian, 64 hex digits.
fn digest(params: &[f32]) -> String {
    let mut hash = Sha256::new();
    for value in params {
        hash.update(value.to_le_bytes());
    }
    hex(&hash.finalize())
}

impl Actors {
    /// Writes the actors as safetensors: `actor.<name>.<layer>.weight` `[outputs, inputs]`, `….bias`, encoders likewise
    /// as `encoder.<name>.…`, and what a reader must know as metadata; `steps` environment steps trained them.
    ///
    /// # Errors
    /// [`NnError`].
    pub fn to_bytes(&self, params: &[f32], steps: u64) -> Result<Vec<u8>, NnError> {
        let mut tensors = BTreeMap::new();
        for (i, name) in self.names.iter().enumerate() {
            to_tensors(&format!("actor.{name}"), &self.networks[i], self.slice(params, i), &mut tensors)?;
        }
        for (j, encoder) in self.encoders.iter().enumerate() {
            let prefix = format!("encoder.{}", self.names[j]);
            to_tensors(&prefix, encoder, &params[self.encoder_range(j)], &mut tensors)?;
        }
        let header = Header {
            version: FILE_VERSION,
            learners: self.names.clone(),
            observation: self.observation.clone(),
            messages: self.messages.into(),
            message: if self.encodes() { self.message.clone() } else { Vec::new() },
            hidden_activation: "relu".to_owned(),
            output_activation: if self.low() < 0.0 { "tanh" } else { "sigmoid" }.to_owned(),
            steps,
            scenario: self.scenario.clone(),
            sha256: digest(params),
        };
        // one key only: the crate keeps metadata in a hash map, whose order would change the bytes
        let metadata = [(HEADER.to_owned(), header.to_json()?)];
        Ok(safetensors::serialize(tensors, Some(metadata.into_iter().collect()))?)
    }

    /// The actor file of a run directory; `path` itself when it is a file.
    pub fn file(path: &Path) -> PathBuf {
        if path.is_dir() { path.join("checkpoint").join("actors.safetensors") } else { path.to_owned() }
    }

    /// Reads the actors of a run directory (or an actor file) and their parameters.
    ///
    /// # Errors
    /// [`RunPolicyError::Unreadable`].
    pub fn load(path: &Path) -> Result<(Self, Vec<f32>), RunPolicyError> {
        let file = Self::file(path);
        let fail = |message: String| RunPolicyError::Unreadable { message, path: file.clone() };
        let bytes = std::fs::read(&file)
            .map_err(|e| fail(format!("{e} (give the directory that `ccmarl train --out` wrote)")))?;
        Self::from_bytes(bytes).map_err(fail)
    }

    fn from_bytes(bytes: Vec<u8>) -> Result<(Self, Vec<f32>), String> {
        let file_sha256 = hex(&Sha256::digest(&bytes));
        let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).map_err(|e| e.to_string())?;
        let metadata = header.metadata().clone().unwrap_or_default();
        let json = metadata.get(HEADER).ok_or_else(|| format!("the metadata key {HEADER:?} is missing"))?;
        let Header {
            version,
            learners: names,
            observation,
            messages,
            message,
            output_activation,
            steps,
            scenario,
            sha256,
            ..
        } = serde_json::from_str(json).map_err(|e| format!("the metadata key {HEADER:?}: {e}"))?;
        let output = match output_activation.as_str() {
            "tanh" => Activation::Tanh,
            "sigmoid" => Activation::Sigmoid,
            other => return Err(format!("output activation must be tanh or sigmoid, found {other:?}")),
        };
        if version != FILE_VERSION {
            return Err(format!("actor file version {version} is not {FILE_VERSION}"));
        }
        if names.len() != observation.len() {
            return Err("as many observation widths as learners are needed".to_owned());
        }
        let read = |prefix: &str, output| -> Result<Vec<Mlp>, String> {
            names.iter().map(|name| network(&header, &format!("{prefix}.{name}"), output)).collect()
        };
        let messages = Messages::from(messages);
        let networks = read("actor", output)?;
        let encoders = if messages == Messages::Encoder { read("encoder", Activation::Tanh)? } else { Vec::new() };
        let mut params = Vec::new();
        let actors = Self::assemble(names, observation, output, messages, [networks, encoders]);
        let seen =
            actors.encoders.iter().map(Mlp::inputs).zip(&actors.observation).all(|(inputs, seen)| inputs == *seen);
        if actors.encodes() && (message != actors.message || !seen) {
            let found = &actors.message;
            return Err(format!(
                "its encoders send {found:?} floats and its head says {message:?}, or they see others'"
            ));
        }
        let builder =
            VarBuilder::from_buffered_safetensors(bytes, DType::F32, &Device::Cpu).map_err(|e| e.to_string())?;
        for (prefix, networks) in [("actor", &actors.networks), ("encoder", &actors.encoders)] {
            for (name, network) in actors.names.iter().zip(networks) {
                from_tensors(&builder, &format!("{prefix}.{name}"), network, &mut params).map_err(|e| e.to_string())?;
            }
        }
        if digest(&params) != sha256 {
            return Err("its parameters do not match their digest: the file was changed or damaged".to_owned());
        }
        Ok((Self { steps, scenario, file_sha256, ..actors }, params))
    }
}

/// The shape of the network whose tensors begin with `prefix`.
fn network(header: &safetensors::tensor::Metadata, prefix: &str, output: Activation) -> Result<Mlp, String> {
    let mut widths = Vec::new();
    while let Some(info) = header.info(&format!("{prefix}.{}.weight", widths.len().saturating_sub(1))) {
        let [outputs, inputs] = info.shape[..] else { return Err("a weight must have two axes".to_owned()) };
        if outputs == 0 || inputs == 0 {
            return Err("a weight has an empty axis".to_owned());
        }
        if widths.is_empty() {
            widths.push(inputs);
        }
        widths.push(outputs);
    }
    if widths.len() < 2 {
        return Err(format!("the network {prefix:?} is missing"));
    }
    Ok(Mlp::new(&widths, Activation::Relu, output))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::algo::{MaddpgConfig, agent};
    use crate::rng::Seeds;

    /// A small team, its parameters and its file.
    fn written(messages: Messages) -> (Actors, Vec<f32>, Vec<u8>) {
        let agents = [agent("a", 3, 2), agent("b", 4, 2)];
        let config = MaddpgConfig { hidden: vec![8, 8], messages, message_width: Some(5), ..MaddpgConfig::default() };
        let actors = Actors::new(&agents.iter().collect::<Vec<_>>(), Activation::Sigmoid, &config);
        let params = actors.init(&mut Seeds::new(1).stream("actors"));
        let bytes = actors.to_bytes(&params, 25).unwrap();
        (actors, params, bytes)
    }

    #[test]
    fn actors_survive_their_file_and_damage_is_an_error() {
        for messages in [Messages::Observation, Messages::Encoder, Messages::Off] {
            let (actors, params, bytes) = written(messages);
            assert!(bytes == actors.to_bytes(&params, 25).unwrap());
            let (read, again) = Actors::from_bytes(bytes.clone()).unwrap();
            assert_eq!((&again, &read.networks), (&params, &actors.networks));
            assert_eq!((&read.encoders, &read.message), (&actors.encoders, &actors.message));
            assert_eq!((read.steps, read.low(), read.messages), (25, 0.0, messages));
            for bit in (bytes.len() * 8 - params.len() * 32..bytes.len() * 8).step_by(37) {
                let mut flipped = bytes.clone();
                flipped[bit / 8] ^= 1 << (bit % 8);
                assert!(Actors::from_bytes(flipped).is_err_and(|e| e.contains("digest")), "bit {bit}");
            }
            for cut in [0, 7, 8, 100, bytes.len() - 1] {
                assert!(Actors::from_bytes(bytes[..cut].to_vec()).is_err());
            }
        }
    }

    #[test]
    fn the_head_says_what_a_message_is_and_encoders_must_be_what_it_says() {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        let head = |messages| text(&written(messages).2).replace('\\', "");
        assert!(head(Messages::Observation).contains(r#""messages":true,"hidden_activation""#));
        assert!(head(Messages::Off).contains(r#""messages":false,"hidden_activation""#));
        assert!(head(Messages::Encoder).contains(r#""messages":"encoder","message":[5,5],"#));
        let changed = |from: &[u8], to: &[u8]| {
            let mut bytes = written(Messages::Encoder).2;
            let at = bytes.windows(from.len()).position(|part| part == from).unwrap();
            bytes[at..at + to.len()].copy_from_slice(to);
            Actors::from_bytes(bytes).unwrap_err()
        };
        let error = changed(b"[5,5]", b"[5,6]");
        assert!(error.contains("its encoders send [5, 5] floats and its head says [5, 6]"), "{error}");
        let error = changed(b"encoder.b.0.weight", b"encoder.c.0.weight");
        assert!(error.contains("the network \"encoder.b\" is missing"), "{error}");
        let error = changed(b"\"encoder\\\"", b"\"whistle\\\"");
        assert!(error.contains("metadata key"), "{error}");
    }
}
