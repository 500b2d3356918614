//! Suites: named lists of test channels, each channel a link with an id as the published tables write it.

use crate::registry::{RegistryError, Spec, did_you_mean};

/// A test channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// Name in tables: `mbc-heavy`.
    pub id: &'static str,
    /// The link behind it.
    pub spec: Spec,
}

/// Names of the suites.
pub const SUITES: &[&str] = &["paper"];

/// The test channels of arXiv 2512.03528, and `none`: id, link, and the value of its parameter.
const PAPER: [(&str, &str); 8] = [
    ("unrestricted", "perfect"),
    ("mbc-light", "markov:light"),
    ("mbc-medium", "markov:medium"),
    ("mbc-heavy", "markov:heavy"),
    ("dbc-light", "distance:5"),
    ("dbc-medium", "distance:3"),
    ("dbc-heavy", "distance:1"),
    ("none", "none"),
];

/// The channels of the suite called `name`, in table order.
///
/// # Errors
/// [`RegistryError::Unknown`] with the nearest names.
pub fn suite(name: &str) -> Result<Vec<Channel>, RegistryError> {
    if name != "paper" {
        let hint = did_you_mean(name, SUITES.iter().copied());
        return Err(RegistryError::Unknown { kind: "suite", name: name.to_owned(), hint });
    }
    let channel =
        |&(id, link): &(&'static str, &str)| Ok(Channel { id, spec: Spec::parse("link", super::LINKS, link)? });
    PAPER.iter().map(channel).collect()
}

/// The channel of any suite called `id`.
///
/// # Errors
/// [`RegistryError::Unknown`] with the nearest ids.
pub fn channel(id: &str) -> Result<Channel, RegistryError> {
    let channels = suite("paper")?;
    let hint = did_you_mean(id, channels.iter().map(|c| c.id));
    let unknown = RegistryError::Unknown { kind: "channel", name: id.to_owned(), hint };
    channels.into_iter().find(|c| c.id == id).ok_or(unknown)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{build, test_setting};

    #[test]
    fn the_papers_suite_builds_and_is_found_by_id() {
        let channels = suite("paper").unwrap();
        assert_eq!(channels.len(), 8);
        for c in &channels {
            build(&c.spec, &test_setting(0.25)).unwrap();
            assert_eq!(channel(c.id).unwrap(), *c);
        }
        assert_eq!(channels[4].spec, Spec::new("distance").with("threshold", 5));
    }

    #[test]
    fn near_misses_are_named() {
        let error = channel("mbc-hevy").unwrap_err().to_string();
        assert!(error.starts_with("unknown channel \"mbc-hevy\": did you mean mbc-heavy"), "{error}");
        assert!(suite("papre").unwrap_err().to_string().contains("did you mean paper?"));
    }
}
