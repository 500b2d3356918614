//! Plugins: a const slice of entries per kind, and the way a user names one.
//!
//! A plugin is written `name`, `name:value` or as a JSON table on the command line, and `{ name = …, … }` in TOML and JSON. Everything
//! that knows plugins (help, `list`, "did you mean", contract tests) derives from the slices.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value};

/// One registered plugin of a kind. `B` is the kind's constructor.
#[derive(Clone, Copy, Debug)]
pub struct Entry<B> {
    /// The name a user types, in kebab or snake case as the field writes it.
    pub name: &'static str,
    /// One line for `ccmarl list` and `--help`.
    pub summary: &'static str,
    /// Paper, equation or source that defines it.
    pub reference: &'static str,
    /// The parameter that `name:value` sets, if the plugin takes one.
    pub value: Option<&'static str>,
    /// Builds it.
    pub build: B,
}

/// What goes wrong between a user's words and a plugin.
#[derive(Debug, thiserror::Error)]
pub enum RegistryError {
    /// No plugin of that kind has this name.
    #[error("unknown {kind} {name:?}: {hint} (`ccmarl list` shows all)")]
    Unknown {
        /// What was looked for: `scenario`, `link`, …
        kind: &'static str,
        /// What the user typed.
        name: String,
        /// The nearest names, or all of them.
        hint: String,
    },
    /// `name:value` for a plugin that takes no value.
    #[error("{kind} {name:?} takes no value, but {value:?} was given: write just {name}")]
    NoValue {
        /// Kind of plugin.
        kind: &'static str,
        /// Its name.
        name: String,
        /// The superfluous value.
        value: String,
    },
    /// A parameter is missing, unknown, of the wrong type or out of range.
    #[error("{name}: {message}")]
    Params {
        /// The plugin.
        name: String,
        /// What is wrong, and the allowed range.
        message: String,
    },
    /// A file that a parameter names cannot be used.
    #[error("{0}")]
    Data(String),
}

/// A plugin as a user names it: its name and its parameters. Serialises as one flat table `{name, …}`.
#[derive(Clone, Debug, PartialEq)]
pub struct Spec {
    /// The plugin's name.
    pub name: String,
    /// Its parameters, as given.
    pub params: Map<String, Value>,
}

impl Spec {
    /// A plugin without parameters.
    pub fn new(name: &str) -> Self {
        Self { name: name.to_owned(), params: Map::new() }
    }

    /// The same plugin with one more parameter.
    #[must_use]
    pub fn with(mut self, key: &str, value: impl Into<Value>) -> Self {
        self.params.insert(key.to_owned(), value.into());
        self
    }

    /// Reads `name`, `name:value` or a JSON table `{"name": …, …}` against a registry.
    ///
    /// # Errors
    /// [`RegistryError::Unknown`] with the nearest names, [`RegistryError::NoValue`], [`RegistryError::Params`] for what
    /// begins like a table and is none.
    pub fn parse<B>(kind: &'static str, entries: &[Entry<B>], text: &str) -> Result<Self, RegistryError> {
        if text.trim_start().starts_with('{') {
            let table: Self = serde_json::from_str(text)
                .map_err(|e| Self::new(kind).invalid(format!("expected a table {{\"name\": …, …}} in JSON: {e}")))?;
            find(kind, entries, &table.name)?;
            return Ok(table);
        }
        let (name, value) = text.split_once(':').map_or((text, None), |(n, v)| (n, Some(v)));
        let entry = find(kind, entries, name)?;
        let mut spec = Self::new(entry.name);
        if let Some(value) = value {
            let Some(key) = entry.value else {
                return Err(RegistryError::NoValue { kind, name: name.to_owned(), value: value.to_owned() });
            };
            let parsed = value.parse::<f64>().ok().filter(|v| v.is_finite());
            let json = match (value.parse::<i64>(), parsed) {
                (Ok(whole), _) => Value::from(whole),
                (_, Some(number)) => Value::from(number),
                _ => Value::from(value),
            };
            spec.params.insert(key.to_owned(), json);
        }
        Ok(spec)
    }

    /// The parameters as a checked type. Give `P` `#[serde(deny_unknown_fields, default)]`.
    ///
    /// # Errors
    /// [`RegistryError::Params`] that names the field.
    pub fn params<P: DeserializeOwned>(&self) -> Result<P, RegistryError> {
        let read = |params: Map<String, Value>| {
            serde_json::from_value::<P>(Value::Object(params)).map_err(|error| error.to_string())
        };
        read(self.params.clone()).map_err(|message| {
            // The parser does not say which field: it is the one without which there is no error, or another one.
            let culprit = self.params.keys().find(|key| {
                let mut others = self.params.clone();
                others.shift_remove(*key);
                read(others).err().as_ref() != Some(&message)
            });
            match culprit {
                Some(key) if !message.contains(&format!("`{key}`")) => self.invalid(format!("{key}: {message}")),
                _ => self.invalid(message),
            }
        })
    }

