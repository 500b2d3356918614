//! The samples of a store's links put together, or divided by step.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::PairsError;
use crate::schema::{Columns, NOTE, SampleLabels, Samples};

/// What has an estimate of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct By {
    /// Each sender; otherwise all senders are pooled.
    pub sender: bool,
    /// Each receiver.
    pub receiver: bool,
    /// So many steps of the episode at a time.
    pub steps: Option<usize>,
}

impl By {
    /// Reads `sender`, `receiver`, `none` and `step:N`; no word, and `step:N` alone, are every link.
    ///
    /// # Errors
    /// [`PairsError::By`] for any other word.
    pub fn parse(words: &[String]) -> Result<Self, PairsError> {
        let mut by = Self { sender: false, receiver: false, steps: None };
        let mut links = true;
        for word in words {
            match (word.as_str(), word.strip_prefix("step:").map(str::parse)) {
                ("sender", _) => (by.sender, links) = (true, false),
                ("receiver", _) => (by.receiver, links) = (true, false),
                ("none", _) => links = false,
                (_, Some(Ok(steps))) if steps > 0 => by.steps = Some(steps),
                _ => return Err(PairsError::By(word.clone())),
            }
        }
        (by.sender, by.receiver) = (by.sender || links, by.receiver || links);
        Ok(by)
    }

    /// Whether every link stands alone, over all steps.
    pub fn is_links(self) -> bool {
        self == Self { sender: true, receiver: true, steps: None }
    }

    /// The sets of one lag, divided by step and pooled. Those of a class stay in the order of their first link.
    ///
    /// Of what is pooled the rows of one episode are one episode: link after link, so that a null test exchanges all
    /// messages of an episode together. Messages (and actions) narrower than the widest get zeros behind them, as the
    /// trainer's estimators read them.
    ///
    /// # Errors
    /// [`PairsError::TooManyRows`], [`PairsError::TooManySteps`].
    pub fn regroup(self, mut sets: Vec<Samples>) -> Result<Vec<Samples>, PairsError> {
        if let Some(steps) = self.steps {
            sets = divided(&sets, steps)?;
        }
        if self.sender && self.receiver {
            return Ok(sets);
        }
        let key = |labels: &SampleLabels| {
            let (sender, receiver) = (labels.sender.clone(), labels.receiver.clone());
            (
                sender.filter(|_| self.sender),
                receiver.filter(|_| self.receiver),
                labels.within.clone(),
                labels.delivered,
            )
        };
        let mut pools: Vec<Vec<Samples>> = Vec::new();
        for set in sets {
            match pools.iter_mut().find(|pool| key(&pool[0].labels) == key(&set.labels)) {
                Some(pool) => pool.push(set),
                None => pools.push(vec![set]),
            }
        }
        pools.iter().map(|pool| self.pooled(pool)).collect()
    }

    fn pooled(self, pool: &[Samples]) -> Result<Samples, PairsError> {
        let first = &pool[0];
        let starts: Vec<usize> = first.starts.iter().map(|start| start * pool.len()).collect();
        if starts.last().is_some_and(|&rows| rows > u32::MAX as usize) {
            return Err(PairsError::TooManyRows);
        }
        let mut rows = Vec::with_capacity(pool.iter().map(Samples::len).sum());
        let mut next = vec![0; pool.len()];
        for (e, window) in first.starts.windows(2).enumerate() {
            for (k, set) in pool.iter().enumerate() {
                let before = next[k];
                next[k] += set.rows[before..].iter().take_while(|&&row| (row as usize) < window[1]).count();
                let at = starts[e] + k * (window[1] - window[0]);
                rows.extend(set.rows[before..next[k]].iter().map(|&row| (at + row as usize - window[0]) as u32));
            }
        }
        let (x, y): (Vec<_>, Vec<_>) = pool.iter().map(|set| (&*set.x, &*set.y)).unzip();
        let [x_name, y_name] = ["message", "action"];
        let suffix = first.labels.y.rfind("[+").map_or("", |at| &first.labels.y[at..]);
        let mut labels = first.labels.clone();
        if !self.sender {
            (labels.sender, labels.x) = (None, x_name.to_owned());
        }
        if !self.receiver {
            (labels.receiver, labels.y) = (None, format!("{y_name}{suffix}"));
        }
        let mut notes = first.notes.clone();
        notes.push(format!("{NOTE}{} links are pooled", pool.len()));
        for (name, columns) in [(x_name, &x), (y_name, &y)] {
            if columns.iter().any(|c| c.width() != columns[0].width()) {
                notes.push(format!("{NOTE}{name}s narrower than the widest have zeros behind them"));
            }
        }
        let side_by_side = |parts: &[&Columns], name: &str| Arc::new(stacked(parts, &first.starts, name));
        Ok(Samples {
            x: side_by_side(&x, if self.sender { &labels.x } else { x_name }),
            y: side_by_side(
                &y,
                if self.receiver { first.labels.y.strip_suffix(suffix).unwrap_or_default() } else { y_name },
            ),
            z: None,
            starts: starts.into(),
            rows,
            exchange: first.exchange,
            labels,
            notes,
        })
    }
}

