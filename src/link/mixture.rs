//! # What it is
//! A network that is in one of several conditions: each episode draws one link, and keeps it to its end.
//!
//! # Definition
//! k ~ Categorical(weights) once per episode; ι^{ji} is then link k's, for all pairs.
//!
//! # Shapes and units
//! Bits `[N, N]`; weights are relative and need not sum to 1.
//!
//! # Parameters
//! `links`: 1 to 64 links, as a list of tables or as text, `mixture:perfect,dropout:0.5`; `weights`: as many numbers ≥ 0,
//! by default all equal.
//!
//! # When it fails
//! A link in it fails; all weights are 0. It cannot change within an episode: a `markov` matrix can.
//!
//! # Reference
//! Domain randomisation (Tobin et al. 2017) over the paper's `f_θ`.
//!
//! # Differences from the reference implementation
//! None known.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Build, LINKS, Link, LinkEpisode, Setting};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, uniform};

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "mixture",
    summary: "one of several links, drawn per episode: mixture:perfect,dropout:0.5",
    reference: "Tobin et al. 2017 (domain randomisation)",
    value: Some("links"),
    build,
};

const MAX_LINKS: usize = 64;

/// Links as a list, or as text.
#[derive(Deserialize)]
#[serde(untagged, expecting = "a list of links, or text: perfect,dropout:0.5")]
enum Named {
    Text(String),
    List(Vec<One>),
}

/// A link in a list: as on the command line, or a table.
#[derive(Deserialize)]
#[serde(untagged)]
enum One {
    Text(String),
    Table(Spec),
}

