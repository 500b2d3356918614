//! Categories and how often they occur together: what the plug-in estimator needs.

use std::collections::BTreeMap;

use crate::schema::Columns;

/// Largest contingency table that is kept as such, per sample; larger ones are counted by sorting.
const DENSE: usize = 8;

/// The category of each row: rows are in one category when all their values are equal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Categories {
    /// Per row, `0..count`, numbered in ascending order of the values.
    pub(super) of: Vec<u32>,
    pub(super) count: usize,
}

impl Categories {
    pub(super) fn new(columns: &Columns) -> Self {
        let width = columns.width();
        let mut out = Self { of: vec![0; columns.rows()], count: 1 };
        for c in 0..width {
            let values = || columns.data.iter().skip(c).step_by(width);
            let mut levels: Vec<f64> = values().map(|v| v + 0.0).collect();
            levels.sort_unstable_by(f64::total_cmp);
            levels.dedup();
            let own = values().map(|v| levels.partition_point(|l| l < v) as u64);
            let joined: Vec<u64> =
                out.of.iter().zip(own).map(|(&b, v)| u64::from(b) * levels.len() as u64 + v).collect();
            out = Self::numbered(&joined);
        }
        out
    }

    /// Both at once.
    pub(super) fn joined(&self, other: &Self) -> Self {
        let pair = |(&a, &b): (&u32, &u32)| u64::from(a) * other.count as u64 + u64::from(b);
        Self::numbered(&self.of.iter().zip(&other.of).map(pair).collect::<Vec<_>>())
    }

    /// The places in `rows` of each category.
    pub(super) fn cells(&self, rows: &[u32]) -> Vec<Vec<u32>> {
        let mut out = vec![Vec::new(); self.count];
        rows.iter().zip(0..).for_each(|(&r, place)| out[self.of[r as usize] as usize].push(place));
        out
    }

    fn numbered(keys: &[u64]) -> Self {
        let mut levels = keys.to_vec();
        levels.sort_unstable();
        levels.dedup();
        let of = keys.iter().map(|k| levels.partition_point(|l| l < k) as u32).collect();
        Self { of, count: levels.len() }
    }
}

/// How often categories of x and of y occur, alone and together.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Table {
    n: f64,
    x: Vec<u32>,
    y: Vec<u32>,
    /// Count of each pair that occurs, by ascending x and then y.
    joint: Vec<((u32, u32), u32)>,
}

impl Table {
    /// Counts the pairs of row `x_rows[i]`'s category of x and row `y_rows[i]`'s of y.
    pub(super) fn new(x: &Categories, y: &Categories, x_rows: &[u32], y_rows: &[u32]) -> Self {
        let n = y_rows.len();
        let (mut in_x, mut in_y) = (vec![0; x.count], vec![0; y.count]);
        let pairs = || x_rows.iter().zip(y_rows).map(|(&a, &b)| (x.of[a as usize], y.of[b as usize]));
        for (a, b) in pairs() {
            in_x[a as usize] += 1;
            in_y[b as usize] += 1;
        }
        let joint = if x.count.saturating_mul(y.count) <= DENSE * n + 65_536 {
            let mut cells = vec![0; x.count * y.count];
            pairs().for_each(|(a, b)| cells[a as usize * y.count + b as usize] += 1);
            let place = |i: usize| ((i / y.count) as u32, (i % y.count) as u32);
            cells.into_iter().enumerate().filter(|c| c.1 > 0).map(|(i, c)| (place(i), c)).collect()
        } else {
            let mut all: Vec<(u32, u32)> = pairs().collect();
            all.sort_unstable();
            all.chunk_by(|a, b| a == b).map(|same| (same[0], same.len() as u32)).collect()
        };
        Self { n: n as f64, x: in_x, y: in_y, joint }
    }

    /// From the count of each pair that occurs; categories are numbered from 0.
    pub(super) fn of_counts(counts: &BTreeMap<(u32, u32), u32>) -> Self {
        let mut out = Self { n: 0.0, x: Vec::new(), y: Vec::new(), joint: Vec::with_capacity(counts.len()) };
        for (&(a, b), &count) in counts {
            for (side, at) in [(&mut out.x, a as usize), (&mut out.y, b as usize)] {
                side.resize(side.len().max(at + 1), 0);
                side[at] += count;
            }
            out.n += f64::from(count);
            out.joint.push(((a, b), count));
        }
        out
    }

