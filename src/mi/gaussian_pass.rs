//! The Gaussian estimate in one pass: sums of products of z, x and y, in 50 groups of rows.

use statrs::distribution::{ChiSquared, ContinuousCDF as _, FisherSnedecor};

use super::gaussian::{COLLINEAR, GROUPS, copy, information_of, interval};
use super::linear::{Moments, Symmetric};
use super::prepare::some_of;
use super::{Estimate, Kind, MiError, NOTE, OnePass, Unit};
use crate::schema::{SampleLabels, Samples};

/// Rows that stay together in a group of the jackknife, so that what neighbours share is not taken for evidence; their
/// sums are made apart, so that rounding does not grow with the number of rows.
const BLOCK: usize = 1024;
/// Groups below which the interval is rough.
const FEW: usize = 10;
/// Said on the row.
const NOTES: &str = "all rows in one pass; interval: jackknife over groups of 1024 rows, p: Wilks' test";

/// Sums in the making.
#[derive(Default)]
pub(super) struct GaussianPass {
    /// Names of the columns of z, x and y.
    names: [Vec<String>; 3],
    /// Per column of z, x and y: what is subtracted, and what the rest is multiplied by.
    scales: Vec<(f64, f64)>,
    groups: Vec<Moments>,
    block: Option<Moments>,
    rows: usize,
}

impl OnePass for GaussianPass {
    fn add(&mut self, piece: &Samples) -> Result<(), MiError> {
        let sides = [piece.z.as_ref(), Some(&piece.x), Some(&piece.y)];
        if self.scales.is_empty() && !piece.is_empty() {
            self.names = sides.map(|c| c.map_or_else(Vec::new, |c| c.names.clone()));
            self.scales = sides.iter().copied().flatten().flat_map(|c| scales(c, &piece.rows)).collect();
        }
        let width = self.scales.len();
        let mut row = Vec::with_capacity(width);
        for &r in &piece.rows {
            row.clear();
            row.extend(sides.iter().copied().flatten().flat_map(|c| c.row(r as usize)));
            row.iter_mut().zip(&self.scales).for_each(|(v, (shift, factor))| *v = (*v - shift) * factor);
            self.block.get_or_insert_with(|| Moments::new(width)).add_row(&row);
            self.rows += 1;
            if self.rows.is_multiple_of(BLOCK) {
                self.close_block();
            }
        }
        Ok(())
    }

    fn finish(&self, labels: &SampleLabels, notes: &[String]) -> Result<Vec<Estimate>, MiError> {
        let mut groups = self.groups.clone();
        if let Some(block) = &self.block {
            place(&mut groups, self.rows / BLOCK, block);
        }
        let width = self.scales.len();
        let needed = (2 * width).max(10);
        if self.rows < needed {
            return Err(MiError::TooFewSamples { needed, widths: width, found: self.rows });
        }
        let mut total = Moments::new(width);
        for group in &groups {
            total.add(group, 1.0);
        }
        let mut warnings = notes.to_vec();
        let Chosen { columns, given, dx, dy } = self.chosen(&total, labels, &mut warnings)?;
        let left = |moments: &Moments| moments.covariance().picked(&columns).given(given, COLLINEAR);
        let information = |moments: &Moments| information_of(&left(moments), moments.n, dx, dy, given);
        let value = information(&total);
        let mut out = Estimate::new("gaussian", labels, value, Unit::Nats, Kind::Estimate, self.rows);
        if value.is_infinite() {
            warnings.push(copy(labels));
        } else {
            interval(&mut out, (dx * dy) as f64, &total, &groups, dx + dy + given, &information);
            let count = groups.len();
            if out.interval_low.is_none() {
                let rows = self.rows;
                warnings.push(format!("no interval: {rows} rows are too few groups of {BLOCK}; give --memory more"));
            } else if count < FEW {
                warnings.push(format!("few blocks: the interval rests on {count} groups of {BLOCK} rows"));
            }
            out.p_value = wilks(&left(&total), total.n, dx, dy, given);
        }
        warnings.push(format!("{NOTE}{NOTES}"));
        out.warnings = warnings;
        Ok(vec![out])
    }
}

/// Which columns of z, x and y are used, in this order.
struct Chosen {
    columns: Vec<usize>,
    given: usize,
    dx: usize,
    dy: usize,
}

impl GaussianPass {
    fn close_block(&mut self) {
        if let Some(block) = self.block.take() {
            place(&mut self.groups, self.rows / BLOCK - 1, &block);
        }
    }

