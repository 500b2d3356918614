//! The fit: each family on a part of the episodes, compared on the others, then the chosen one on all.

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::chain::{self, Chain, LEAST_VISITS, MAX_LOSSES, Runs};
use super::score::{Tally, gain, tallies};
use super::threshold::{self, Range};
use super::{ChannelError, DataSource, Observations, Score, classifier};
use crate::link::{Classifier, FITTED_KIND};
use crate::registry::{RegistryError, did_you_mean, resolved};
use crate::rng::{Seeds, permutation};
use crate::stats::{Interval, clopper_pearson, homogeneity};

/// The models, simplest first, and what each says: `auto` takes the simplest that none beats.
pub const MODELS: [(&str, &str); 5] = [
    ("dropout", "each message is lost with one probability"),
    ("distance", "messages reach as far as a threshold"),
    ("markov", "losses come in bursts: a chain, its order chosen on held-out episodes"),
    ("learned", "a classifier of the pair's relative state, calibrated"),
    ("auto", "all of these, compared on held-out episodes"),
];

/// Standard errors by which a model must beat a simpler one.
const MARGIN: f64 = 3.0;

/// Confidence of every set of intervals.
const LEVEL: f64 = 0.95;

/// A fitted number with its interval.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Parameter {
    /// What it is, with its unit.
    pub name: String,
    /// Its estimate.
    pub value: f64,
    /// Lower end of the interval; all intervals of a fit hold together at 95 %.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// Messages behind it, where it is a share of messages.
    pub messages: Option<u64>,
}

/// What came of a model.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum FitOutcome {
    /// It was scored on the held-out episodes.
    Scored {
        /// Its score.
        score: Score,
        /// How much less it explains than the best model, nats per message.
        behind: f64,
        /// Standard error of that over episodes.
        error: f64,
    },
    /// It cannot be fitted to these data.
    Refused {
        /// Why.
        reason: String,
    },
}

/// A model in the comparison.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// Its name.
    pub model: &'static str,
    /// What came of it.
    #[serde(flatten)]
    pub outcome: FitOutcome,
}

/// A fitted link and how it was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// The model: the one asked for, or the one that `auto` took.
    pub model: &'static str,
    /// The link, as its parameters.
    #[serde(skip)]
    pub link: Map<String, Value>,
    /// Seed of splits and training.
    pub seed: u64,
    /// What it was fitted on.
    pub data: DataSource,
    /// Messages that were used.
    pub messages: usize,
    /// Lost ones among them.
    pub lost: usize,
    /// What was fitted, with simultaneous intervals.
    pub parameters: Vec<Parameter>,
    /// How well it predicts episodes that it was not fitted on.
    pub held_out: Score,
    /// All models that were tried.
    pub compared: Vec<Compared>,
    /// What a reader must know.
    pub notes: Vec<String>,
}

impl Fit {
    /// The file that the link `file:PATH` reads.
    ///
    /// # Errors
    /// When it cannot be written as JSON.
    pub fn to_json(&self) -> Result<String, serde_json::Error> {
        let version = env!("CARGO_PKG_VERSION");
        let document = json!({"kind": FITTED_KIND, "ccmarl": version, "link": self.link, "fit": self});
        Ok(serde_json::to_string_pretty(&document)? + "\n")
    }
}

/// A fitted model.
enum Fitted {
    Dropout(Chain),
    Markov(Chain),
    Distance(Range),
    Learned(Classifier),
}

/// Who is fitted on, who stops and calibrates, who is predicted.
struct Parts {
    train: Vec<usize>,
    validation: Vec<usize>,
    test: Vec<usize>,
}

impl Parts {
    /// 55, 15 and 30 of 100 episodes, at random.
    fn of(episodes: usize, seeds: &Seeds) -> Self {
        let order = permutation(&mut seeds.stream("split"), episodes);
        let (train, validation) = (episodes * 55 / 100, episodes * 70 / 100);
        let part = |range: std::ops::Range<usize>| {
            let mut part = order[range].to_vec();
            part.sort_unstable();
            part
        };
        Self { train: part(0..train), validation: part(train..validation), test: part(validation..episodes) }
    }

