//! Some rows of a table, drawn while it is read piece by piece.

use std::path::{Path, PathBuf};

use polars::prelude::{BooleanChunked, DataFrame, NewChunkedArray as _};
use rand::Rng as _;

use super::form::unreadable;
use super::several::Table;
use crate::pairs::PairsError;
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
    kept: Option<Table>,
    /// Of each row that is kept, its number and its place among all.
    keys: Vec<(u64, usize)>,
    /// Numbers from here on are not among the smallest.
    limit: u64,
}

impl Drawn {
    pub(super) fn new(sample: &Sample) -> Self {
        let stream = sample.seeds.stream("rows");
        Self { wanted: sample.rows, stream, kept: None, keys: Vec::new(), limit: u64::MAX }
    }

    /// Offers rows, whose places among all are `places`.
    pub(super) fn add(&mut self, rows: &DataFrame, places: &[usize], path: &Path) -> Result<(), PairsError> {
        let keys: Vec<(u64, usize)> = places.iter().map(|&place| (self.stream.next_u64(), place)).collect();
        let mask: Vec<bool> = keys.iter().map(|key| key.0 < self.limit).collect();
        let chosen = filtered(rows, &mask, path)?;
        self.keys.extend(keys.into_iter().filter(|key| key.0 < self.limit));
        match &mut self.kept {
            Some(kept) => kept.append(chosen, path)?,
            None => self.kept = Some(Table::of(chosen, path)),
        }
        if self.keys.len() > 2 * self.wanted + (1 << 16) { self.prune() } else { Ok(()) }
    }

    /// Leaves only the wanted number of rows.
    fn prune(&mut self) -> Result<(), PairsError> {
        if self.keys.len() <= self.wanted {
            return Ok(());
        }
        let mut numbers: Vec<u64> = self.keys.iter().map(|key| key.0).collect();
        let limit = *numbers.select_nth_unstable(self.wanted).1;
        self.limit = limit;
        let mask: Vec<bool> = self.keys.iter().map(|key| key.0 < limit).collect();
        if let Some(kept) = &mut self.kept {
            kept.frame = filtered(&kept.frame, &mask, &kept.path())?;
        }
        self.keys.retain(|key| key.0 < limit);
        Ok(())
    }

    /// The rows in the order of the table, whose files are `files`, with the row behind the last one of each; `None` when
    /// there was none to draw from.
    pub(super) fn finish(
        mut self,
        files: Vec<(PathBuf, usize)>,
        notes: Vec<String>,
    ) -> Result<Option<Table>, PairsError> {
        self.prune()?;
        let places = self.keys.into_iter().map(|key| key.1).collect();
        Ok(self.kept.map(|kept| kept.drawn(files, places, notes)))
    }
}

fn filtered(rows: &DataFrame, mask: &[bool], path: &Path) -> Result<DataFrame, PairsError> {
    rows.filter(&BooleanChunked::from_slice("".into(), mask)).map_err(unreadable("data", path))
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
            let places: Vec<usize> = (from as usize - cut..from as usize).collect();
            drawn.add(&DataFrame::new(cut, vec![column]).unwrap(), &places, Path::new("t")).unwrap();
        }
        let table = drawn.finish(vec![(PathBuf::from("t"), from as usize)], Vec::new()).unwrap().unwrap();
        let first = table.frame.column("a").unwrap().u32().unwrap().get(0).unwrap();
        assert_eq!(table.place(0), (first as usize + 1, PathBuf::from("t")));
        table.frame.column("a").unwrap().u32().unwrap().iter().flatten().collect()
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
