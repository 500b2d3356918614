//! The samples of a store with y some steps later; those of a table are moved where its rows are read.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::PairsError;
use crate::schema::{Columns, Exchange, Samples};

/// Moves y in time. What was moved once is shared by all samples of the same columns: every link of a receiver.
#[derive(Debug, Default)]
pub struct Lagging {
    /// By column and lag; the columns themselves are kept, so that no other can take their place.
    moved: BTreeMap<(usize, usize), (Arc<Columns>, Arc<Columns>)>,
}

impl Lagging {
    /// Pairs each x (and z) with the y that stands `lag` rows later in the same episode; rows without such a y are no
    /// samples. One series is one episode here, whatever blocks it is cut into.
    ///
    /// # Errors
    /// [`PairsError::NoLag`] when no sample has so many rows after it in its episode.
    pub fn lagged(&mut self, samples: &Samples, lag: usize) -> Result<Samples, PairsError> {
        if lag == 0 {
            return Ok(samples.clone());
        }
        let count = samples.y.rows();
        let ends = samples.episodes().into_iter().map(|episode| match samples.exchange {
            Exchange::Episodes => samples.starts[episode as usize + 1],
            Exchange::Shift => count,
        });
        let within = samples.rows.iter().zip(ends).filter(|&(&r, end)| r as usize + lag < end);
        let rows: Vec<u32> = within.map(|(&r, _)| r).collect();
        if rows.is_empty() {
            return Err(too_short(samples, lag));
        }
        let place = (Arc::as_ptr(&samples.y) as usize, lag);
        let moved =
            self.moved.entry(place).or_insert_with(|| (Arc::clone(&samples.y), Arc::new(later(&samples.y, lag))));
        let mut out = Samples { y: Arc::clone(&moved.1), rows, ..samples.clone() };
        out.labels.y = format!("{}[+{lag}]", samples.labels.y);
        Ok(out)
    }
}

/// The rows `lag` later. The last rows have none: they are no samples, and what stands there is never read.
fn later(y: &Columns, lag: usize) -> Columns {
    let mut data = Vec::with_capacity(y.data.len());
    for r in 0..y.rows() {
        data.extend_from_slice(y.row((r + lag).min(y.rows() - 1)));
    }
    Columns { data, ..y.without_rows() }
}

fn too_short(samples: &Samples, lag: usize) -> PairsError {
    let longest = samples.starts.windows(2).map(|w| w[1] - w[0]).max().unwrap_or(0);
    let longest = if samples.exchange == Exchange::Shift { samples.y.rows() } else { longest };
    PairsError::NoLag { lag, longest, samples: samples.rows.len(), remedy: "give a smaller --lag" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::SampleLabels;

    fn lagged(samples: &Samples, lag: usize) -> Result<Samples, PairsError> {
        Lagging::default().lagged(samples, lag)
    }

    fn samples(exchange: Exchange) -> Samples {
        let columns =
            |from: i32| Arc::new(Columns::new((from..from + 9).map(f64::from).collect(), vec!["v".to_owned()]));
        Samples {
            x: columns(0),
            y: columns(100),
            z: None,
            starts: Arc::from([0, 4, 9]),
            rows: vec![0, 2, 3, 4, 5, 8],
            exchange,
            labels: SampleLabels { y: "v".to_owned(), ..SampleLabels::default() },
            notes: Vec::new(),
        }
    }

    #[test]
    fn no_pair_crosses_the_edge_of_an_episode() {
        let found = lagged(&samples(Exchange::Episodes), 2).unwrap();
        assert_eq!((found.rows.as_slice(), found.labels.y.as_str()), (&[0, 4, 5][..], "v[+2]"));
        assert!(found.rows.iter().all(|&r| found.y.row(r as usize)[0] == found.x.row(r as usize)[0] + 102.0));
        assert_eq!(lagged(&samples(Exchange::Episodes), 0).unwrap(), samples(Exchange::Episodes));
        let error = lagged(&samples(Exchange::Episodes), 5).unwrap_err().to_string();
        assert_eq!(
            error,
            "no pair 5 rows apart: the longest episode has 5 rows, and none of the 6 samples has so many after it; give a smaller --lag"
        );
    }

    #[test]
    fn of_a_rare_class_too_few_samples_are_the_reason() {
        let labels = SampleLabels { sender: Some("a".to_owned()), ..SampleLabels::default() };
        let rare = Samples { rows: vec![3, 8], labels, ..samples(Exchange::Episodes) };
        assert_eq!(
            lagged(&rare, 1).unwrap_err().to_string(),
            "no pair 1 rows apart: the longest episode has 5 rows, and none of the 2 samples has so many after it; give a smaller --lag"
        );
    }

    #[test]
    fn blocks_of_one_series_are_no_edges() {
        assert_eq!(lagged(&samples(Exchange::Shift), 3).unwrap().rows, [0, 2, 3, 4, 5]);
        assert!(lagged(&samples(Exchange::Shift), 9).is_err());
    }

    #[test]
    fn what_was_moved_once_is_shared() {
        let (one, mut lagging) = (samples(Exchange::Episodes), Lagging::default());
        let other = Samples { rows: vec![0, 1], x: Arc::clone(&one.y), ..one.clone() };
        let [a, b, c] = [(&one, 2), (&other, 2), (&one, 1)].map(|(set, lag)| lagging.lagged(set, lag).unwrap());
        assert!(Arc::ptr_eq(&a.y, &b.y) && !Arc::ptr_eq(&a.y, &c.y));
        assert_eq!((a.y.row(0), c.y.row(0)), (&[102.0][..], &[101.0][..]));
    }
}