    /// ln p(x,y)/p(x)p(y) of a pair that occurs `count` times.
    fn term(&self, (a, b): (u32, u32), count: u32) -> f64 {
        let product = f64::from(self.x[a as usize]) * f64::from(self.y[b as usize]);
        libm::log(f64::from(count) * self.n / product)
    }

    /// Plug-in information in nats: that of the observed frequencies.
    pub(super) fn information(&self) -> f64 {
        self.joint.iter().map(|&(pair, count)| f64::from(count) * self.term(pair, count)).sum::<f64>() / self.n
    }

    /// (`K_x` − 1)(`K_y` − 1) as far as it occurs, `K_xy` − `K_x` − `K_y` + 1: what Miller and Madow count.
    pub(super) fn degrees(&self) -> f64 {
        let [x, y] = self.occurring();
        self.joint.len() as f64 - (x + y) as f64 + 1.0
    }

    /// Σ p(x,y)²/p(x)p(y): 1 without dependence, the number of categories when x determines y and y x.
    pub(super) fn association(&self) -> f64 {
        self.cells().map(|(_, c, [a, b])| f64::from(c) * f64::from(c) / (f64::from(a) * f64::from(b))).sum()
    }

    /// The pairs that occur, how often, and how often their categories of x and of y do.
    pub(super) fn cells(&self) -> impl Iterator<Item = ((u32, u32), u32, [u32; 2])> {
        self.joint.iter().map(|&((a, b), count)| ((a, b), count, [self.x[a as usize], self.y[b as usize]]))
    }

    /// How often each category of x, and of y, occurs.
    pub(super) fn margins(&self) -> [&[u32]; 2] {
        [&self.x, &self.y]
    }

    /// Pairs of categories that occur.
    pub(super) fn pairs(&self) -> usize {
        self.joint.len()
    }

    /// Categories of x, and of y, that occur.
    pub(super) fn occurring(&self) -> [usize; 2] {
        self.margins().map(|counts| counts.iter().filter(|&&c| c > 0).count())
    }

    /// ln p(x,y)/p(x)p(y) of each of the pairs that were counted, in their order.
    pub(super) fn local(&self, x: &Categories, y: &Categories, x_rows: &[u32], y_rows: &[u32]) -> Vec<f64> {
        let terms: Vec<f64> = self.joint.iter().map(|&(pair, count)| self.term(pair, count)).collect();
        let term = |(&a, &b): (&u32, &u32)| {
            let pair = (x.of[a as usize], y.of[b as usize]);
            self.joint.binary_search_by(|other| other.0.cmp(&pair)).map_or(0.0, |at| terms[at])
        };
        x_rows.iter().zip(y_rows).map(term).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Seeds};

    fn columns(rows: &[&[f64]]) -> Columns {
        let names = (0..rows[0].len()).map(|i| i.to_string()).collect();
        Columns::new(rows.concat(), names)
    }

    #[test]
    fn equal_rows_are_one_category_and_zeros_have_no_sign() {
        let found = Categories::new(&columns(&[&[1.0, 0.0], &[0.0, 5.0], &[1.0, -0.0], &[1.0, -3.0]]));
        assert_eq!((found.of, found.count), (vec![2, 0, 2, 1], 3));
    }

    #[test]
    fn dense_and_sorted_counts_agree_with_a_map() {
        let mut rng = Seeds::new(1).stream("counts");
        for (n, levels) in [(10, 2), (500, 5), (300, 10_000)] {
            let mut draw = || {
                let of = (0..n).map(|_| rng::below(&mut rng, levels) as u32).collect();
                Categories { of, count: levels }
            };
            let (x, y) = (draw(), draw());
            let rows: Vec<u32> = (0..n as u32).collect();
            let table = Table::new(&x, &y, &rows, &rows);
            let mut map = BTreeMap::new();
            x.of.iter().zip(&y.of).for_each(|(&a, &b)| *map.entry((a, b)).or_insert(0) += 1);
            assert_eq!(table.joint, map.clone().into_iter().collect::<Vec<_>>());
            let counted = Table::of_counts(&map);
            assert_eq!((counted.n, &counted.joint), (table.n, &table.joint));
            assert_eq!((counted.information(), counted.degrees()), (table.information(), table.degrees()));
            let local = table.local(&x, &y, &rows, &rows);
            assert!((local.iter().sum::<f64>() / f64::from(n) - table.information()).abs() < 1e-12);
        }
    }
}
