//! # What it is
//! Bursty loss: every directed link is a Markov chain of its own, fitted on radio traces.
//!
//! # Definition
//! State 0 delivers, every other state loses. A chain starts in state 0 at the start of an episode and emits before it
//! moves, so that the first message always arrives (with `start` it starts in a state drawn from there). In the named levels, state s goes back to 0 with probability `p_s`,
//! else on to s + 1 (the last one stays): light p = .99 .85 .91; medium .94 .60 .71 .87 .97 .99; heavy .90 .81 .45 .61
//! .37 .77 .89 .93.
//!
//! # Shapes and units
//! Bits `[N, N]`; the matrix is `[K, K]`, rows are the states left, and each sums to 1.
//!
//! # Parameters
//! `level`: light, medium or heavy (`markov:heavy`), or `matrix`: up to 64 states; the manifest records both. `start`:
//! probability of each state at the start of an episode; state 0 when absent.
//!
//! # When it fails
//! Short episodes from a delivering start lose less than the stationary chain: 1.10, 7.97 and 11.40 % over 25 steps.
//!
//! # Reference
//! TMC (Zhang et al. 2020), `loss_pattern.py`: 3, 6 and 8 states, as many as arXiv 2512.03528 names.
//!
//! # Differences from the reference implementation
//! A lost message reaches the receiver as zeros; TMC keeps the last one that arrived.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode, for_each_link};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream, uniform};

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "markov",
    summary: "bursty loss: a Markov chain per link (light, medium, heavy, or a matrix)",
    reference: "Zhang et al. 2020 (TMC), 802.11ac traces",
    value: Some("level"),
    build,
};

const MAX_STATES: usize = 64;

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Level {
    Light,
    Medium,
    Heavy,
}

impl Level {
    /// Probability of going back to state 0, per state.
    fn back(self) -> &'static [f64] {
        match self {
            Self::Light => &[0.99, 0.85, 0.91],
            Self::Medium => &[0.94, 0.60, 0.71, 0.87, 0.97, 0.99],
            Self::Heavy => &[0.90, 0.81, 0.45, 0.61, 0.37, 0.77, 0.89, 0.93],
        }
    }

    fn matrix(self) -> Vec<Vec<f64>> {
        let back = self.back();
        let row = |(s, &p): (usize, &f64)| {
            let mut row = vec![0.0; back.len()];
            row[0] = p;
            row[(s + 1).min(back.len() - 1)] = 1.0 - p;
            row
        };
        back.iter().enumerate().map(row).collect()
    }
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Params {
    level: Option<Level>,
    matrix: Option<Vec<Vec<f64>>>,
    start: Option<Vec<f64>>,
}

struct Markov {
    params: Params,
    /// Row-major cumulative sums of the matrix, then of `start`, if there is one.
    cumulative: Arc<[f64]>,
    states: usize,
}

fn build(spec: &Spec, _setting: &super::Setting) -> Result<Box<dyn Link>, RegistryError> {
    let given: Params = spec.params()?;
    let matrix = match (given.level, given.matrix) {
        (Some(level), None) => level.matrix(),
        (Some(level), Some(matrix)) if matrix == level.matrix() => matrix,
        (None, Some(matrix)) => matrix,
        (Some(_), Some(_)) => return Err(spec.invalid("level and matrix disagree: give one of them")),
        (None, None) => return Err(spec.invalid("give a level (markov:light, :medium, :heavy) or a matrix")),
    };
    let states = matrix.len();
    if !(1..=MAX_STATES).contains(&states) {
        return Err(spec.invalid(format!("matrix must have 1 to {MAX_STATES} rows, found {states}")));
    }
    let mut cumulative = Vec::with_capacity((states + 1) * states);
    for (s, row) in matrix.iter().enumerate() {
        if row.len() != states {
            return Err(spec.invalid(format!("matrix must be square: row {s} has {} of {states} entries", row.len())));
        }
        accumulate(spec, &format!("matrix row {s}"), row, &mut cumulative)?;
    }
    if let Some(start) = &given.start {
        if start.len() != states {
            return Err(spec.invalid(format!("start must have {states} entries, as the matrix, found {}", start.len())));
        }
        accumulate(spec, "start", start, &mut cumulative)?;
    }
    let params = Params { level: given.level, matrix: Some(matrix), start: given.start };
    Ok(Box::new(Markov { params, cumulative: cumulative.into(), states }))
}

/// Appends the cumulative sums of a distribution over the states.
fn accumulate(spec: &Spec, what: &str, row: &[f64], out: &mut Vec<f64>) -> Result<(), RegistryError> {
    if let Some(bad) = row.iter().find(|p| !(0.0..=1.0).contains(*p)) {
        return Err(spec.invalid(format!("{what}: probabilities must be in [0, 1], found {bad}")));
    }
    let mut sum = 0.0;
    for p in row {
        sum += p;
        out.push(sum);
    }
    if (sum - 1.0).abs() > 1e-9 {
        return Err(spec.invalid(format!("{what} must sum to 1, found {sum}")));
    }
    Ok(())
}

impl Link for Markov {
    fn parameters(&self) -> Map<String, Value> {
        let mut map = crate::registry::resolved(ENTRY.name, &self.params);
        map.retain(|_, value| !value.is_null());
        map
    }

