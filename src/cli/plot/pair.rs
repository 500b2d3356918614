//! Everything about one pair of columns: points, estimates, the value on parts of the samples, training.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::cli::estimates::sign;
use crate::cli::jobs::{Gathered, gather};
use crate::figure::{self, Data, Pair, Shrunk, Whisker};
use crate::mi::{self, DIVISIONS, Estimate, Extrapolated, PartValue, Plan, Training, Unit};
use crate::rng::{self, Seeds};
use crate::schema::{Columns, Samples};

/// Most points.
const POINTS: usize = 2000;
/// A column of so few different values is spread a little, so that equal points do not hide each other.
const FEW: usize = 20;

/// What is computed for the picture alone.
pub(super) struct Pieces {
    trainings: Vec<(String, Training)>,
    extrapolated: Option<Extrapolated>,
}

/// One of these things, or nothing where the samples cannot carry it.
enum Piece {
    Training(usize, Option<Training>),
    Part(Option<PartValue>),
}

/// Trains again what trains, looking at it, and estimates on parts of the samples by the first estimator, all but those
/// that `failed`; `None` when a signal came first.
pub(super) fn pieces(
    samples: &Arc<Vec<Samples>>,
    plan: &Arc<Plan>,
    failed: &[&str],
    threads: u16,
) -> anyhow::Result<Option<Pieces>> {
    let names = plan.estimators.iter().map(|(name, _)| name.as_str());
    let usable: Vec<usize> = names.enumerate().filter(|(_, name)| !failed.contains(name)).map(|(at, _)| at).collect();
    let divided = DIVISIONS.iter().flat_map(|&division| (0..division).map(move |part| (division, part)));
    let parts = usable.first().into_iter().flat_map(|&at| divided.clone().map(move |of| (at, Some(of))));
    let jobs: Vec<(usize, Option<(usize, usize)>)> = parts.chain(usable.iter().map(|&at| (at, None))).collect();
    let (total, own_samples, own_plan) = (jobs.len(), Arc::clone(samples), Arc::clone(plan));
    let Gathered { told, interrupted } = gather(threads, total, "for the picture", move |stop, tell| {
        let Some(samples) = own_samples.first() else { return };
        jobs.par_iter().filter(|_| !stop.load(Ordering::SeqCst)).for_each(|&(at, part)| {
            let (name, estimator) = &own_plan.estimators[at];
            let seeds = mi::job_seeds(own_plan.seed, &samples.labels, name);
            tell(match part {
                Some((division, part)) => Piece::Part(mi::part_value(&**estimator, samples, division, part, &seeds)),
                None => Piece::Training(at, estimator.training(samples, &seeds)),
            });
        });
    })?;
    if interrupted {
        return Ok(None);
    }
    let (mut trainings, mut parts) = (Vec::new(), Vec::new());
    for piece in told {
        match piece {
            Piece::Training(at, Some(training)) => trainings.push((at, training)),
            Piece::Part(Some(part)) => parts.push(part),
            Piece::Training(_, None) | Piece::Part(None) => {}
        }
    }
    trainings.sort_by_key(|(at, _)| *at);
    let named = |(at, training): (usize, Training)| (plan.estimators[at].0.clone(), training);
    Ok(Some(Pieces { trainings: trainings.into_iter().map(named).collect(), extrapolated: mi::extrapolated(parts) }))
}

/// The picture's data, and what it shows.
pub(super) fn data(rows: &[Estimate], samples: &Samples, seed: u64, pieces: Pieces) -> (Data, String) {
    let labels = &samples.labels;
    // one axis has one unit: that of information, if there is any
    let unit = rows.iter().map(|r| r.unit).find(|u| *u != Unit::Jsd).unwrap_or(Unit::Jsd);
    let shown = rows.iter().filter(|r| r.unit == unit && r.value.is_finite());
    let scale = if unit == Unit::Bits { std::f64::consts::LN_2 } else { 1.0 };
    let shrunk = pieces.extrapolated.filter(|_| unit != Unit::Jsd).map(|found| Shrunk {
        label: found.parts[0].estimator.clone(),
        points: found.parts.iter().map(|p| (p.n as f64, p.value / scale)).collect(),
        line: (found.limit / scale, found.slope / scale),
    });
    let (names, points) = scatter(samples, &Seeds::new(seed).child("plot"));
    let levels = [&samples.x, &samples.y].map(|columns| columns.levels(0).to_vec());
    let estimates: Vec<Whisker> = shown.map(whisker).collect();
    let bounds =
        if estimates.iter().any(|w| !w.sign.is_empty()) { "; rings are bounds: ≥ lower, ≤ upper" } else { "" };
    let limit = if shrunk.is_some() { "; the ring at n = ∞ is where its line leads" } else { "" };
    let all = samples.len();
    let what = match (points.len(), estimates.len()) {
        (drawn, 0) => format!("{drawn} of {all} samples, and no estimate: none is finite"),
        (drawn, _) => format!("{drawn} of {all} samples and their estimates"),
    };
    let given = labels.given.as_ref().map_or(String::new(), |given| format!(" | {given}"));
    let data = Data {
        title: format!("{} ; {}{given}", labels.x, labels.y),
        subtitle: format!("{all} samples{bounds}{limit}"),
        unit: format!("mutual information, {}", unit.name()),
        pair: Pair {
            names,
            levels,
            points,
            estimates,
            shrunk,
            trainings: pieces.trainings.into_iter().map(training).collect(),
        },
        ..Data::default()
    };
    (data, what)
}

fn whisker(row: &Estimate) -> Whisker {
    Whisker {
        label: row.estimator.clone(),
        sign: sign(row.kind),
        value: row.value,
        band: row.interval_low.zip(row.interval_high).filter(|(low, high)| low.is_finite() && high.is_finite()),
    }
}

