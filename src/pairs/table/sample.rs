//! Some rows of a table, drawn while it is read piece by piece.

use polars::prelude::{BooleanChunked, DataFrame, NewChunkedArray as _, PolarsResult};
use rand::Rng as _;

use crate::rng::{Seeds, Stream};

/// How many rows are drawn, and from which seed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Rows; all, if there are no more.
    pub rows: usize,
    /// What the draw depends on, together with the number of rows.
    pub seeds: Seeds,
}

/// Rows drawn so far. Each row gets a random number, and those with the smallest ones are kept: every set of rows is
/// equally likely, and it does not matter where pieces begin.
pub(super) struct Drawn {
    wanted: usize,
    stream: Stream,
    /// Rows seen.
    pub(super) seen: u64,
    kept: Option<DataFrame>,
    keys: Vec<u64>,
    /// Keys from here on are not among the smallest.
    limit: u64,
}

impl Drawn {
    pub(super) fn new(sample: &Sample) -> Self {
        let stream = sample.seeds.stream("rows");
        Self { wanted: sample.rows, stream, seen: 0, kept: None, keys: Vec::new(), limit: u64::MAX }
    }

    pub(super) fn add(&mut self, piece: &DataFrame) -> PolarsResult<()> {
        let keys: Vec<u64> = (0..piece.height()).map(|_| self.stream.next_u64()).collect();
        self.seen += keys.len() as u64;
        let mask: Vec<bool> = keys.iter().map(|&key| key < self.limit).collect();
        let chosen = piece.filter(&BooleanChunked::from_slice("".into(), &mask))?;
        self.keys.extend(keys.into_iter().filter(|&key| key < self.limit));
        match &mut self.kept {
            Some(kept) => {
                kept.vstack_mut(&chosen)?;
            }
            None => self.kept = Some(chosen),
        }
        if self.keys.len() > 2 * self.wanted + (1 << 16) { self.prune() } else { Ok(()) }
    }

    /// Leaves only the wanted number of rows.
    fn prune(&mut self) -> PolarsResult<()> {
        if self.keys.len() <= self.wanted {
            return Ok(());
        }
        self.limit = *self.keys.clone().select_nth_unstable(self.wanted).1;
        let limit = self.limit;
        let mask: Vec<bool> = self.keys.iter().map(|&key| key < limit).collect();
        if let Some(kept) = &mut self.kept {
            *kept = kept.filter(&BooleanChunked::from_slice("".into(), &mask))?;
        }
        self.keys.retain(|&key| key < limit);
        Ok(())
    }

    /// The rows, in the order of the table, and how many there were to choose from.
    pub(super) fn finish(mut self) -> PolarsResult<(DataFrame, u64)> {
        self.prune()?;
        Ok((self.kept.unwrap_or_default(), self.seen))
    }
}

#[cfg(test)]
mod tests {
    use polars::prelude::{Column, NamedFrom as _, Series};

    use super::*;

    fn drawn(cuts: &[usize], rows: usize, seed: u64) -> Vec<u32> {
        let mut drawn = Drawn::new(&Sample { rows, seeds: Seeds::new(seed) });
        let mut from = 0;
        for &cut in cuts {
            let values: Vec<u32> = (from..from + cut as u32).collect();
            from += cut as u32;
            let column = Column::from(Series::new("a".into(), values));
            drawn.add(&DataFrame::new(cut, vec![column]).unwrap()).unwrap();
        }
        let (frame, seen) = drawn.finish().unwrap();
        assert_eq!(seen, u64::from(from));
        frame.column("a").unwrap().u32().unwrap().iter().flatten().collect()
    }

    #[test]
    fn as_many_rows_as_wanted_in_order_wherever_the_pieces_begin() {
        let whole = drawn(&[300_000], 50, 1);
        assert_eq!(whole.len(), 50);
        assert!(whole.windows(2).all(|w| w[0] < w[1]));
        assert_eq!(whole, drawn(&[1, 99_999, 150_000, 50_000], 50, 1));
        assert_ne!(whole, drawn(&[300_000], 50, 2));
        assert_eq!(drawn(&[3, 4], 50, 1), [0, 1, 2, 3, 4, 5, 6]);
        // uniform: the mean of 40 × 50 rows is 150,000 ± 1,936
        let mean = (0..40).flat_map(|seed| drawn(&[300_000], 50, seed)).map(f64::from).sum::<f64>() / 2000.0;
        assert!((mean - 150_000.0).abs() < 3.5 * 1936.0, "{mean}");
    }
}