    fn start(&self, n: usize, _episode: u64, seeds: &Seeds) -> Box<dyn LinkEpisode> {
        let mut streams = super::streams(n, seeds);
        let first =
            |stream| self.params.start.as_ref().map_or(0, |_| draw(&self.cumulative, self.states, self.states, stream));
        let chains = streams.iter_mut().map(first).collect();
        Box::new(Episode { cumulative: Arc::clone(&self.cumulative), states: self.states, n, chains, streams })
    }
}

/// Draws a state from row `row` of the cumulative sums.
fn draw(cumulative: &[f64], states: usize, row: usize, stream: &mut Stream) -> usize {
    let draw = uniform(stream, 0.0, 1.0);
    cumulative[row * states..(row + 1) * states].iter().position(|&c| draw < c).unwrap_or(states - 1)
}

struct Episode {
    cumulative: Arc<[f64]>,
    states: usize,
    n: usize,
    chains: Vec<usize>,
    streams: Vec<Stream>,
}

impl LinkEpisode for Episode {
    fn emit(&mut self, _bodies: &[Body], bits: &mut [bool]) {
        let n = self.n;
        bits.fill(true);
        for_each_link(n, |s, r, link| {
            let state = &mut self.chains[link];
            bits[s * n + r] = *state == 0;
            *state = draw(&self.cumulative, self.states, *state, &mut self.streams[link]);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{emit_rows, test_setting};

    /// Mean loss over `steps` steps from state 0, by propagating the distribution.
    fn expected(level: Level, steps: usize) -> f64 {
        let matrix = level.matrix();
        let mut at = vec![0.0; matrix.len()];
        at[0] = 1.0;
        let mut lost = 0.0;
        for _ in 0..steps {
            lost += 1.0 - at[0];
            at = (0..at.len()).map(|j| (0..at.len()).map(|i| at[i] * matrix[i][j]).sum()).collect();
        }
        lost / steps as f64
    }

    #[test]
    fn the_levels_lose_what_the_chains_predict() {
        for (level, name, loss) in
            [(Level::Light, "light", 0.0110), (Level::Medium, "medium", 0.0797), (Level::Heavy, "heavy", 0.1140)]
        {
            assert!((expected(level, 25) - loss).abs() < 6e-5, "{name}: {}", expected(level, 25));
            let link = build(&Spec::new("markov").with("level", name), &test_setting(1.0)).unwrap();
            let (mut lost, episodes) = (0, 3000);
            for episode in 0..episodes {
                let rows = emit_rows(&*link, 3, 25, episode);
                assert!(rows[0].iter().all(|&b| b), "the first message always arrives");
                lost += rows.iter().flatten().filter(|&&b| !b).count();
            }
            let share = lost as f64 / (episodes * 25 * 6) as f64;
            // Bursts make neighbours dependent: allow 5 standard errors at half the effective sample.
            let tolerance = 5.0 * (2.0 * loss / (episodes * 25 * 6) as f64).sqrt();
            assert!((share - loss).abs() < tolerance, "{name}: {share}");
        }
    }

    #[test]
    fn a_given_matrix_is_walked() {
        let spec: Spec = serde_json::from_str(r#"{"name":"markov","matrix":[[0,1],[1,0]]}"#).unwrap();
        let rows = emit_rows(&*build(&spec, &test_setting(1.0)).unwrap(), 2, 6, 0);
        assert!(rows.iter().enumerate().all(|(t, bits)| bits[1] == (t % 2 == 0)));
    }

    #[test]
    fn a_chain_may_start_anywhere() {
        let spec: Spec =
            serde_json::from_str(r#"{"name":"markov","matrix":[[0,1],[1,0]],"start":[0.25,0.75]}"#).unwrap();
        let link = build(&spec, &test_setting(1.0)).unwrap();
        let lost = (0..4000).filter(|&e| !emit_rows(&*link, 2, 2, e)[0][1]).count() as f64 / 4000.0;
        assert!((lost - 0.75).abs() < 0.035, "{lost}"); // 5 standard errors
        let rows = emit_rows(&*link, 2, 6, 7);
        assert!(rows.windows(2).all(|w| w[0][1] != w[1][1]), "and goes on as the matrix says");
    }

    #[test]
    fn malformed_chains_are_refused() {
        let error =
            |json: &str| build(&serde_json::from_str(json).unwrap(), &test_setting(1.0)).err().unwrap().to_string();
        assert_eq!(
            error(r#"{"name":"markov","matrix":[[0.5,0.4],[1,0]]}"#),
            "markov: matrix row 0 must sum to 1, found 0.9"
        );
        assert_eq!(
            error(r#"{"name":"markov","matrix":[[1],[1,0]]}"#),
            "markov: matrix must be square: row 0 has 1 of 2 entries"
        );
        assert_eq!(
            error(r#"{"name":"markov","matrix":[[1.5,-0.5],[1,0]]}"#),
            "markov: matrix row 0: probabilities must be in [0, 1], found 1.5"
        );
        assert!(error(r#"{"name":"markov","level":"havy"}"#).contains("unknown variant `havy`"));
        assert!(error(r#"{"name":"markov"}"#).contains("give a level"));
        assert!(error(r#"{"name":"markov","level":"light","matrix":[[1]]}"#).contains("disagree"));
        assert!(error(r#"{"name":"markov","matrix":[]}"#).contains("1 to 64 rows"));
        assert_eq!(
            error(r#"{"name":"markov","level":"light","start":[1]}"#),
            "markov: start must have 3 entries, as the matrix, found 1"
        );
        assert_eq!(
            error(r#"{"name":"markov","matrix":[[1,0],[1,0]],"start":[0.5,0.2]}"#),
            "markov: start must sum to 1, found 0.7"
        );
    }
}
