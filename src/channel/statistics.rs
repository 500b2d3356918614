//! What a link does, counted: loss per step of the episode, lengths of bursts, loss against distance, per directed link.

use serde::Serialize;

use crate::schema::{Episode, Layout};

/// World units per bin of distance.
pub const BIN_WIDTH: f64 = 0.1;

/// First line of the table of counts.
const CSV_HEADER: &str = "sender,receiver,kind,at,messages,lost";

/// Bins of distance; the last takes everything beyond.
const BINS: usize = 100;

/// Counts of one directed link, or of all.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Observed {
    /// Per step of the episode: messages, lost ones. The row after the last action is not counted.
    pub steps: Vec<[u64; 2]>,
    /// Bursts by length: `bursts[k]` are k + 1 losses in a row; one that the episode's end cuts counts as long as it was.
    pub bursts: Vec<u64>,
    /// Per [`BIN_WIDTH`] of distance at the time of sending: messages, lost ones; empty without positions.
    pub distances: Vec<[u64; 2]>,
}

/// Adds counts elementwise; the longer list stays as long.
fn add<T: Copy>(own: &mut Vec<T>, other: &[T], zero: T, sum: impl Fn(T, T) -> T) {
    if own.len() < other.len() {
        own.resize(other.len(), zero);
    }
    own.iter_mut().zip(other).for_each(|(a, &b)| *a = sum(*a, b));
}

fn pair(a: [u64; 2], b: [u64; 2]) -> [u64; 2] {
    [a[0] + b[0], a[1] + b[1]]
}

/// Counts one message at `place`.
fn count(list: &mut Vec<[u64; 2]>, place: usize, lost: bool) {
    if list.len() <= place {
        list.resize(place + 1, [0; 2]);
    }
    list[place] = pair(list[place], [1, u64::from(lost)]);
}

impl Observed {
    /// Messages, lost ones.
    pub fn total(&self) -> [u64; 2] {
        self.steps.iter().fold([0; 2], |sum, &step| pair(sum, step))
    }

    /// Mean length of a burst, messages; `None` without one.
    pub fn mean_burst(&self) -> Option<f64> {
        let bursts: u64 = self.bursts.iter().sum();
        (bursts > 0).then(|| self.total()[1] as f64 / bursts as f64)
    }

    fn add(&mut self, other: &Self) {
        add(&mut self.steps, &other.steps, [0; 2], pair);
        add(&mut self.bursts, &other.bursts, 0, |a, b| a + b);
        add(&mut self.distances, &other.distances, [0; 2], pair);
    }

    fn end_burst(&mut self, run: &mut usize) {
        if *run > 0 {
            let longer = *run - 1;
            if self.bursts.len() <= longer {
                self.bursts.resize(longer + 1, 0);
            }
            self.bursts[longer] += 1;
            *run = 0;
        }
    }
}

/// Counts per directed link of a team.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LinkStatistics {
    /// Sender and receiver of each link, sender-major.
    pub links: Vec<(String, String)>,
    /// What each did.
    pub observed: Vec<Observed>,
    /// Place of each communicator's x and y in a row of state, where there are positions.
    #[serde(skip)]
    places: Vec<Option<[usize; 2]>>,
    #[serde(skip)]
    width: usize,
}

impl LinkStatistics {
    /// No counts yet, for stores of this layout.
    pub fn new(layout: &Layout) -> Self {
        let communicators = layout.communicators();
        let name = |agent: usize| layout.agents[agent].name.clone();
        let at = |agent: usize, field: &str| {
            layout.state_fields.iter().position(|f| *f == format!("{}.{field}", layout.agents[agent].name))
        };
        let links: Vec<_> = layout.links().into_iter().map(|(s, r)| (name(s), name(r))).collect();
        Self {
            observed: vec![Observed::default(); links.len()],
            links,
            places: communicators.iter().map(|&a| Some([at(a, "x")?, at(a, "y")?])).collect(),
            width: layout.state_fields.len(),
        }
    }

    /// Counts an episode.
    pub fn add(&mut self, episode: &Episode) {
        let n = self.places.len();
        let pairs = (0..n * n).map(|cell| (cell / n, cell % n)).filter(|(s, r)| s != r);
        for ((s, r), observed) in pairs.zip(&mut self.observed) {
            let mut run = 0;
            for step in 0..episode.steps {
                let lost = !episode.delivered(n, step, s, r);
                count(&mut observed.steps, step, lost);
                if lost {
                    run += 1;
                } else {
                    observed.end_burst(&mut run);
                }
                if let (Some(a), Some(b)) = (self.places[s], self.places[r]) {
                    let at = |i: usize| episode.state[step * self.width + i];
                    let (dx, dy) = (at(a[0]) - at(b[0]), at(a[1]) - at(b[1]));
                    let bin = ((dx * dx + dy * dy).sqrt() / BIN_WIDTH) as usize;
                    count(&mut observed.distances, bin.min(BINS - 1), lost);
                }
            }
            observed.end_burst(&mut run);
        }
    }