    /// The parameters laid over `defaults`, whose fields are all that there are.
    ///
    /// # Errors
    /// [`RegistryError::Params`] that names the field, with the nearest names for one that does not exist.
    pub fn params_over<P: Serialize + DeserializeOwned>(&self, defaults: &P) -> Result<P, RegistryError> {
        let known = resolved(&self.name, defaults);
        let read = |given: &mut dyn Iterator<Item = (&String, &Value)>| {
            let mut fields = known.clone();
            fields.shift_remove("name");
            fields.extend(given.map(|(key, value)| (key.clone(), value.clone())));
            serde_json::from_value::<P>(Value::Object(fields)).map_err(|error| error.to_string())
        };
        if let Some(key) = self.params.keys().find(|key| !known.contains_key(*key)) {
            let names = known.keys().map(String::as_str).filter(|name| *name != "name");
            return Err(self.invalid(format!("unknown field `{key}`: {}", did_you_mean(key, names))));
        }
        read(&mut self.params.iter()).map_err(|message| {
            // The parser does not say which field: it is one that fails alone.
            let culprit = self.params.iter().find(|field| read(&mut std::iter::once(*field)).is_err());
            self.invalid(culprit.map_or(message.clone(), |(key, _)| format!("{key}: {message}")))
        })
    }

    /// Checks that no parameter was given, for plugins that take none.
    ///
    /// # Errors
    /// [`RegistryError::Params`] that names the one given.
    pub fn no_params(&self) -> Result<(), RegistryError> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct NoParams {}
        self.params().map(|NoParams {}| ())
    }

    /// Checks that the parameter `key` lies in `[low, high]`.
    ///
    /// # Errors
    /// [`RegistryError::Params`] that names the range and what was found.
    pub fn in_range(&self, key: &str, value: f64, low: f64, high: f64) -> Result<(), RegistryError> {
        if value >= low && value <= high {
            return Ok(());
        }
        Err(self.invalid(format!("{key} must be in [{low}, {high}], found {value}")))
    }

    /// An error about this plugin's parameters.
    pub fn invalid(&self, message: impl Into<String>) -> RegistryError {
        RegistryError::Params { name: self.name.clone(), message: message.into() }
    }
}

impl std::fmt::Display for Spec {
    /// `name`, or `name:value` when the one parameter is a scalar, `name:path` for what is read from a file, else `name{…}`.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.name)?;
        if let Some(Value::String(path)) = self.params.get("path") {
            return write!(f, ":{path}");
        }
        let mut values = self.params.iter().filter(|(_, v)| !v.is_null());
        match (values.next(), values.next()) {
            (None, _) => Ok(()),
            (Some((_, Value::String(s))), None) => write!(f, ":{s}"),
            (Some((_, v)), None) if v.is_number() => write!(f, ":{v}"),
            _ => write!(f, "{}", Value::Object(self.params.clone())),
        }
    }
}

impl Serialize for Spec {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut flat = Map::new();
        flat.insert("name".to_owned(), Value::from(self.name.clone()));
        flat.extend(self.params.clone());
        flat.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Spec {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut params = match Value::deserialize(deserializer)? {
            Value::String(name) => return Ok(Self::new(&name)),
            Value::Object(map) => map,
            other => return Err(serde::de::Error::custom(format!("expected a name or {{ name = … }}, found {other}"))),
        };
        match params.shift_remove("name") {
            Some(Value::String(name)) => Ok(Self { name, params }),
            _ => Err(serde::de::Error::custom("a plugin table needs the key `name`")),
        }
    }
}

/// Parameters as a manifest records them: the name, then every field.
pub fn resolved(name: &str, parameters: &impl Serialize) -> Map<String, Value> {
    let mut map = Map::new();
    map.insert("name".to_owned(), Value::from(name));
    if let Ok(Value::Object(fields)) = serde_json::to_value(parameters) {
        map.extend(fields);
    }
    map
}

/// Every value of a TOML document under its dotted name.
pub fn dotted(value: &toml::Value) -> BTreeMap<String, String> {
    fn walk(prefix: &str, value: &toml::Value, out: &mut BTreeMap<String, String>) {
        let toml::Value::Table(table) = value else {
            out.insert(prefix.to_owned(), value.to_string());
            return;
        };
        for (key, value) in table {
            let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
            walk(&name, value, out);
        }
    }
    let mut out = BTreeMap::new();
    walk("", value, &mut out);
    out
}

/// The entry called `name`.
///
/// # Errors
/// [`RegistryError::Unknown`] with the nearest names.
pub fn find<'a, B>(kind: &'static str, entries: &'a [Entry<B>], name: &str) -> Result<&'a Entry<B>, RegistryError> {
    entries.iter().find(|e| e.name == name).ok_or_else(|| RegistryError::Unknown {
        kind,
        name: name.to_owned(),
        hint: did_you_mean(name, entries.iter().map(|e| e.name)),
    })
}

