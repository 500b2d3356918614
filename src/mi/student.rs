//! Student's t copula: the density of several columns that share one heavy tail, fitted to their ranks.
//!
//! Columns enter as ranks. For each number ν of degrees of freedom a rank becomes a quantile of Student's t, and the correlation
//! matrix R of the quantiles is fitted by maximum likelihood (EM, Lange, Little, Taylor 1989). ν = ∞ is the normal copula.

use statrs::distribution::{ContinuousCDF as _, Normal, StudentsT};
use statrs::function::gamma::{digamma, ln_gamma};

use super::linear::Symmetric;

/// Unexplained share of a column's variance under which it counts as a linear function of others.
pub(super) const COLLINEAR: f64 = 1e-10;

/// Twice the mean rank of every value among the values of its column in `rows` (rows outside `rows` likewise), 1 to 2n + 1.
/// `data` and result are `[all rows, width]`.
pub(super) fn doubled_ranks(data: &[f64], width: usize, rows: &[u32]) -> Vec<u32> {
    let mut ranks = vec![0; data.len()];
    for c in 0..width {
        let mut sorted: Vec<f64> = rows.iter().map(|&r| data[r as usize * width + c]).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        for (from, to) in data.chunks_exact(width).zip(ranks.chunks_exact_mut(width)) {
            let below = sorted.partition_point(|&v| v < from[c]);
            let upto = sorted.partition_point(|&v| v <= from[c]);
            // mean of the ranks below + 1, …, upto
            to[c] = (below + upto + 1) as u32;
        }
    }
    ranks
}

/// Degrees of freedom and the quantiles that doubled ranks of n samples stand for.
pub(super) struct Tail {
    /// Degrees of freedom, ν; infinite: normal.
    pub(super) degrees: f64,
    /// By doubled rank: Q(rank/(n + 1)); NaN for ranks that do not occur.
    quantiles: Vec<f64>,
}

impl Tail {
    /// The quantiles of the ranks that `occur`, of `n` samples.
    pub(super) fn new(degrees: f64, n: usize, occur: &[bool]) -> Self {
        let (normal, student) = (Normal::standard(), StudentsT::new(0.0, 1.0, degrees));
        let inverse = |p: f64| match &student {
            Ok(student) if degrees.is_finite() => student.inverse_cdf(p),
            _ => normal.inverse_cdf(p),
        };
        let last = 2 * n + 2;
        let mut quantiles = vec![f64::NAN; last + 1];
        // the upper half mirrors the lower one
        for low in 1..=n + 1 {
            if occur[low] || occur[last - low] {
                let quantile = inverse(0.5 * low as f64 / (n as f64 + 1.0));
                (quantiles[low], quantiles[last - low]) = (quantile, -quantile);
            }
        }
        Self { degrees, quantiles }
    }

    /// The quantile of a doubled rank.
    pub(super) fn quantile(&self, rank: u32) -> f64 {
        self.quantiles[rank as usize]
    }

    /// ln of the density of `width` columns at the centre, without −½ ln |R|.
    pub(super) fn constant(&self, width: usize) -> f64 {
        let (nu, d) = (self.degrees, width as f64);
        if nu.is_infinite() {
            return -0.5 * d * libm::log(2.0 * std::f64::consts::PI);
        }
        ln_gamma(0.5 * (nu + d)) - ln_gamma(0.5 * nu) - 0.5 * d * libm::log(nu * std::f64::consts::PI)
    }

    /// How much the log-density falls from the centre to a squared distance.
    pub(super) fn decay(&self, width: usize, distance: f64) -> f64 {
        let (nu, d) = (self.degrees, width as f64);
        if nu.is_infinite() { 0.5 * distance } else { 0.5 * (nu + d) * libm::log1p(distance / nu) }
    }

    /// The differential entropy of `width` columns, without ½ ln |R|, nats.
    fn entropy(&self, width: usize) -> f64 {
        let (nu, d) = (self.degrees, width as f64);
        let spread =
            if nu.is_infinite() { 0.5 * d } else { 0.5 * (nu + d) * (digamma(0.5 * (nu + d)) - digamma(0.5 * nu)) };
        if width == 0 { 0.0 } else { spread - self.constant(width) }
    }
}

/// The widths of x, y and z, whose columns stand side by side in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Widths {
    pub(super) x: usize,
    pub(super) y: usize,
    pub(super) z: usize,
}

impl Widths {
    pub(super) fn all(self) -> usize {
        self.x + self.y + self.z
    }

    /// Which columns `xz`, `yz` and `z` are.
    fn parts(self) -> [Vec<usize>; 3] {
        let (y, z) = (self.x, self.x + self.y);
        [(0..y).chain(z..self.all()).collect(), (y..self.all()).collect(), (z..self.all()).collect()]
    }
}

