//! From counts and scores to the figures' tidy data.

use super::{BIN_WIDTH, Fit, LinkStatistics, Observed};
use crate::figure::{Curve, Data, Point};
use crate::stats::clopper_pearson;

/// Most directed links that are drawn beside their total: the palette has as many colours.
const MOST_LINKS: usize = 7;

/// The name of all links together in legends.
const ALL: &str = "all links";

impl Fit {
    /// The reliability figure of the held-out episodes.
    pub fn reliability(&self) -> Data {
        let score = &self.held_out;
        let point =
            |bin: &super::Bin| Point { step: bin.predicted, value: bin.observed, band: Some((bin.low, bin.high)) };
        let points = score.reliability.iter().map(point).collect();
        Data {
            title: format!("Reliability of the fitted link: {}", self.model),
            subtitle: format!(
                "{} messages of {} held-out episodes, calibration error {:.4}; whiskers: exact 95 %, all together",
                score.messages, score.episodes, score.calibration_error.value
            ),
            unit: "share of lost messages".to_owned(),
            series: vec![self.model.to_owned()],
            reliability: vec![Curve { series: self.model.to_owned(), points }],
            ..Data::default()
        }
    }
}

impl LinkStatistics {
    /// The figures of what a link did: loss by step, burst lengths, loss by distance. `title` names the link, `unit` what the
    /// figure to be drawn shows.
    pub fn figures(&self, title: &str, unit: &str) -> Data {
        let total = self.total();
        let [messages, lost] = total.total();
        let mut named = vec![(ALL.to_owned(), &total)];
        if self.links.len() <= MOST_LINKS {
            named.extend(self.links.iter().map(|(s, r)| format!("{s} to {r}")).zip(&self.observed));
        }
        let curves = |points: fn(&Observed) -> Vec<Share>| {
            let curve = |(series, observed): &(String, &Observed)| {
                let all = series == ALL;
                let points = points(observed).iter().map(|share| share.point(all)).collect();
                Curve { series: series.clone(), points }
            };
            named.iter().map(curve).collect::<Vec<_>>()
        };
        Data {
            title: title.to_owned(),
            subtitle: format!("{lost} of {messages} messages lost; around all links: exact 95 % of each point alone"),
            unit: unit.to_owned(),
            series: named.iter().map(|(series, _)| series.clone()).collect(),
            loss_by_step: curves(|o| shares(&o.steps, 0.0, 1.0)),
            bursts: curves(|o| {
                let all: u64 = o.bursts.iter().sum();
                let share = |(k, &hits): (usize, &u64)| Share { at: (k + 1) as f64, all, hits };
                o.bursts.iter().enumerate().map(share).collect()
            }),
            loss_by_distance: curves(|o| shares(&o.distances, 0.5 * BIN_WIDTH, BIN_WIDTH)),
            ..Data::default()
        }
    }
}

/// A share of messages or bursts at a place on the x axis.
struct Share {
    at: f64,
    all: u64,
    hits: u64,
}

impl Share {
    fn point(&self, band: bool) -> Point {
        let interval = clopper_pearson(self.hits, self.all, 0.95);
        let value = self.hits as f64 / self.all as f64;
        Point { step: self.at, value, band: band.then_some((interval.low, interval.high)) }
    }
}

/// The places that have messages.
fn shares(counts: &[[u64; 2]], first: f64, width: f64) -> Vec<Share> {
    let share = |(place, &[all, hits]): (usize, &[u64; 2])| Share { at: first + width * place as f64, all, hits };
    counts.iter().enumerate().map(share).filter(|share| share.all > 0).collect()
}
