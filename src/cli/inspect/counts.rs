//! What `inspect` counts, in one pass or in parts that are put together later: the same numbers either way.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::Error;
use crate::schema::{Episode, Layout, Manifest, hex};
use crate::stats::ExactSum;

/// What a part file calls itself.
const KIND: &str = "inspect-part";

/// Counts over some episodes of a store. Sums are exact, so that their value does not depend on how they were parted.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Counts {
    /// Bits of the return of each episode (JSON has no exact floats), in order.
    returns: Vec<u64>,
    pub(super) terminal: u64,
    pub(super) steps: u64,
    /// Over all elements of a column, nulls left out, trues counted.
    sums: BTreeMap<String, ExactSum>,
    /// Lost messages `[sender, receiver]` among the communicators.
    pub(super) lost: Vec<u64>,
}

impl Counts {
    /// Nothing yet.
    pub(super) fn new(layout: &Layout) -> Self {
        let n = layout.communicators().len();
        Self { lost: vec![0; n * n], ..Self::default() }
    }

    /// Counts an episode.
    pub(super) fn add(&mut self, layout: &Layout, e: &Episode) {
        let (n, t) = (layout.communicators().len(), e.steps);
        self.returns.push(e.episode_return().to_bits());
        self.terminal += u64::from(e.terminal);
        self.steps += t as u64;
        let mut count = |column: &str, value: f64| self.sum(column).add(value);
        count("episode", e.index as f64 * e.rows() as f64);
        count("step", (t * (t + 1)) as f64 / 2.0);
        if n > 0 {
            count("link", e.link.iter().filter(|&&b| b).count() as f64);
        }
        if !layout.state_fields.is_empty() {
            let sum = self.sum("state");
            for &value in &e.state {
                sum.add(value);
            }
        }
        let mut floats = |column: &str, data: &[f32]| {
            let sum = self.sum(column);
            for &value in data {
                sum.add(f64::from(value));
            }
        };
        floats("reward", &e.reward);
        for (i, agent) in layout.agents.iter().enumerate() {
            let columns = [("observation", &e.observations[i]), ("message", &e.messages[i]), ("action", &e.actions[i])];
            for (kind, matrix) in columns {
                if matrix.width > 0 {
                    floats(&format!("{kind}.{}", agent.name), &matrix.data);
                }
            }
            floats(&format!("reward.{}", agent.name), &e.rewards[i]);
        }
        for bits in e.link[..t * n * n].chunks_exact((n * n).max(1)) {
            for (lost, &delivered) in self.lost.iter_mut().zip(bits) {
                *lost += u64::from(!delivered);
            }
        }
    }

    fn sum(&mut self, column: &str) -> &mut ExactSum {
        if !self.sums.contains_key(column) {
            self.sums.insert(column.to_owned(), ExactSum::default());
        }
        self.sums.entry(column.to_owned()).or_default()
    }

    /// Returns per episode, in order.
    pub(super) fn returns(&self) -> Vec<f64> {
        self.returns.iter().map(|&bits| f64::from_bits(bits)).collect()
    }

    /// The sums by column.
    pub(super) fn sums(&self) -> BTreeMap<String, f64> {
        self.sums.iter().map(|(column, sum)| (column.clone(), sum.value())).collect()
    }

    /// Adds the counts of the episodes that follow.
    fn append(&mut self, next: Self) {
        self.returns.extend(next.returns);
        self.terminal += next.terminal;
        self.steps += next.steps;
        for (column, sum) in &next.sums {
            self.sum(column).merge(sum);
        }
        for (lost, more) in self.lost.iter_mut().zip(next.lost) {
            *lost += more;
        }
    }

    /// Whether `episodes` episodes of a store with this manifest can have these counts; otherwise what cannot be.
    fn check(&self, manifest: &Manifest, episodes: u64) -> Result<(), String> {
        let layout = manifest.layout();
        let n = layout.communicators().len();
        let found = self.returns.len() as u64;
        if found != episodes {
            return Err(format!("{episodes} episodes have {found} returns"));
        }
        if let Some(bad) = self.returns().into_iter().find(|value| !value.is_finite()) {
            return Err(format!("a return is {bad}"));
        }
        if self.terminal > episodes || self.steps > manifest.steps {
            let (terminal, steps) = (self.terminal, self.steps);
            return Err(format!("{episodes} episodes have {terminal} terminal ones and {steps} steps"));
        }
        if self.lost.len() != n * n || self.lost.iter().any(|&lost| lost > self.steps) {
            return Err(format!("its lost messages do not fit {n} communicators and {} steps", self.steps));
        }
        if (0..n).any(|agent| self.lost[agent * (n + 1)] > 0) {
            return Err("an agent lost messages to itself".to_owned());
        }
        // an episode without steps adds nothing to some columns, so that they need not be there
        let mut known = Self::new(&layout);
        known.add(&layout, &Episode::with_capacity(&layout, 0, 0));
        match self.sums.keys().find(|column| !known.sums.contains_key(*column)) {
            Some(column) => Err(format!("the store has no column {column:?}")),
            None if episodes > 0 && self.sums.len() < known.sums.len() => Err("it lacks sums of columns".to_owned()),
            None => Ok(()),
        }
    }
}