fn training((label, of): (String, Training)) -> figure::Training {
    let finite = |look: &&(usize, f64, f64)| look.1.is_finite() && look.2.is_finite();
    figure::Training {
        label,
        score: of.score.to_owned(),
        looks: of.looks.iter().filter(finite).map(|&(step, a, b)| (step as f64, a, b)).collect(),
        chosen: of.chosen as f64,
    }
}

/// Names of the axes, and points: the first column of x against the first of y, of at most [`POINTS`] samples.
fn scatter(samples: &Samples, seeds: &Seeds) -> ([String; 2], Vec<(f64, f64)>) {
    let mut rng = seeds.stream("points");
    let rows: Vec<u32> = if samples.len() <= POINTS {
        samples.rows.clone()
    } else {
        let mut chosen = BTreeSet::new();
        while chosen.len() < POINTS {
            chosen.insert(samples.rows[rng::below(&mut rng, samples.len())]);
        }
        chosen.into_iter().collect()
    };
    let [x, y] = [(&samples.x, &samples.labels.x), (&samples.y, &samples.labels.y)].map(|(columns, label)| {
        let values: Vec<f64> = rows.iter().map(|&r| columns.row(r as usize)[0]).collect();
        let gap = gap(&values);
        let mut move_by = || gap.map_or(0.0, |gap| rng::uniform(&mut rng, -0.25, 0.25) * gap);
        (axis_name(columns, label, gap.is_some()), values.iter().map(|v| v + move_by()).collect::<Vec<f64>>())
    });
    ([x.0, y.0], x.1.into_iter().zip(y.1).collect())
}

/// The least distance of different values, if there are few of them.
fn gap(values: &[f64]) -> Option<f64> {
    let mut levels = values.to_vec();
    levels.sort_by(f64::total_cmp);
    levels.dedup();
    let least = levels.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
    (levels.len() <= FEW && least.is_finite() && values.len() > levels.len()).then_some(least)
}

/// The column's name, and what was done to it.
fn axis_name(columns: &Columns, label: &str, spread: bool) -> String {
    let mut said = Vec::new();
    if columns.width() > 1 {
        said.push(format!("first of {} columns", columns.width()));
    }
    if columns.is_words(0) {
        said.push("words in order".to_owned());
    }
    if spread {
        said.push("spread".to_owned());
    }
    let name = if columns.width() > 1 { &columns.names[0] } else { label };
    if said.is_empty() { name.to_owned() } else { format!("{name} ({})", said.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::Kind;
    use crate::schema::{Exchange, SampleLabels};

    fn samples(x: Columns, y: Columns) -> Samples {
        let n = x.rows();
        Samples {
            x: Arc::new(x),
            y: Arc::new(y),
            z: None,
            starts: (0..=n).collect::<Vec<_>>().into(),
            rows: (0..n as u32).collect(),
            exchange: Exchange::Episodes,
            labels: SampleLabels { x: "a,b".to_owned(), y: "c".to_owned(), ..SampleLabels::default() },
            notes: Vec::new(),
        }
    }

    #[test]
    fn the_words_beside_a_picture_say_what_is_in_it() {
        let column = |name: &str, levels: &[&str]| Columns {
            levels: vec![levels.iter().map(ToString::to_string).collect()],
            ..Columns::new(vec![0.0, 1.0, 0.0, 1.0], vec![name.to_owned()])
        };
        let samples = samples(column("a", &["no", "yes"]), column("b", &[]));
        let row = |value, kind| Estimate::new("gaussian", &samples.labels, value, Unit::Nats, kind, 4);
        let said = |rows: &[Estimate]| {
            let (data, what) = data(rows, &samples, 1, Pieces { trainings: Vec::new(), extrapolated: None });
            assert_eq!(data.pair.levels, [vec!["no".to_owned(), "yes".to_owned()], Vec::new()]);
            (data.subtitle, what)
        };
        let of = |subtitle: &str, what: &str| (subtitle.to_owned(), what.to_owned());
        let infinite = said(&[row(f64::INFINITY, Kind::Estimate)]);
        assert_eq!(infinite, of("4 samples", "4 of 4 samples, and no estimate: none is finite"));
        let bound = said(&[row(1.0, Kind::LowerBound)]);
        assert_eq!(bound, of("4 samples; rings are bounds: ≥ lower, ≤ upper", "4 of 4 samples and their estimates"));
    }

    #[test]
    fn many_samples_are_drawn_from_and_the_axes_say_what_was_done() {
        let wide = Columns::new((0..10_000).map(f64::from).collect(), vec!["a".to_owned(), "b".to_owned()]);
        let words = (0..5000).map(|i| f64::from(i % 3)).collect();
        let levels = vec![["red", "green", "blue"].map(str::to_owned).to_vec()];
        let words = Columns { data: words, names: vec!["c".to_owned()], words: vec![true], levels };
        let samples = samples(wide, words);
        let (names, points) = scatter(&samples, &Seeds::new(1));
        assert_eq!(names, ["a (first of 2 columns)", "c (words in order, spread)"]);
        assert_eq!(points.len(), 2000);
        assert!(points.windows(2).all(|w| w[0].0 < w[1].0), "each sample once, x as it is");
        let off = |&(x, y): &(f64, f64)| (y - f64::from(x as u32 / 2 % 3)).abs();
        assert!(points.iter().all(|p| off(p) <= 0.25) && points.iter().any(|p| off(p) > 0.1));
        assert_eq!(points, scatter(&samples, &Seeds::new(1)).1);
        assert_ne!(points, scatter(&samples, &Seeds::new(2)).1);
    }
}