    /// Everyone who is not predicted.
    fn seen(&self) -> Vec<usize> {
        let mut seen = [self.train.as_slice(), &self.validation].concat();
        seen.sort_unstable();
        seen
    }
}

impl Fitted {
    /// Fits a model to some episodes; `parts` says by which ones a classifier stops.
    fn fit(
        model: &'static str,
        observations: &Observations,
        episodes: &[usize],
        parts: &Parts,
        seeds: &Seeds,
        progress: &dyn Fn(f64),
    ) -> Result<Self, ChannelError> {
        let runs = || Runs::sum(episodes.iter().map(|&e| Runs::of(observations, e)).collect::<Vec<_>>().iter());
        Ok(match model {
            "dropout" => Self::Dropout(Chain::fit(&runs(), 1)),
            "markov" => Self::Markov(Chain::fit(&runs(), chain::earned(observations, episodes, seeds)?)),
            "distance" => {
                let states = observations.states(model)?;
                let messages = episodes.iter().flat_map(|&e| observations.episode(e));
                Self::Distance(threshold::fit(messages.map(|m| (states[m][2], observations.lost[m])).collect()))
            }
            _ => {
                let states = observations.states(model)?;
                let own = [parts.train.as_slice(), &parts.validation];
                Self::Learned(classifier::train(observations, states, own, &seeds.child("learned"), progress))
            }
        })
    }

    /// Appends the predicted loss probability of each message of an episode.
    fn predict(&self, observations: &Observations, episode: usize, out: &mut Vec<f64>) {
        let states = |m: usize| observations.features.as_ref().map_or([0.0; 5], |all| all[m]);
        let messages = observations.episode(episode);
        match self {
            Self::Dropout(chain) | Self::Markov(chain) => chain.predict_episode(observations, episode, out),
            Self::Distance(range) => out.extend(messages.map(|m| range.predict(&states(m)))),
            Self::Learned(classifier) => out.extend(messages.map(|m| {
                // a logit beyond ±30 would round to certainty, and one surprise to minus infinity
                let p = classifier.probability(classifier.logit(&states(m)));
                p.clamp(1e-13, 1.0 - 1e-13)
            })),
        }
    }

    /// The link's parameters.
    fn link(&self, unit: f64) -> Map<String, Value> {
        match self {
            Self::Dropout(chain) => resolved("dropout", &json!({"p": chain.lost[0]})),
            Self::Markov(chain) => {
                let mut link = resolved("markov", &json!({"matrix": chain.matrix()}));
                if chain.first > 0.0 {
                    let mut start = vec![0.0; chain.lost.len()];
                    (start[0], start[1]) = (1.0 - chain.first, chain.first);
                    link.insert("start".to_owned(), json!(start));
                }
                link
            }
            Self::Distance(range) => resolved("distance", &json!({"threshold": range.reach / unit, "unit": unit})),
            Self::Learned(classifier) => resolved("learned", classifier),
        }
    }

    /// What was fitted, with intervals that hold together.
    fn parameters(&self, observations: &Observations, runs: &Runs) -> Vec<Parameter> {
        let unit = observations.source.distance_unit;
        match self {
            Self::Dropout(_) => {
                let all = [observations.messages() as u64, observations.lost.iter().filter(|&&l| l).count() as u64];
                shares(&[("probability of loss".to_owned(), all)])
            }
            Self::Markov(chain) => {
                let delivered = |[all, lost]: [u64; 2]| [all, all - lost];
                let mut rows = vec![("P(delivered), first message".to_owned(), delivered(runs.first))];
                let seen = |m: &usize| runs.after[*m][0] >= LEAST_VISITS;
                for m in (0..=MAX_LOSSES).filter(seen) {
                    let more = if m == MAX_LOSSES { " or more" } else { "" };
                    rows.push((format!("P(delivered) after {m}{more} losses"), delivered(runs.after[m])));
                }
                let last = chain.lost.len() - 1;
                if runs.from(last)[0] > runs.after[last][0] {
                    let name = format!("P(delivered) after {last} or more losses: the chain's last state");
                    rows.push((name, delivered(runs.from(last))));
                }
                shares(&rows)
            }
            Self::Distance(range) => {
                let scaled = |name: &str, by: f64| Parameter {
                    name: name.to_owned(),
                    value: range.reach / by,
                    low: range.low / by,
                    high: range.high / by,
                    messages: None,
                };
                vec![scaled("threshold, units", unit), scaled("range, world units", 1.0)]
            }
            Self::Learned(_) => Vec::new(),
        }
    }