/// The rows of each episode, part after part.
fn stacked(parts: &[&Columns], starts: &[usize], name: &str) -> Columns {
    let width = parts.iter().map(|part| part.width()).max().unwrap_or(0);
    let mut data = Vec::with_capacity(starts.last().unwrap_or(&0) * parts.len() * width);
    for window in starts.windows(2) {
        for part in parts {
            for row in window[0]..window[1] {
                data.extend_from_slice(part.row(row));
                data.resize(data.len() + width - part.width(), 0.0);
            }
        }
    }
    let names = (0..width).map(|i| if width == 1 { name.to_owned() } else { format!("{name}[{i}]") });
    Columns::new(data, names.collect())
}

/// Most ranges of steps.
const RANGES: usize = 1000;

/// Every set divided by the step of its samples, `steps` at a time; ranges without a sample are left out.
fn divided(sets: &[Samples], steps: usize) -> Result<Vec<Samples>, PairsError> {
    let mut out = Vec::new();
    for set in sets {
        let step = |(&row, &episode): (&u32, &u32)| row as usize - set.starts[episode as usize];
        let episodes = set.episodes();
        let of = || set.rows.iter().zip(&episodes);
        let mut ranges: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
        of().for_each(|pair| ranges.entry(step(pair) / steps).or_default().push(*pair.0));
        if ranges.len() > RANGES {
            return Err(PairsError::TooManySteps { steps, most: RANGES });
        }
        for (range, rows) in ranges {
            let within = format!("steps {}–{}", range * steps, range * steps + steps - 1);
            let labels = SampleLabels {
                group: format!("{}, {within}", set.labels.group),
                within: Some(within),
                ..set.labels.clone()
            };
            out.push(Samples { rows, labels, ..set.clone() });
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pairs::store::tests::store;
    use crate::pairs::{Lagging, Predicate, links};

    fn by(words: &[&str]) -> Result<By, String> {
        By::parse(&words.iter().map(ToString::to_string).collect::<Vec<_>>()).map_err(|e| e.to_string())
    }

    #[test]
    fn words_say_what_stands_alone() {
        assert!(by(&[]).unwrap().is_links() && by(&["receiver", "sender"]).unwrap().is_links());
        let named = |words: &[&str]| by(words).map(|by| (by.sender, by.receiver, by.steps)).unwrap();
        assert_eq!(named(&["sender"]), (true, false, None));
        assert_eq!(named(&["step:10"]), (true, true, Some(10)));
        assert_eq!(named(&["none", "step:5"]), (false, false, Some(5)));
        for wrong in ["agent", "step:0", "step:", "step"] {
            let error = by(&[wrong]).unwrap_err();
            assert_eq!(
                error,
                format!("--by {wrong:?}: of a store expected sender, receiver, none (all links pooled) or step:N")
            );
        }
    }

    /// x, y of every sample.
    fn samples(set: &Samples) -> Vec<(Vec<f64>, Vec<f64>)> {
        set.rows.iter().map(|&r| (set.x.row(r as usize).to_vec(), set.y.row(r as usize).to_vec())).collect()
    }

    #[test]
    fn a_pool_has_the_samples_of_its_links_episode_by_episode() {
        let sets = links(&mut store(3, &[3, 2])).unwrap().sets;
        let pooled = by(&["receiver"]).unwrap().regroup(sets.clone()).unwrap();
        let names: Vec<_> = pooled
            .iter()
            .map(|s| (s.labels.sender.clone(), s.labels.receiver.clone().unwrap(), s.labels.delivered))
            .collect();
        let expected = [("agent_1", true), ("agent_1", false), ("agent_2", true), ("agent_0", true)];
        assert_eq!(names, expected.map(|(name, delivered)| (None, name.to_owned(), Some(delivered))));
        for pool in &pooled {
            let own = |s: &&Samples| {
                (&s.labels.receiver, s.labels.delivered) == (&pool.labels.receiver, pool.labels.delivered)
            };
            let mut expected: Vec<_> = sets.iter().filter(own).flat_map(samples).collect();
            let mut found = samples(pool);
            let value = |sample: &(Vec<f64>, Vec<f64>)| (sample.1[0], sample.0[0]);
            expected.sort_by(|a, b| value(a).partial_cmp(&value(b)).unwrap());
            found.sort_by(|a, b| value(a).partial_cmp(&value(b)).unwrap());
            assert_eq!(found, expected);
            assert!(pool.rows.is_sorted() && pool.labels.x == "message");
            // values are 100 e + …: every sample lies in its own episode
            for (&row, episode) in pool.rows.iter().zip(pool.episodes()) {
                assert_eq!((pool.x.row(row as usize)[0] / 100.0).floor(), f64::from(episode));
            }
        }
        let all = by(&["none"]).unwrap().regroup(sets).unwrap();
        assert_eq!(all.iter().map(Samples::len).collect::<Vec<_>>(), [6 * 5 - 2, 2]);
        assert_eq!(
            (all[0].labels.y.as_str(), all[0].notes.as_slice()),
            ("action", &["note: 6 links are pooled".to_owned()][..])
        );
    }

    #[test]
    fn a_lag_comes_before_pooling_and_never_crosses_links() {
        let sets = links(&mut store(2, &[3, 2])).unwrap().sets;
        let mut lagging = Lagging::default();
        let lagged = sets.iter().map(|set| lagging.lagged(set, 1).unwrap()).collect();
        let all = by(&["none"]).unwrap().regroup(lagged).unwrap();
        assert_eq!(all[0].labels.y, "action[+1]");
        for (x, y) in all.iter().flat_map(samples) {
            let (step, other) = (y[0] - x[0], if x[0] % 10.0 == 0.0 { 1.0 } else { -1.0 });
            assert_eq!(step, 10.0 + other, "{x:?} {y:?}");
        }
    }

    #[test]
    fn narrow_messages_have_zeros_behind_them() {
        let mut sets = links(&mut store(2, &[2])).unwrap().sets;
        sets.retain(|set| set.labels.delivered == Some(true));
        sets[1].x = Arc::new(Columns::new(vec![5.0, 6.0, 7.0, 8.0], vec!["a".to_owned(), "b".to_owned()]));
        let pool = by(&["none"]).unwrap().regroup(sets).unwrap().remove(0);
        assert_eq!(pool.x.data, [0.0, 0.0, 10.0, 0.0, 5.0, 6.0, 7.0, 8.0]);
        assert_eq!(pool.x.names, ["message[0]", "message[1]"]);
        assert_eq!(pool.notes[1], "note: messages narrower than the widest have zeros behind them");
    }

    #[test]
    fn steps_are_divided_and_conditions_leave_messages_out() {
        let sets = links(&mut store(2, &[3, 2])).unwrap().sets;
        let divided = by(&["step:2"]).unwrap().regroup(sets).unwrap();
        let found: Vec<_> = divided.iter().map(|s| (s.labels.group.as_str(), s.rows.clone())).collect();
        let first = "episode, steps 0–1";
        assert_eq!(
            found,
            [
                (first, vec![0, 3]),
                ("episode, steps 2–3", vec![2]),
                (first, vec![1, 4]),
                (first, vec![0, 1, 3, 4]),
                ("episode, steps 2–3", vec![2])
            ]
        );
        let keep = |text: &str| {
            let mut found = links(&mut store(2, &[3, 0, 2])).unwrap();
            let kept = found.keep(&Predicate::parse(text).unwrap(), std::path::Path::new("data/x"));
            kept.map(|()| found.sets.into_iter().map(|s| (s.labels.sender.unwrap(), s.rows)).collect::<Vec<_>>())
        };
        let of = |sender: &str, rows: &[u32]| (sender.to_owned(), rows.to_vec());
        // the second episode has no step, and keeps its number
        assert_eq!(keep("episode = 2 AND sender = 'agent_1'").unwrap(), [of("agent_1", &[3, 4])]);
        assert_eq!(keep("NOT delivered AND step < 2").unwrap(), [of("agent_0", &[1, 4])]);
        assert_eq!(
            keep("step > 7").unwrap_err().to_string(),
            "no rows: --where \"step > 7\" keeps none of the 10 rows: data/x"
        );
        assert_eq!(keep("steps > 7").unwrap_err().to_string(), "no column \"steps\": did you mean step?: data/x");
    }
}
