//! The null hypothesis: which x stand beside which y when x and y have nothing to do with each other.

use rand::Rng;

use crate::rng;
use crate::schema::{Exchange, Samples};

/// For each of `rows` (ascending, of `episodes`), the row whose x takes its place under one draw of the null.
///
/// Episodes: whole trajectories of x are permuted among `episodes` (ascending), and the samples stay where they are;
/// a trajectory that is too short is repeated. Shift: the rows of `episodes`, joined, are shifted in a circle by at
/// least a twentieth of their number.
pub fn permuted_rows<R: Rng + ?Sized>(samples: &Samples, episodes: &[u32], rows: &[u32], rng: &mut R) -> Vec<u32> {
    let span = |e: u32| samples.starts[e as usize]..samples.starts[e as usize + 1];
    match samples.exchange {
        Exchange::Episodes => {
            let order = rng::permutation(rng, episodes.len());
            let mut at = 0;
            let place = |&row: &u32| {
                while span(episodes[at]).end <= row as usize {
                    at += 1;
                }
                let step = row as usize - span(episodes[at]).start;
                let other = span(episodes[order[at]]);
                (other.start + step % other.len()) as u32
            };
            rows.iter().map(place).collect()
        }
        Exchange::Shift => {
            let joined: Vec<u32> = episodes.iter().flat_map(|&e| span(e).map(|r| r as u32)).collect();
            let least = (joined.len() / 20).max(1);
            let shift = least + rng::below(rng, (joined.len() + 1).saturating_sub(2 * least).max(1));
            let mut at = 0;
            let place = |&row: &u32| {
                while joined[at] < row {
                    at += 1;
                }
                joined[(at + shift) % joined.len()]
            };
            rows.iter().map(place).collect()
        }
    }
}

/// (1 + #{null ≥ observed}) / (1 + B): never 0, and 1 when the null always equals the observed value.
pub fn p_value(observed: f64, null: &[f64]) -> Option<f64> {
    if null.is_empty() {
        return None;
    }
    let reached = null.iter().filter(|&&v| v >= observed).count();
    Some((1 + reached) as f64 / (1 + null.len()) as f64)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::rng::Seeds;
    use crate::schema::{Columns, SampleLabels};

    fn samples(exchange: Exchange) -> Samples {
        let columns = Arc::new(Columns::new(vec![0.0; 12], vec!["a".to_owned()]));
        Samples {
            x: Arc::clone(&columns),
            y: columns,
            z: None,
            starts: Arc::from([0, 3, 6, 9, 12]),
            rows: (0..12).collect(),
            exchange,
            labels: SampleLabels::default(),
            notes: Vec::new(),
        }
    }

    #[test]
    fn trajectories_move_as_a_whole_and_keep_their_steps() {
        let samples = samples(Exchange::Episodes);
        let mut rng = Seeds::new(1).stream("null");
        let mut moved = 0;
        for _ in 0..50 {
            // samples at step 1 and 2 of episode 1 and at step 0 of episode 3; episodes 0 and 2 are not in play
            let found = permuted_rows(&samples, &[1, 3], &[4, 5, 9], &mut rng);
            assert!(found == [4, 5, 9] || found == [10, 11, 3], "{found:?}");
            moved += usize::from(found[0] == 10);
        }
        assert!((10..40).contains(&moved));
    }

    #[test]
    fn a_series_is_shifted_in_a_circle_and_never_by_nothing() {
        let samples = samples(Exchange::Shift);
        let mut rng = Seeds::new(2).stream("null");
        for _ in 0..50 {
            let found = permuted_rows(&samples, &[0, 2], &[0, 1, 2, 6, 7, 8], &mut rng);
            let shift = found.iter().position(|&r| r == 0).unwrap();
            assert!(shift != 0);
            let mut back = found.clone();
            back.rotate_left(shift);
            assert_eq!(back, [0, 1, 2, 6, 7, 8]);
        }
    }

    #[test]
    fn p_values_count_the_observed_draw() {
        assert_eq!(p_value(1.0, &[0.0; 199]), Some(1.0 / 200.0));
        assert_eq!(p_value(0.0, &[0.0; 199]), Some(1.0));
        assert_eq!(p_value(0.0, &[]), None);
    }
}
