//! What a table of counts does not show: pairs of categories that did not occur, and still may.

use std::collections::BTreeMap;

use super::counts::Table;

/// Samples' worth of independence that is mixed into a table to see how far down its information may go.
const MIXED: f64 = 2.0;

/// How counts fall into strata of z: per category of x, and of y, its stratum, and how many samples each stratum has.
/// Without z there is one.
pub(super) struct Strata {
    pub(super) of_x: Vec<u32>,
    pub(super) of_y: Vec<u32>,
    pub(super) sizes: Vec<u32>,
}

/// What unseen pairs may do to an information.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Unseen {
    /// Σ e^(−expected count) over the pairs that did not occur: how many of them independence would leave out. The bias
    /// that is counted from the pairs that did occur may be too small by as many half samples.
    pub(super) pairs: f64,
    /// The information of the frequencies with two samples' worth of independence mixed in, nats: a copy without an
    /// exception in n samples may have exceptions.
    pub(super) value: f64,
    /// Its standard error.
    pub(super) error: f64,
}

impl Unseen {
    /// For a table of `n` samples, of which `independent` are.
    pub(super) fn of(table: &Table, strata: &Strata, n: usize, independent: f64) -> Self {
        let (n, share) = (n as f64, (MIXED / independent).min(0.5));
        let expected =
            |a: u32, b: u32, stratum: u32| f64::from(a) * f64::from(b) / f64::from(strata.sizes[stratum as usize]);
        let (mut pairs, mut rest, mut value, mut square) = (expected_absent(table, strata), 1.0, 0.0, 0.0);
        for ((x, _), count, [a, b]) in table.cells() {
            let expected = expected(a, b, strata.of_x[x as usize]);
            pairs -= libm::exp(-expected);
            let (product, seen) = (expected / n, f64::from(count) / n);
            let mixed = (1.0 - share) * seen + share * product;
            let term = libm::log(mixed / product);
            rest -= product;
            value += mixed * term;
            square += mixed * term * term;
        }
        // pairs that did not occur have their share of the independence and nothing else
        let (term, rest) = (libm::log(share), rest.max(0.0));
        value += share * rest * term;
        square += share * rest * term * term;
        let error = libm::sqrt((square - value * value).max(0.0) / independent);
        Self { pairs: pairs.max(0.0), value, error }
    }
}

/// Σ e^(−expected count) over all pairs of each stratum; equal counts are taken together, of which there are few.
fn expected_absent(table: &Table, strata: &Strata) -> f64 {
    let mut counts = vec![[BTreeMap::<u32, f64>::new(), BTreeMap::new()]; strata.sizes.len()];
    for (side, (margin, of)) in table.margins().into_iter().zip([&strata.of_x, &strata.of_y]).enumerate() {
        for (&count, &stratum) in margin.iter().zip(of).filter(|(count, _)| **count > 0) {
            *counts[stratum as usize][side].entry(count).or_default() += 1.0;
        }
    }
    let of_stratum = |([x, y], &size): (&[BTreeMap<u32, f64>; 2], &u32)| {
        let term = |(a, times_a): (&u32, &f64)| {
            let with =
                |(b, times_b): (&u32, &f64)| times_b * libm::exp(-f64::from(*a) * f64::from(*b) / f64::from(size));
            times_a * y.iter().map(with).sum::<f64>()
        };
        x.iter().map(term).sum::<f64>()
    };
    counts.iter().zip(&strata.sizes).map(of_stratum).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::counts::Categories;

    fn table(x: &[u32], y: &[u32]) -> (Table, Strata) {
        let of = |v: &[u32]| Categories { of: v.to_vec(), count: 1 + *v.iter().max().unwrap() as usize };
        let rows: Vec<u32> = (0..x.len() as u32).collect();
        let (x, y) = (of(x), of(y));
        let one = |c: &Categories| vec![0; c.count];
        let strata = Strata { of_x: one(&x), of_y: one(&y), sizes: vec![rows.len() as u32] };
        (Table::new(&x, &y, &rows, &rows), strata)
    }

    #[test]
    fn unseen_pairs_by_hand() {
        // a copy of a fair coin in 8 samples: two pairs of expected count 2 are absent
        let (copy, strata) = table(&[0, 0, 1, 1, 0, 0, 1, 1], &[0, 0, 1, 1, 0, 0, 1, 1]);
        let found = Unseen::of(&copy, &strata, 8, 8.0);
        assert!((found.pairs - 2.0 * (-2.0f64).exp()).abs() < 1e-12);
        // a quarter of independence: ⁷/₁₆ and ¹/₁₆ twice each
        let (own, other) = (7.0 / 16.0f64, 1.0 / 16.0f64);
        let value = 2.0 * own * (own * 4.0).ln() + 2.0 * other * (other * 4.0).ln();
        assert!((found.value - value).abs() < 1e-12, "{found:?} {value}");
        assert!(found.value < 2f64.ln() - 0.25 && found.error > 0.1);
        // all pairs there: nothing unseen, and independence stays
        let (none, strata) = table(&[0, 0, 1, 1], &[0, 1, 0, 1]);
        assert_eq!(Unseen::of(&none, &strata, 4, 4.0), Unseen { pairs: 0.0, value: 0.0, error: 0.0 });
    }

    #[test]
    fn pairs_across_strata_are_not_missing() {
        // x and y copy z, and vary within it
        let (table, mut strata) = table(&[0, 1, 2, 3, 0, 1, 2, 3], &[0, 1, 2, 3, 1, 0, 3, 2]);
        strata.of_x = vec![0, 0, 1, 1];
        strata.of_y = vec![0, 0, 1, 1];
        strata.sizes = vec![4, 4];
        let found = Unseen::of(&table, &strata, 8, 8.0);
        assert!(found.pairs.abs() < 1e-12 && found.value.abs() < 1e-12, "{found:?}");
    }
}