/// "did you mean a, b?" for the candidates nearest to `name`, or the whole list when none is near.
pub fn did_you_mean<'a>(name: &str, candidates: impl Iterator<Item = &'a str>) -> String {
    let mut scored: Vec<(f64, &str)> =
        candidates.map(|c| (strsim::jaro_winkler(&name.to_lowercase(), &c.to_lowercase()), c)).collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(b.1)));
    let near: Vec<&str> = scored.iter().filter(|(s, _)| *s > 0.75).take(3).map(|(_, c)| *c).collect();
    if near.is_empty() {
        let mut all: Vec<&str> = scored.iter().map(|(_, c)| *c).collect();
        all.sort_unstable();
        all.truncate(40);
        format!("known are {}", all.join(", "))
    } else {
        format!("did you mean {}?", near.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KIND: &[Entry<()>] = &[
        Entry { name: "dropout", summary: "", reference: "", value: Some("p"), build: () },
        Entry { name: "perfect", summary: "", reference: "", value: None, build: () },
    ];

    #[test]
    fn a_value_lands_under_the_entrys_key() {
        let spec = Spec::parse("link", KIND, "dropout:0.2").unwrap();
        assert_eq!(spec, Spec::new("dropout").with("p", 0.2));
        assert_eq!(spec.to_string(), "dropout:0.2");
        assert_eq!(serde_json::to_string(&spec).unwrap(), r#"{"name":"dropout","p":0.2}"#);
        assert_eq!(serde_json::from_str::<Spec>(r#"{"name":"dropout","p":0.2}"#).unwrap(), spec);
    }

    #[test]
    fn a_table_is_read_too_and_a_path_stands_for_its_file() {
        let table = r#"{"name":"dropout","p":0.2,"more":[1]}"#;
        let spec = Spec::parse("link", KIND, table).unwrap();
        assert_eq!(spec, Spec::new("dropout").with("p", 0.2).with("more", vec![1]));
        let error = |text: &str| Spec::parse("link", KIND, text).unwrap_err().to_string();
        assert!(
            error("{\"p\":1}").starts_with("link: expected a table {\"name\": …, …} in JSON: a plugin table needs")
        );
        assert!(error("{").contains("EOF"), "{}", error("{"));
        assert!(error(r#"{"name":"dropuot"}"#).contains("did you mean dropout?"));
        let file = Spec::new("file").with("path", "a/link.json").with("link", spec.params);
        assert_eq!(file.to_string(), "file:a/link.json");
    }

    #[test]
    fn an_error_names_its_field() {
        #[derive(Debug, Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Params {
            #[expect(dead_code, reason = "only read")]
            p: f64,
            #[expect(dead_code, reason = "only read")]
            n: Option<usize>,
        }
        let error = |spec: Spec| spec.params::<Params>().unwrap_err().to_string();
        let spec = Spec::new("x").with("n", 1);
        assert_eq!(error(spec.clone().with("p", "high")), "x: p: invalid type: string \"high\", expected f64");
        assert_eq!(error(spec.clone()), "x: missing field `p`");
        assert_eq!(error(spec.clone().with("p", 1).with("q", 1)), "x: unknown field `q`, expected `p` or `n`");
        assert!(error(spec.with("p", 1).with("n", -1)).starts_with("x: n: invalid value: integer `-1`"));
    }

    #[test]
    fn parameters_are_laid_over_defaults_and_name_what_is_wrong() {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        struct Params {
            p: f64,
            count: usize,
        }
        let over = |spec: Spec| spec.params_over(&Params { p: 0.5, count: 3 }).map_err(|e| e.to_string());
        assert_eq!(over(Spec::new("x").with("count", 4)), Ok(Params { p: 0.5, count: 4 }));
        assert_eq!(over(Spec::new("x").with("cuont", 4)).unwrap_err(), "x: unknown field `cuont`: did you mean count?");
        let wrong = over(Spec::new("x").with("p", 1).with("count", -1)).unwrap_err();
        assert!(wrong.starts_with("x: count: invalid value: integer `-1`"), "{wrong}");
    }

    #[test]
    fn wrong_names_and_superfluous_values_say_what_to_do() {
        let unknown = Spec::parse("link", KIND, "dropuot").unwrap_err().to_string();
        assert_eq!(unknown, "unknown link \"dropuot\": did you mean dropout? (`ccmarl list` shows all)");
        let none_near = Spec::parse("link", KIND, "zzz").unwrap_err().to_string();
        assert!(none_near.contains("known are dropout, perfect"), "{none_near}");
        let value = Spec::parse("link", KIND, "perfect:1").unwrap_err().to_string();
        assert_eq!(value, "link \"perfect\" takes no value, but \"1\" was given: write just perfect");
    }
}