/// The identity: no correlation.
pub(super) fn identity(width: usize) -> Symmetric {
    let data = (0..width * width).map(|i| if i % (width + 1) == 0 { 1.0 } else { 0.0 }).collect();
    Symmetric { width, data }
}

/// The correlation matrix that `steps` steps of EM make of `start`: `rows` is `[n, width]`, quantiles of `tail`.
pub(super) fn correlation(rows: &[f64], tail: &Tail, start: &Symmetric, steps: usize) -> Symmetric {
    let (width, mut out, mut scratch) = (start.width, start.clone(), Vec::new());
    let (nu, d) = (tail.degrees, start.width as f64);
    // without tails all weights are one, and one step is all there is
    let steps = if nu.is_infinite() { 1 } else { steps };
    for _ in 0..steps {
        let decomposed = out.cholesky(COLLINEAR);
        let mut sums = vec![0.0; width * width];
        for row in rows.chunks_exact(width) {
            let weight = if nu.is_infinite() { 1.0 } else { (nu + d) / (nu + decomposed.distance(row, &mut scratch)) };
            for (i, line) in sums.chunks_exact_mut(width).enumerate() {
                let weighted = weight * row[i];
                line[..=i].iter_mut().zip(row).for_each(|(s, v)| *s += weighted * v);
            }
        }
        let scale: Vec<f64> = (0..width).map(|i| 1.0 / libm::sqrt(sums[i * width + i])).collect();
        for i in 0..width {
            for j in 0..=i {
                let r = if i == j { 1.0 } else { sums[i * width + j] * scale[i] * scale[j] };
                (out.data[i * width + j], out.data[j * width + i]) = (r, r);
            }
        }
    }
    out
}

/// A copula with its parameters: what it says of samples.
pub(super) struct Copula<'a> {
    pub(super) tail: &'a Tail,
    pub(super) correlation: &'a Symmetric,
    pub(super) widths: Widths,
}

impl Copula<'_> {
    /// I(x; y), or I(x; y | z), of this very distribution, nats (Arellano-Valle, Contreras-Reyes, Genton 2013 for
    /// the t distribution; one set of margins has no part in it).
    pub(super) fn information(&self) -> f64 {
        let entropy = |columns: &[usize]| {
            let decomposed = self.correlation.picked(columns).cholesky(COLLINEAR);
            let used = decomposed.pivots.iter().filter(|p| **p > 0.0).count();
            self.tail.entropy(used) + 0.5 * decomposed.log_determinant()
        };
        let [xz, yz, z] = self.widths.parts();
        let all: Vec<usize> = (0..self.widths.all()).collect();
        entropy(&xz) + entropy(&yz) - entropy(&z) - entropy(&all)
    }

    /// Mean ln c of `rows`, the density of the ranks: what maximum likelihood compares.
    pub(super) fn log_likelihood(&self, rows: &[f64]) -> f64 {
        let (width, mut scratch) = (self.widths.all(), Vec::new());
        let decomposed = self.correlation.cholesky(COLLINEAR);
        let (whole, one) =
            (self.tail.constant(width) - 0.5 * decomposed.log_determinant(), self.tail.constant(1) * width as f64);
        let of = |row: &[f64]| {
            let margins: f64 = row.iter().map(|v| self.tail.decay(1, v * v)).sum();
            margins - self.tail.decay(width, decomposed.distance(row, &mut scratch))
        };
        let n = rows.len() / width;
        whole - one + rows.chunks_exact(width).map(of).sum::<f64>() / n as f64
    }

    /// ln of p(x, y | z) over p(x | z) p(y | z) in each of `rows`: its mean is the information.
    pub(super) fn local(&self, rows: &[f64]) -> Vec<f64> {
        let [xz, yz, z] = self.widths.parts();
        let all: Vec<usize> = (0..self.widths.all()).collect();
        let mut scratch = Vec::new();
        let mut out = vec![0.0; rows.len() / self.widths.all()];
        let mut part = Vec::new();
        for (columns, sign) in [(&all, 1.0), (&xz, -1.0), (&yz, -1.0), (&z, 1.0)] {
            if columns.is_empty() {
                continue;
            }
            let decomposed = self.correlation.picked(columns).cholesky(COLLINEAR);
            let constant = self.tail.constant(columns.len()) - 0.5 * decomposed.log_determinant();
            for (out, row) in out.iter_mut().zip(rows.chunks_exact(self.widths.all())) {
                part.clear();
                part.extend(columns.iter().map(|&c| row[c]));
                *out += sign * (constant - self.tail.decay(columns.len(), decomposed.distance(&part, &mut scratch)));
            }
        }
        out
    }
}