    /// What a reader of the fit must know.
    fn notes(&self, observations: &Observations, runs: &[Runs], seeds: &Seeds) -> Vec<String> {
        let mut notes = Vec::new();
        let (used, episodes) = (observations.episodes() as u64, observations.source.episodes);
        if used < episodes {
            notes.push(format!("the first {used} of {episodes} episodes were used: more do not fit in memory"));
        }
        if observations.stride > 1 {
            let (used, stride) = (observations.links(), observations.stride);
            notes.push(format!("{used} directed links were used, one of {stride}: more do not fit in memory"));
        }
        if let Self::Dropout(_) | Self::Markov(_) = self {
            let differ = differ(observations, matches!(self, Self::Markov(_)));
            notes.extend(
                differ.map(|p| format!("the links differ (chi-square p = {p:.1e}): one model for all is a compromise")),
            );
        }
        match self {
            Self::Dropout(_) => {
                let order = chain::choose_order(runs, seeds);
                if order.states > 1 {
                    notes.push(format!(
                        "losses come in bursts (a chain explains {:.5} ± {:.5} nats per message more): the interval is too narrow; fit markov",
                        order.gain, order.error
                    ));
                }
            }
            Self::Distance(range) if range.contradictions > 0 => {
                let share = 100.0 * range.contradictions as f64 / observations.messages() as f64;
                notes.push(format!(
                    "{} messages ({share:.2} %) contradict every threshold: the range is not all there is to this link, and the interval is approximate",
                    range.contradictions
                ));
            }
            Self::Markov(chain) if chain.first > 0.0 => {
                notes.push(
                    "an episode may start within a burst: such a burst is taken to be in its first loss".to_owned(),
                );
            }
            _ => {}
        }
        notes
    }
}

/// Shares of messages with exact intervals, simultaneous by Bonferroni.
fn shares(rows: &[(String, [u64; 2])]) -> Vec<Parameter> {
    let level = 1.0 - (1.0 - LEVEL) / rows.len() as f64;
    let share = |(name, [all, hit]): &(String, [u64; 2])| {
        let Interval { low, high } = clopper_pearson(*hit, *all, level);
        let value = if *all == 0 { f64::NAN } else { *hit as f64 / *all as f64 };
        Parameter { name: name.clone(), value, low, high, messages: Some(*all) }
    };
    rows.iter().map(share).collect()
}

/// The p-value of "all links lose alike", where it is below 0.001; in a chain, of messages after a delivered one.
fn differ(observations: &Observations, chain: bool) -> Option<f64> {
    let mut counts = vec![[0_u64; 2]; observations.links()];
    for episode in 0..observations.episodes() {
        for (count, sequence) in counts.iter_mut().zip(observations.sequences(episode)) {
            let mut runs = Runs::default();
            runs.add(&observations.lost[sequence]);
            let [all, lost] = if chain { runs.after[0] } else { runs.total() };
            (count[0], count[1]) = (count[0] + all - lost, count[1] + lost);
        }
    }
    let counts: Vec<&[u64]> = counts.iter().map(<[u64; 2]>::as_slice).collect();
    homogeneity(&counts).map(|test| test.p_value).filter(|&p| p < 0.001)
}

/// A model that was scored on the held-out episodes.
struct Candidate {
    model: &'static str,
    fitted: Fitted,
    tallies: Vec<Tally>,
}