    /// Leaves out what is constant or a linear function of other columns, and says so.
    fn chosen(&self, total: &Moments, labels: &SampleLabels, warnings: &mut Vec<String>) -> Result<Chosen, MiError> {
        let joint = total.covariance();
        let varies = |c: usize| {
            let (shift, factor) = self.scales[c];
            let (mean, variance) =
                (shift + total.mean(c) / factor, joint.data[c * joint.width + c] / (factor * factor));
            variance > 1e-24 * mean * mean && variance > 0.0
        };
        let [of_z, of_x, of_y] = &self.names;
        let z: Vec<usize> = (0..of_z.len()).filter(|&c| varies(c)).collect();
        let given = labels.given.clone().unwrap_or_default();
        if z.is_empty() && !of_z.is_empty() {
            return Err(MiError::Constant { column: given });
        }
        let names: Vec<&str> = self.names.iter().flatten().map(String::as_str).collect();
        let side = |from: usize, count: usize, label: &str, warnings: &mut Vec<String>| {
            let own = from..from + count;
            let all: Vec<usize> = own.clone().filter(|&c| varies(c)).collect();
            if all.is_empty() {
                return Err(MiError::Constant { column: label.to_owned() });
            }
            // what z determines is constant given z
            let left = |&c: &usize| {
                let with_z: Vec<usize> = z.iter().copied().chain([c]).collect();
                joint.picked(&with_z).cholesky(COLLINEAR).pivots[z.len()] > 0.0
            };
            let all: Vec<usize> = all.into_iter().filter(left).collect();
            if all.is_empty() {
                return Err(MiError::Constant { column: format!("what {given} leaves of {label}") });
            }
            let constant: Vec<&str> = own.filter(|c| !all.contains(c)).map(|c| names[c]).collect();
            if !constant.is_empty() {
                warnings.push(format!("constant, left out: {}", some_of(&constant)));
            }
            let with_z: Vec<usize> = z.iter().chain(&all).copied().collect();
            let pivots = joint.picked(&with_z).given(z.len(), COLLINEAR).cholesky(COLLINEAR).pivots;
            let (kept, collinear): (Vec<usize>, Vec<usize>) = (0..all.len()).partition(|&at| pivots[at] > 0.0);
            if !collinear.is_empty() {
                let of: Vec<&str> = collinear.iter().map(|&at| names[all[at]]).collect();
                warnings.push(format!("linear functions of the columns before them, left out: {}", some_of(&of)));
            }
            Ok(kept.into_iter().map(|at| all[at]).collect::<Vec<usize>>())
        };
        let x = side(of_z.len(), of_x.len(), &labels.x, warnings)?;
        let y = side(of_z.len() + of_x.len(), of_y.len(), &labels.y, warnings)?;
        let (given, dx, dy) = (z.len(), x.len(), y.len());
        Ok(Chosen { columns: [z, x, y].concat(), given, dx, dy })
    }
}

/// Adds the sums of a block to its group: blocks are dealt out in turn.
fn place(groups: &mut Vec<Moments>, number: usize, block: &Moments) {
    match groups.get_mut(number % GROUPS) {
        Some(group) => group.add(block, 1.0),
        None => groups.push(block.clone()),
    }
}

/// Mean and 1/standard deviation of each column over some rows; 1 where it does not vary there.
fn scales(columns: &crate::schema::Columns, rows: &[u32]) -> Vec<(f64, f64)> {
    let n = rows.len() as f64;
    let of = |c: usize| {
        let value = |&r: &u32| columns.row(r as usize)[c];
        let mean = rows.iter().map(value).sum::<f64>() / n;
        let variance = rows.iter().map(|r| (value(r) - mean) * (value(r) - mean)).sum::<f64>() / n;
        (mean, if variance > 0.0 { 1.0 / libm::sqrt(variance) } else { 1.0 })
    };
    (0..columns.width()).map(of).collect()
}

/// The probability of a Λ = |S| / |`S_x`||`S_y`| as small as this without dependence: exact (F) when x or y has one column,
/// else by Bartlett's χ² (Mardia, Kent, Bibby 1979, Multivariate Analysis, ch. 5 and 10).
fn wilks(joint: &Symmetric, n: f64, dx: usize, dy: usize, given: usize) -> Option<f64> {
    let log_det = |s: &Symmetric| s.cholesky(COLLINEAR).pivots.iter().map(|&p| libm::log(p)).sum::<f64>();
    let log_lambda = log_det(joint) - log_det(&joint.block(0..dx)) - log_det(&joint.block(dx..dx + dy));
    let (least, most) = (dx.min(dy), dx.max(dy) as f64);
    if least == 1 {
        let rest = n - 1.0 - given as f64 - most;
        let f = libm::expm1(-log_lambda) * rest / most;
        return FisherSnedecor::new(most, rest).ok().map(|of| of.sf(f.max(0.0)));
    }
    let factor = n - 1.0 - given as f64 - 0.5 * (dx + dy + 1) as f64;
    ChiSquared::new((dx * dy) as f64).ok().map(|of| of.sf((-factor * log_lambda).max(0.0)))
}
