//! The discrete estimate in one pass: how often every triple of categories of z, x and y occurs.

use std::collections::BTreeMap;

use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::counts::Table;
use super::discrete::Counted;
use super::interval::{Interval, t_quantile};
use super::unseen::Strata;
use super::{Estimate, MiError, NOTE, OnePass};
use crate::schema::{Columns, SampleLabels, Samples};

/// Most different triples: beyond them columns are continuous, and counts say nothing.
const TRIPLES: usize = 1 << 20;
/// Rows per pair of categories, those that did not occur among them, from which the G-test is one.
const EXPECTED: f64 = 5.0;
/// Said on the row.
const NOTES: &str = "all rows in one pass; interval: rows as they are, p: G-test";

/// The category of a row: equal rows have the same.
#[derive(Default)]
struct Categories {
    /// Per column, the number of each value.
    levels: Vec<BTreeMap<u64, u32>>,
    /// Per column after the first, the number of each pair of what stands before and its own.
    joined: Vec<BTreeMap<(u32, u32), u32>>,
}

impl Categories {
    fn of(&mut self, row: &[f64]) -> u32 {
        self.levels.resize_with(row.len(), BTreeMap::new);
        self.joined.resize_with(row.len(), BTreeMap::new);
        let mut category = 0;
        for (c, &value) in row.iter().enumerate() {
            // zeros have no sign
            let own = number(&mut self.levels[c], (value + 0.0).to_bits());
            category = if c == 0 { own } else { number(&mut self.joined[c], (category, own)) };
        }
        category
    }

    /// Most entries of any list.
    fn len(&self) -> usize {
        let joined = self.joined.iter().map(BTreeMap::len);
        self.levels.iter().map(BTreeMap::len).chain(joined).max().unwrap_or(0)
    }
}

/// The number of a key: the next one when it is new.
fn number<K: Ord>(known: &mut BTreeMap<K, u32>, key: K) -> u32 {
    let next = known.len() as u32;
    *known.entry(key).or_insert(next)
}

/// Counts in the making.
#[derive(Default)]
pub(super) struct DiscretePass {
    x: Categories,
    y: Categories,
    z: Categories,
    /// By the categories of z, x and y.
    counts: BTreeMap<(u32, u32, u32), u32>,
    rows: usize,
    widths: usize,
    words: [bool; 2],
    given: bool,
}

impl OnePass for DiscretePass {
    fn add(&mut self, piece: &Samples) -> Result<(), MiError> {
        let words = |c: &Columns| (0..c.width()).any(|at| c.is_words(at));
        self.words = [words(&piece.x), words(&piece.y)];
        self.given = piece.z.is_some();
        self.widths = piece.x.width() + piece.y.width();
        for &r in &piece.rows {
            let r = r as usize;
            let z = piece.z.as_ref().map_or(0, |z| self.z.of(z.row(r)));
            let key = (z, self.x.of(piece.x.row(r)), self.y.of(piece.y.row(r)));
            *self.counts.entry(key).or_insert(0) += 1;
            self.rows += 1;
        }
        let most = [self.counts.len(), self.x.len(), self.y.len(), self.z.len()].into_iter().max().unwrap_or(0);
        if most > TRIPLES {
            return Err(MiError::TooManyCategories { limit: TRIPLES, rows: self.rows });
        }
        Ok(())
    }