    /// Adds the counts of other episodes of the same team.
    #[must_use]
    pub fn merge(mut self, other: &Self) -> Self {
        self.observed.iter_mut().zip(&other.observed).for_each(|(own, others)| own.add(others));
        self
    }

    /// All links together.
    pub fn total(&self) -> Observed {
        let mut total = Observed::default();
        self.observed.iter().for_each(|observed| total.add(observed));
        total
    }

    /// Whether a file's bytes begin as [`Self::csv`] does.
    pub fn is_csv(bytes: &[u8]) -> bool {
        bytes.strip_prefix(CSV_HEADER.as_bytes()).is_some_and(|rest| rest.starts_with(b"\n"))
    }

    /// One line per link and step, burst length or bin of distance: `sender,receiver,kind,at,messages,lost`; of a burst
    /// length `at`, `lost` is the number of bursts, and of a bin `at` its lower end, world units.
    pub fn csv(&self) -> String {
        let mut lines = vec![CSV_HEADER.to_owned()];
        for ((sender, receiver), observed) in self.links.iter().zip(&self.observed) {
            let mut line = |kind: &str, at: String, messages: String, lost: u64| {
                lines.push(format!("{sender},{receiver},{kind},{at},{messages},{lost}"));
            };
            for (step, [messages, lost]) in observed.steps.iter().enumerate() {
                line("step", step.to_string(), messages.to_string(), *lost);
            }
            for (length, bursts) in observed.bursts.iter().enumerate().filter(|(_, b)| **b > 0) {
                line("burst", (length + 1).to_string(), String::new(), *bursts);
            }
            for (bin, [messages, lost]) in observed.distances.iter().enumerate().filter(|(_, d)| d[0] > 0) {
                line("distance", format!("{:.1}", bin as f64 * BIN_WIDTH), messages.to_string(), *lost);
            }
        }
        lines.join("\n") + "\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::{AgentSpec, Controller};

    /// Two agents; the bits of a→b of each row, b→a always arrives; a stays at 0, b stands at the step's number.
    fn counted(bits: &[u8]) -> LinkStatistics {
        let agent = |name: &str| AgentSpec {
            name: name.to_owned(),
            team: "t".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 0,
            message: 0,
            action: 0,
        };
        let state_fields = ["a.x", "a.y", "b.x", "b.y"].map(ToOwned::to_owned).to_vec();
        let layout = Layout { agents: vec![agent("a"), agent("b")], state_fields };
        let steps = bits.len() - 1;
        let link = bits.iter().flat_map(|&b| [true, b == 1, true, true]).collect();
        let state = (0..=steps).flat_map(|t| [0.0, 0.0, 0.0, t as f64]).collect();
        let mut statistics = LinkStatistics::new(&layout);
        statistics.add(&Episode { steps, state, link, ..Episode::default() });
        statistics
    }

    #[test]
    fn steps_bursts_and_distances_are_counted() {
        let statistics = counted(&[1, 0, 0, 1, 0, 1, 0]);
        let [forth, back] = &statistics.observed[..] else { panic!("two links") };
        assert_eq!(forth.steps, [[1, 0], [1, 1], [1, 1], [1, 0], [1, 1], [1, 0]], "the last row is not counted");
        assert_eq!((forth.bursts.clone(), forth.mean_burst()), (vec![1, 1], Some(1.5)));
        assert_eq!((back.total(), back.mean_burst()), ([6, 0], None));
        assert_eq!(forth.distances.len(), 51);
        assert_eq!((forth.distances[10], forth.distances[50]), ([1, 1], [1, 0]));
        let both = statistics.clone().merge(&counted(&[0, 0, 0, 0, 1]));
        assert_eq!(both.observed[0].bursts, [1, 1, 0, 1], "a burst that the end cuts is as long as it was");
        assert_eq!(both.total().total(), [20, 7]);
        assert!(
            statistics.csv().contains("\na,b,burst,2,,1\n") && statistics.csv().contains("\na,b,distance,5.0,1,0\n")
        );
    }
}