/// The counts of one shard, as they are written to a file.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Part {
    kind: String,
    /// The path that was inspected.
    pub(super) store: String,
    /// Which shard, from 0, of how many.
    shard: u64,
    shards: u64,
    /// The store's manifest.
    pub(super) manifest: Manifest,
    pub(super) counts: Counts,
    /// SHA-256 of this text with these digits written as zeros.
    self_sha256: String,
}

impl Part {
    /// The shard's counts, ready to be written.
    pub(super) fn new(store: String, [shard, shards]: [u64; 2], manifest: Manifest, counts: Counts) -> Self {
        Self { kind: KIND.to_owned(), store, shard, shards, manifest, counts, self_sha256: zeros() }
    }

    /// The text of its file, with its digest at the end.
    pub(super) fn sealed(&self) -> serde_json::Result<String> {
        let text = serde_json::to_string(self)?;
        let digest = hex(&Sha256::digest(text.as_bytes()));
        Ok(text.trim_end_matches(&format!("{}\"}}", zeros())).to_owned() + &digest + "\"}")
    }

    /// Reads a part and checks its digest, and that its counts fit its manifest.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let part: Self = serde_json::from_str(text).map_err(|e| format!("not a part of `inspect --shard`: {e}"))?;
        if part.kind != KIND {
            return Err(format!("expected kind {KIND:?}, found {:?}", part.kind));
        }
        let zeroed =
            text.strip_suffix(&format!("{}\"}}", part.self_sha256)).map(|text| text.to_owned() + &zeros() + "\"}");
        if zeroed.is_none_or(|zeroed| hex(&Sha256::digest(zeroed.as_bytes())) != part.self_sha256) {
            return Err("self_sha256 does not match its text: the part was changed or damaged".to_owned());
        }
        part.manifest.layout().check().map_err(|e| e.to_string())?;
        let (name, all) = (format!("shard {}/{}", part.shard, part.shards), part.manifest.episodes);
        if part.shard >= part.shards {
            return Err(format!("there is no {name}: they count from 0"));
        }
        let [from, to] = episodes([part.shard, part.shards], all);
        let checked = part.counts.check(&part.manifest, to - from);
        checked.map_err(|message| format!("{name} of {all} episodes cannot be: {message}"))?;
        Ok(part)
    }
}

fn zeros() -> String {
    "0".repeat(64)
}

/// Episodes of a shard: from, and one past the last.
pub(super) fn episodes([shard, shards]: [u64; 2], episodes: u64) -> [u64; 2] {
    let cut = |i: u64| (u128::from(episodes) * u128::from(i) / u128::from(shards.max(1))) as u64;
    [cut(shard), cut(shard.saturating_add(1))]
}

/// Reads `i/n`.
pub(super) fn parse_shard(text: &str) -> Result<[u64; 2], String> {
    let parts = text.split_once('/').and_then(|(i, n)| Some([i.parse().ok()?, n.parse().ok()?]));
    parts.filter(|[i, n]| i < n).ok_or_else(|| "expected i/n with i from 0 to n - 1, such as 0/4".to_owned())
}

/// Puts all parts of one store together, in whatever order they come.
pub(super) fn merge(mut parts: Vec<Part>) -> Result<Part, Error> {
    parts.sort_by_key(|part| part.shard);
    let mut parts = parts.into_iter();
    let Some(mut whole) = parts.next() else {
        return Err(Error::Usage("--merge needs the files that `inspect --shard` wrote".to_owned()));
    };
    let missing = |shard: u64, shards: u64| {
        Err(Error::Usage(format!("shard {shard}/{shards} is missing: run `ccmarl inspect --shard {shard}/{shards}`")))
    };
    if whole.shard > 0 {
        return missing(0, whole.shards);
    }
    for part in parts {
        if (part.shards, &part.manifest) != (whole.shards, &whole.manifest) {
            let (a, b) = (&whole.store, &part.store);
            return Err(Error::Usage(format!(
                "parts of different stores, or of different numbers of shards: {a}, {b}"
            )));
        }
        if part.shard == whole.shard {
            return Err(Error::Usage(format!("shard {}/{} is given twice", part.shard, part.shards)));
        }
        if part.shard != whole.shard + 1 {
            return missing(whole.shard + 1, whole.shards);
        }
        whole.counts.append(part.counts);
        whole.shard = part.shard;
    }
    if whole.shard + 1 < whole.shards {
        return missing(whole.shard + 1, whole.shards);
    }
    if whole.counts.steps != whole.manifest.steps {
        let (steps, expected) = (whole.counts.steps, whole.manifest.steps);
        return Err(Error::Usage(format!("all shards have {steps} steps together, the store has {expected}")));
    }
    Ok(whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_cover_every_episode_once() {
        for (shards, count) in [(1, 5), (3, 10), (7, 3), (4, u64::MAX)] {
            let cuts: Vec<_> = (0..shards).map(|i| episodes([i, shards], count)).collect();
            assert_eq!((cuts[0][0], cuts[cuts.len() - 1][1]), (0, count));
            assert!(cuts.windows(2).all(|w| w[0][1] == w[1][0]));
        }
    }

    #[test]
    fn a_shard_is_two_numbers() {
        assert_eq!(parse_shard("3/8"), Ok([3, 8]));
        for text in ["8/8", "1", "a/b", "-1/2", "1/0", ""] {
            assert!(parse_shard(text).is_err(), "{text}");
        }
    }
}