    fn finish(&self, labels: &SampleLabels, notes: &[String]) -> Result<Vec<Estimate>, MiError> {
        if self.rows < 2 {
            return Err(MiError::TooFewSamples { needed: 2, widths: self.widths, found: self.rows });
        }
        let distinct_of = |of: fn(&(u32, u32, u32)) -> u32| {
            self.counts.keys().map(of).collect::<std::collections::BTreeSet<u32>>().len()
        };
        let distinct = [distinct_of(|k| k.1), distinct_of(|k| k.2)];
        for (&distinct, label) in distinct.iter().zip([&labels.x, &labels.y]) {
            if distinct == 1 {
                return Err(MiError::Constant { column: label.clone() });
            }
        }
        let mut sums = Sums::default();
        for (&(z, x, y), &count) in &self.counts {
            let (xz, yz) = (number(&mut sums.xz, (x, z)), number(&mut sums.yz, (y, z)));
            sums.joint.insert((xz, yz), count);
            *sums.of_z.entry((z, z)).or_insert(0) += count;
        }
        let table = Table::of_counts(&sums.joint);
        let of_z = self.given.then(|| Table::of_counts(&sums.of_z));
        let strata = sums.strata();
        let counted = Counted { table, of_z, strata, distinct, n: self.rows, words: self.words };
        let local = self.local();
        // (K_x − 1)(K_y − 1), summed over the strata of z
        let mut strata: BTreeMap<u32, [f64; 2]> = BTreeMap::new();
        for (side, pairs) in [&sums.xz, &sums.yz].into_iter().enumerate() {
            for &(_, z) in pairs.keys() {
                strata.entry(z).or_insert([-1.0; 2])[side] += 1.0;
            }
        }
        let degrees: f64 = strata.values().map(|[x, y]| x * y).sum();
        let g = 2.0 * self.rows as f64 * counted.information().max(0.0);
        let mut notes = notes.to_vec();
        let cells: f64 = strata.values().map(|[x, y]| (x + 1.0) * (y + 1.0)).sum();
        let expected = self.rows as f64 / cells;
        let p = (expected >= EXPECTED).then(|| ChiSquared::new(degrees).map_or(1.0, |of| of.sf(g)));
        if p.is_none() {
            notes.push(format!(
                "no p-value: {expected:.1} rows per pair of categories, and the G-test needs {EXPECTED}; with --sample N \
                 rows are permuted instead"
            ));
        }
        notes.push(format!("{NOTE}{NOTES}"));
        let mut rows = counted.rows(labels, local, p, notes);
        if p.is_none() {
            // nothing says that there is dependence at all
            for row in &mut rows {
                row.interval_low = row.interval_low.map(|low| low.min(0.0));
            }
        }
        Ok(rows)
    }
}

/// Categories of x and y, each with z, and counts of what occurs.
#[derive(Default)]
struct Sums {
    xz: BTreeMap<(u32, u32), u32>,
    yz: BTreeMap<(u32, u32), u32>,
    joint: BTreeMap<(u32, u32), u32>,
    of_z: BTreeMap<(u32, u32), u32>,
}

impl Sums {
    /// Which categories of x and y belong to which value of z.
    fn strata(&self) -> Strata {
        let of = |pairs: &BTreeMap<(u32, u32), u32>| {
            let mut out = vec![0; pairs.len()];
            for (&(_, z), &at) in pairs {
                out[at as usize] = z;
            }
            out
        };
        let mut sizes = vec![0; self.of_z.keys().map(|&(z, _)| z as usize + 1).max().unwrap_or(0)];
        for (&(z, _), &count) in &self.of_z {
            sizes[z as usize] = count;
        }
        Strata { of_x: of(&self.xz), of_y: of(&self.yz), sizes }
    }
}

impl DiscretePass {
    /// Mean of the local terms ln p(x,y|z)/p(x|z)p(y|z), every row being independent.
    fn local(&self) -> Interval {
        let (mut of_z, mut of_xz, mut of_yz) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        for (&(z, x, y), &count) in &self.counts {
            *of_z.entry(z).or_insert(0.0) += f64::from(count);
            *of_xz.entry((x, z)).or_insert(0.0) += f64::from(count);
            *of_yz.entry((y, z)).or_insert(0.0) += f64::from(count);
        }
        let terms: Vec<(f64, f64)> = self
            .counts
            .iter()
            .map(|(&(z, x, y), &count)| {
                let count = f64::from(count);
                (count, libm::log(count * of_z[&z] / (of_xz[&(x, z)] * of_yz[&(y, z)])))
            })
            .collect();
        let n = self.rows as f64;
        let mean = terms.iter().map(|(count, term)| count * term).sum::<f64>() / n;
        let squares: f64 = terms.iter().map(|(count, term)| count * (term - mean) * (term - mean)).sum();
        let error = libm::sqrt(squares / (n - 1.0) / n);
        let half = error * t_quantile(self.rows);
        Interval { mean, error, low: mean - half, high: mean + half, n_effective: n, blocks: self.rows }
    }
}
