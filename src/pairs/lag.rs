//! The same samples with y some rows later.

use std::sync::Arc;

use super::PairsError;
use crate::schema::{Columns, Exchange, Samples};

/// Pairs each x (and z) with the y that stands `lag` rows later in the same episode; rows without such a y are no samples.
/// One series is one episode here, whatever blocks it is cut into.
///
/// # Errors
/// [`PairsError::NoLag`] when no sample has so many rows after it in its episode.
pub fn lagged(samples: &Samples, lag: usize) -> Result<Samples, PairsError> {
    if lag == 0 {
        return Ok(samples.clone());
    }
    let (width, count) = (samples.y.width(), samples.y.rows());
    let ends = samples.episodes().into_iter().map(|episode| match samples.exchange {
        Exchange::Episodes => samples.starts[episode as usize + 1],
        Exchange::Shift => count,
    });
    let within = samples.rows.iter().zip(ends).filter(|&(&r, end)| r as usize + lag < end);
    let rows: Vec<u32> = within.map(|(&r, _)| r).collect();
    if rows.is_empty() {
        let longest = samples.starts.windows(2).map(|w| w[1] - w[0]).max().unwrap_or(0);
        let longest = if samples.exchange == Exchange::Shift { count } else { longest };
        // a store says itself what its episodes are
        let of_store = samples.labels.sender.is_some();
        let remedy = if of_store { "give a smaller --lag" } else { "give --time or --group, or a smaller --lag" };
        return Err(PairsError::NoLag { lag, longest, samples: samples.rows.len(), remedy });
    }
    // the last rows have no y of their own later on: they are no samples, and what stands there is never read
    let mut data = Vec::with_capacity(count * width);
    for r in 0..count {
        data.extend_from_slice(samples.y.row((r + lag).min(count - 1)));
    }
    let y = Columns { data, names: samples.y.names.clone(), words: samples.y.words.clone() };
    let mut out = Samples { y: Arc::new(y), rows, ..samples.clone() };
    out.labels.y = format!("{}[+{lag}]", samples.labels.y);
    if !samples.notes.is_empty() {
        out.notes.push(format!("lag {lag} counts the rows that are left"));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::SampleLabels;

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
            "no pair 5 rows apart: the longest episode has 5 rows, and none of the 6 samples has so many after it; give --time or --group, or a smaller --lag"
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
}