impl One {
    fn spec(self) -> Result<Spec, RegistryError> {
        match self {
            Self::Text(text) => Spec::parse("link", LINKS, text.trim()),
            Self::Table(spec) => Ok(spec),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Params {
    links: Named,
    #[serde(default)]
    weights: Option<Vec<f64>>,
}

/// What the manifest records.
#[derive(Serialize)]
struct Resolved {
    links: Vec<Map<String, Value>>,
    weights: Vec<f64>,
}

struct Mixture {
    links: Vec<Box<dyn Link>>,
    weights: Vec<f64>,
}

fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    let Params { links, weights } = spec.params()?;
    let named = match links {
        Named::List(list) => list,
        Named::Text(text) => text.split(',').map(|link| One::Text(link.to_owned())).collect(),
    };
    let specs = named.into_iter().map(One::spec).collect::<Result<Vec<_>, _>>()?;
    if !(1..=MAX_LINKS).contains(&specs.len()) {
        return Err(spec.invalid(format!("expected 1 to {MAX_LINKS} links, found {}", specs.len())));
    }
    let weights = weights.unwrap_or_else(|| vec![1.0; specs.len()]);
    if weights.len() != specs.len() {
        return Err(spec.invalid(format!("weights: expected {}, one per link, found {}", specs.len(), weights.len())));
    }
    if let Some(bad) = weights.iter().find(|w| !(0.0..=1e9).contains(*w)) {
        return Err(spec.invalid(format!("weights must be in [0, 1e9], found {bad}")));
    }
    if weights.iter().all(|&w| w == 0.0) {
        return Err(spec.invalid("weights: expected one above 0, found none"));
    }
    let links = specs.iter().map(|inner| super::build_inner(spec, inner, setting)).collect::<Result<_, _>>()?;
    Ok(Box::new(Mixture { links, weights }))
}

impl Link for Mixture {
    fn parameters(&self) -> Map<String, Value> {
        let links = self.links.iter().map(|link| link.parameters()).collect();
        crate::registry::resolved(ENTRY.name, &Resolved { links, weights: self.weights.clone() })
    }

    fn episodes(&self) -> Option<u64> {
        self.links.iter().filter_map(|link| link.episodes()).min()
    }

    /// The drawn link gets the episode's node as if it stood alone; the choice has a stream of its own.
    fn start(&self, n: usize, episode: u64, seeds: &Seeds) -> Box<dyn LinkEpisode> {
        let total: f64 = self.weights.iter().sum();
        let mut left = uniform(&mut seeds.stream("mixture"), 0.0, total);
        let reached = |weight: &f64| {
            left -= weight;
            left < 0.0
        };
        let last = self.weights.iter().rposition(|&w| w > 0.0).unwrap_or(0);
        let drawn = self.weights.iter().position(reached).unwrap_or(last);
        self.links[drawn].start(n, episode, seeds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{emit_rows, test_setting};

    fn spec(json: &str) -> Spec {
        serde_json::from_str(json).unwrap()
    }

    #[test]
    fn links_are_drawn_per_episode_by_weight_and_each_is_as_if_alone() {
        let mixture = build(
            &spec(r#"{"name":"mixture","links":["none",{"name":"dropout","p":0.5},"perfect"],"weights":[1,3,0]}"#),
            &test_setting(0.25),
        )
        .unwrap();
        let alone = super::super::build(&Spec::new("dropout").with("p", 0.5), &test_setting(0.25)).unwrap();
        let mut silent = 0;
        for episode in 0..2000 {
            let rows = emit_rows(&*mixture, 3, 26, episode);
            if rows.iter().all(|bits| !bits[1]) {
                silent += 1;
            } else {
                assert_eq!(rows, emit_rows(&*alone, 3, 26, episode));
            }
        }
        assert!((f64::from(silent) / 2000.0 - 0.25).abs() < 0.049, "{silent} of 2000"); // 5 standard errors
    }

    #[test]
    fn text_names_links_too_and_is_resolved() {
        let named = Spec::parse("link", LINKS, "mixture:perfect, dropout:0.5").unwrap();
        let mixture = build(&named, &test_setting(0.25)).unwrap();
        let json = Value::Object(mixture.parameters()).to_string();
        let expected =
            r#"{"name":"mixture","links":[{"name":"perfect"},{"name":"dropout","p":0.5}],"weights":[1.0,1.0]}"#;
        assert_eq!(json, expected);
    }

    #[test]
    fn a_list_of_texts_is_read_as_the_command_line_is() {
        let built = |json: &str| build(&spec(json), &test_setting(0.25)).map(|link| link.parameters());
        let listed = built(r#"{"name":"mixture","links":["distance:3","dropout:0.3"]}"#).unwrap();
        assert_eq!(listed, built(r#"{"name":"mixture","links":"distance:3,dropout:0.3"}"#).unwrap());
        assert_eq!(listed["links"][1]["p"], 0.3);
        let error = built(r#"{"name":"mixture","links":7}"#).unwrap_err().to_string();
        assert!(error.contains("a list of links, or text: perfect,dropout:0.5"), "{error}");
    }

    #[test]
    fn malformed_mixtures_are_refused() {
        let error = |json: &str| build(&spec(json), &test_setting(0.25)).err().unwrap().to_string();
        assert_eq!(error(r#"{"name":"mixture","links":[]}"#), "mixture: expected 1 to 64 links, found 0");
        assert_eq!(
            error(r#"{"name":"mixture","links":["none"],"weights":[1,2]}"#),
            "mixture: weights: expected 1, one per link, found 2"
        );
        assert_eq!(
            error(r#"{"name":"mixture","links":["none"],"weights":[-1]}"#),
            "mixture: weights must be in [0, 1e9], found -1"
        );
        assert!(error(r#"{"name":"mixture","links":["none"],"weights":[0]}"#).contains("expected one above 0"));
        assert!(error(r#"{"name":"mixture","links":"perfect,dropuot:1"}"#).contains("did you mean dropout?"));
        assert!(error(r#"{"name":"mixture","links":[{"name":"dropout","p":2}]}"#).starts_with("dropout: p must be in"));
        let mut deep = r#""none""#.to_owned();
        for _ in 0..6 {
            deep = format!(r#"{{"name":"mixture","links":[{deep}]}}"#);
        }
        assert!(error(&deep).contains("more than 4 deep"), "{}", error(&deep));
    }
}
