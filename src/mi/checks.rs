//! What intervals and p-values are checked on: small samples of normals, whose intervals should hold the truth, and
//! slow series, whose p-values should be small only when the second follows the first.

use std::sync::Arc;

use super::calibrate::Source;
use crate::rng::{self, Stream};
use crate::schema::{Columns, Exchange, SampleLabels, Samples};

/// A distribution of known information, of a size of its own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Check {
    /// 500 samples of `width` unit normals on either side, of which the first two correlate by `rho`.
    Normals {
        /// Columns on either side.
        width: usize,
        /// Correlation.
        rho: f64,
    },
    /// 1000 rows of two AR(1) series, cut into blocks of 20; y is the second plus `coupling` times the first.
    Series {
        /// Share of a value that its successor keeps.
        phi: f64,
        /// How far y follows x.
        coupling: f64,
    },
}

/// Samples of normals, and blocks of a series: their numbers of rows.
const ROWS: [usize; 2] = [500, 1000];
/// Rows of a block of a series.
const BLOCK: usize = 20;
/// Rows of a series before the first that counts.
const BEFORE: usize = 200;

const fn normals(width: usize, rho: f64) -> Check {
    Check::Normals { width, rho }
}

const fn series(phi: f64, coupling: f64) -> Check {
    Check::Series { phi, coupling }
}

/// Those for intervals.
pub const NORMALS: [Check; 6] =
    [normals(1, 0.0), normals(1, 0.3), normals(1, 0.75), normals(2, 0.0), normals(2, 0.3), normals(2, 0.75)];

/// Those for p-values: without dependence, and with it.
pub const SERIES: [Check; 6] =
    [series(0.0, 0.0), series(0.0, 0.3), series(0.9, 0.0), series(0.9, 0.3), series(0.98, 0.0), series(0.98, 0.3)];

impl Source for Check {
    fn id(&self) -> String {
        match self {
            Self::Normals { width, rho } => format!("normal-{width}-{width}-{rho}"),
            Self::Series { phi, coupling } => format!("series-{phi}-{coupling}"),
        }
    }

    fn truth(&self) -> f64 {
        match self {
            Self::Normals { rho, .. } => -0.5 * libm::log1p(-rho * rho) + 0.0,
            // both series have one variance, so the squared correlation at equal times is c²/(1 + c²)
            Self::Series { coupling, .. } => 0.5 * libm::log1p(coupling * coupling),
        }
    }

    fn samples(&self, _: usize, rng: &mut Stream) -> Samples {
        let (mut x, mut y) = (Vec::new(), Vec::new());
        match *self {
            Self::Normals { width, rho } => {
                for _ in 0..ROWS[0] {
                    let own: Vec<f64> = (0..width).map(|_| rng::normal(rng)).collect();
                    y.push(rho * own[0] + libm::sqrt(1.0 - rho * rho) * rng::normal(rng));
                    y.extend((1..width).map(|_| rng::normal(rng)));
                    x.extend(own);
                }
            }
            Self::Series { phi, coupling } => {
                let (mut a, mut b) = (0.0, 0.0);
                for t in 0..BEFORE + ROWS[1] {
                    (a, b) = (phi * a + rng::normal(rng), phi * b + rng::normal(rng));
                    if t >= BEFORE {
                        x.push(a);
                        y.push(b + coupling * a);
                    }
                }
            }
        }
        let (width, rows, block, exchange) = match self {
            Self::Normals { width, .. } => (*width, ROWS[0], 1, Exchange::Episodes),
            Self::Series { .. } => (1, ROWS[1], BLOCK, Exchange::Shift),
        };
        let columns = |data: Vec<f64>, name: &str| {
            Arc::new(Columns::new(data, (0..width).map(|i| format!("{name}{i}")).collect()))
        };
        Samples {
            x: columns(x, "x"),
            y: columns(y, "y"),
            z: None,
            starts: (0..=rows / block).map(|b| b * block).collect::<Vec<_>>().into(),
            rows: (0..rows as u32).collect(),
            exchange,
            labels: SampleLabels { x: "x".to_owned(), y: "y".to_owned(), group: self.id(), ..SampleLabels::default() },
            notes: Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;

    #[test]
    fn checks_have_the_stated_correlation_at_equal_times_and_in_time() {
        let correlation = |a: &[f64], b: &[f64]| {
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
        };
        for check in NORMALS.into_iter().chain(SERIES) {
            let (mut across, mut within, mut draws) = (0.0, 0.0, 0.0);
            for seed in 0..40 {
                let samples = check.samples(0, &mut Seeds::new(seed).stream("check"));
                let first = |c: &Columns| (0..c.rows()).map(|r| c.row(r)[0]).collect::<Vec<_>>();
                let (x, y) = (first(&samples.x), first(&samples.y));
                across += correlation(&x, &y);
                within += correlation(&x[1..], &x[..x.len() - 1]);
                draws += 1.0;
            }
            let phi = if let Check::Series { phi, .. } = check { phi } else { 0.0 };
            let rho = (1.0 - (-2.0 * check.truth()).exp()).sqrt();
            let tolerance = if phi > 0.95 { 0.1 } else { 0.04 };
            assert!((across / draws - rho).abs() < tolerance, "{}: {}", check.id(), across / draws);
            assert!((within / draws - phi).abs() < 0.03, "{}: {}", check.id(), within / draws);
        }
        assert_eq!(NORMALS[0].truth().to_bits(), 0);
    }
}