/// Fits `model` (a name of [`MODELS`]) to the observations. `progress` is told the model at work and the share of it that
/// is done.
///
/// # Errors
/// [`ChannelError::Registry`] for a model that there is not, those of [`Observations::check`],
/// [`ChannelError::NoPositions`] and [`ChannelError::NoChain`] when it was asked for by name.
pub fn fit(
    observations: &Observations,
    model: &str,
    seed: u64,
    progress: &dyn Fn(&'static str, f64),
) -> Result<Fit, ChannelError> {
    let known = MODELS.iter().map(|(name, _)| *name);
    let Some(model) = known.clone().find(|name| *name == model) else {
        let hint = did_you_mean(model, known);
        return Err(RegistryError::Unknown { kind: "model", name: model.to_owned(), hint }.into());
    };
    observations.check()?;
    let seeds = Seeds::new(seed).child("fit-link");
    let parts = Parts::of(observations.episodes(), &seeds);
    let seen = parts.seen();
    let mut candidates = Vec::new();
    let mut refused = Vec::new();
    for name in known.filter(|&name| name != "auto" && (model == "auto" || model == name)) {
        progress(name, 0.0);
        let fitted = Fitted::fit(name, observations, &seen, &parts, &seeds, &|share| progress(name, share));
        match fitted {
            Ok(fitted) => {
                let tallies = tallies(observations, &parts.test, |e, out| fitted.predict(observations, e, out));
                candidates.push(Candidate { model: name, fitted, tallies });
            }
            Err(error) if model != "auto" => return Err(error),
            Err(error) => refused.push((name, error.to_string())),
        }
    }
    let (chosen, behind) = choose(&candidates);
    let scores: Vec<Score> = candidates.iter().map(|c| Score::of(&c.tallies, &seeds)).collect();
    let held_out = scores[chosen].clone();
    let scored = candidates.iter().zip(scores).zip(behind);
    let mut compared: Vec<Compared> = scored
        .map(|((c, score), (behind, error))| Compared {
            model: c.model,
            outcome: FitOutcome::Scored { score, behind, error },
        })
        .collect();
    compared
        .extend(refused.into_iter().map(|(model, reason)| Compared { model, outcome: FitOutcome::Refused { reason } }));
    let Candidate { model, fitted, .. } = candidates.swap_remove(chosen);
    let all: Vec<usize> = (0..observations.episodes()).collect();
    // a classifier stops by episodes that it does not learn from: it stays the one that was scored
    let whole = match fitted {
        Fitted::Learned(classifier) => Fitted::Learned(classifier),
        first => Fitted::fit(model, observations, &all, &parts, &seeds, &|_| ()).unwrap_or(first),
    };
    let runs: Vec<Runs> = all.iter().map(|&e| Runs::of(observations, e)).collect();
    Ok(Fit {
        model,
        link: whole.link(observations.source.distance_unit),
        seed,
        data: observations.source.clone(),
        messages: observations.messages(),
        lost: observations.lost.iter().filter(|&&lost| lost).count(),
        parameters: whole.parameters(observations, &Runs::sum(runs.iter())),
        held_out,
        compared,
        notes: whole.notes(observations, &runs, &seeds),
    })
}

/// The place of the simplest candidate that the best one does not beat by [`MARGIN`] standard errors, and per candidate
/// how far it is behind the best.
fn choose(candidates: &[Candidate]) -> (usize, Vec<(f64, f64)>) {
    let likelihoods: Vec<Vec<f64>> =
        candidates.iter().map(|c| c.tallies.iter().map(|tally| tally.log).collect()).collect();
    let messages: Vec<u64> = candidates.first().map_or(Vec::new(), |c| c.tallies.iter().map(Tally::messages).collect());
    let total = |c: usize| likelihoods[c].iter().sum::<f64>();
    let best = (0..candidates.len()).reduce(|best, c| if total(c) > total(best) { c } else { best }).unwrap_or(0);
    let behind: Vec<(f64, f64)> = likelihoods.iter().map(|own| gain(&likelihoods[best], own, &messages)).collect();
    let chosen = behind.iter().position(|&(behind, error)| behind <= MARGIN * error).unwrap_or(best);
    (chosen, behind)
}
