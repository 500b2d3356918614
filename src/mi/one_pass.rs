//! Estimates from more samples than memory holds: pieces of them come one after the other, and none comes twice.

use super::{Estimate, MiError};
use crate::schema::{SampleLabels, Samples};

/// An estimate in the making. What comes out does not depend on where the samples were cut, but for the last digits.
pub trait OnePass: Send {
    /// Takes the next samples, each of which stands for itself. Columns are the same in all pieces, and so are the numbers
    /// that stand for words.
    ///
    /// # Errors
    /// [`MiError`] when there is no use in going on.
    fn add(&mut self, piece: &Samples) -> Result<(), MiError>;

    /// The rows. The value is what [`super::Estimator::estimate`] gives for all samples at once; interval and p-value come
    /// from the same sums, as the rows say.
    ///
    /// # Errors
    /// As [`super::Estimator::estimate`].
    fn finish(&self, labels: &SampleLabels, notes: &[String]) -> Result<Vec<Estimate>, MiError>;
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::mi::run::tests::{linear_samples, plan, samples_of};
    use crate::mi::{NOTE, Protocol};
    use crate::rng::Seeds;
    use crate::schema::Columns;

    /// The rows of one pass over pieces of these sizes, over and over, and those of all at once.
    fn both(name: &str, samples: &Samples, cuts: &[usize]) -> [Result<Vec<Estimate>, MiError>; 2] {
        let plan = plan(&[name], 0, 1);
        let mut pass = plan.estimators[0].1.one_pass().unwrap();
        let (mut rest, mut sizes) = (samples.rows.as_slice(), cuts.iter().cycle());
        let mut failed = None;
        while !rest.is_empty() {
            let (piece, after) = rest.split_at((*sizes.next().unwrap()).min(rest.len()));
            rest = after;
            failed = failed.or(pass.add(&Samples { rows: piece.to_vec(), ..samples.clone() }).err());
        }
        let found = failed.map_or_else(|| pass.finish(&samples.labels, &samples.notes), Err);
        [found, plan.estimators[0].1.estimate(samples, &Protocol { permutations: 99 }, &Seeds::new(1))]
    }

    /// Values, intervals and warnings agree.
    fn assert_alike(name: &str, samples: &Samples, cuts: &[usize]) {
        let [found, expected] = both(name, samples, cuts).map(Result::unwrap);
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found.value - expected.value).abs() < 1e-10, "{name} {cuts:?}: {found:?} {expected:?}");
            assert_eq!((found.n, &found.estimator, found.kind), (expected.n, &expected.estimator, expected.kind));
            // the pass has groups of 1024 rows
            let of_groups = |w: &str| w.starts_with("few blocks") || w.starts_with("no interval: ");
            let own: Vec<&String> = found.warnings.iter().filter(|w| !w.starts_with(NOTE) && !of_groups(w)).collect();
            let tied = |w: &&String| !w.starts_with("tied") && !w.starts_with(NOTE);
            assert_eq!(own, expected.warnings.iter().filter(tied).collect::<Vec<_>>(), "{name}");
            assert!(found.warnings.iter().any(|w| w.contains("all rows in one pass")));
        }
    }

    fn rounded(columns: &Columns, levels: f64) -> Arc<Columns> {
        let data = columns.data.iter().map(|v| (v * levels).round().clamp(-4.0, 4.0)).collect();
        Arc::new(Columns::new(data, columns.names.clone()))
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]
        #[test]
        fn pieces_give_what_all_at_once_give(
            seed in 0_u64..1000,
            rho in 0.0_f64..0.95,
            width in 1_usize..4,
            given in any::<bool>(),
            shift in prop::sample::select(vec![0.0, 1e3, -1e6]),
            cuts in prop::collection::vec(1_usize..700, 1..4),
        ) {
            let mut samples = linear_samples(rho, 2500, width, seed);
            if given {
                // z tells of both
                let noise = linear_samples(0.0, 2500, 1, seed + 1000);
                let z: Vec<Vec<f64>> = (0..2500).map(|r| vec![samples.x.row(r)[0] + samples.y.row(r)[width - 1] + noise.x.row(r)[0]]).collect();
                samples.z = Some(samples_of(&z, &z).x);
                samples.labels.given = Some("z".to_owned());
            }
            let moved = samples.x.data.iter().map(|v| v + shift).collect();
            let moved = Samples { x: Arc::new(Columns::new(moved, samples.x.names.clone())), ..samples.clone() };
            assert_alike("gaussian", &moved, &cuts);
            samples.x = rounded(&samples.x, 1.0);
            samples.y = rounded(&samples.y, 1.0);
            samples.z = samples.z.map(|z| rounded(&z, 0.5));
            if width == 1 {
                assert_alike("discrete", &samples, &cuts);
            }
        }
    }

    #[test]
    fn the_interval_is_that_of_all_at_once_and_the_tests_tell_dependence() {
        let normal = linear_samples(0.3, 60_000, 2, 7);
        let discrete = Samples { x: rounded(&normal.x, 1.0), y: rounded(&normal.y, 1.0), ..normal.clone() };
        for (name, samples, tolerance) in [("gaussian", &normal, 0.2), ("discrete", &discrete, 1e-9)] {
            let [found, expected] = both(name, samples, &[10_000]).map(Result::unwrap);
            let width = |e: &Estimate| e.interval_high.unwrap() - e.interval_low.unwrap();
            assert!((width(&found[0]) / width(&expected[0]) - 1.0).abs() < tolerance, "{found:?} {expected:?}");
            assert!(found[0].p_value.unwrap() < 1e-100, "{:?}", found[0].p_value);
        }
    }

    #[test]
    fn few_groups_of_rows_are_said() {
        for (rows, said) in [
            (900, Some("no interval: 900 rows are too few groups of 1024; give --memory more")),
            (1025, Some("no interval: 1025 rows are too few groups of 1024; give --memory more")),
            (5000, Some("few blocks: the interval rests on 5 groups of 1024 rows")),
            (12_000, None),
        ] {
            let [found, _] = both("gaussian", &linear_samples(0.5, rows, 1, 4), &[700]).map(Result::unwrap);
            let found = &found[0];
            let warnings: Vec<&str> =
                found.warnings.iter().map(String::as_str).filter(|w| !w.starts_with(NOTE)).collect();
            assert_eq!(warnings, said.into_iter().collect::<Vec<_>>());
            assert_eq!(found.interval_low.is_none(), rows < 2000);
        }
    }

    #[test]
    fn p_values_are_uniform_without_dependence() {
        for (name, width, given) in
            [("gaussian", 1, false), ("gaussian", 2, true), ("discrete", 1, false), ("discrete", 1, true)]
        {
            let p = |seed| {
                let mut samples = linear_samples(0.0, 1200, width, seed);
                let z = linear_samples(0.0, 1200, 1, seed + 5000);
                samples.z = given.then(|| Arc::clone(&z.x));
                samples.labels.given = given.then(|| "z".to_owned());
                if name == "discrete" {
                    samples = Samples {
                        x: rounded(&samples.x, 1.0),
                        y: rounded(&samples.y, 0.7),
                        z: samples.z.map(|z| rounded(&z, 0.3)),
                        ..samples
                    };
                }
                both(name, &samples, &[500])[0].as_ref().unwrap()[0].p_value.unwrap()
            };
            let all: Vec<f64> = (0..200).map(p).collect();
            // the G-test of rare categories is a little off; 10 % of 200: 20 ± 13 is three standard errors
            let below = all.iter().filter(|&&p| p < 0.1).count();
            assert!((7..=36).contains(&below), "{name} {width} {given}: {below} of 200 below 0.1");
            let mean = all.iter().sum::<f64>() / 200.0;
            assert!((mean - 0.5).abs() < 0.09, "{name} {width} {given}: mean {mean}");
        }
    }

    #[test]
    fn a_sparse_table_has_no_p_value_and_its_interval_reaches_to_nothing() {
        // about two rows per cell, then six
        for (levels, per_cell) in [(60, 2.2), (60, 4.5), (40, 6.0)] {
            let rows = (f64::from(levels * levels) * per_cell) as usize;
            let mut rng = Seeds::new(3).stream("sparse");
            let mut draw = || -> Vec<Vec<f64>> {
                (0..rows).map(|_| vec![crate::rng::below(&mut rng, levels as usize) as f64]).collect()
            };
            let samples = samples_of(&draw(), &draw());
            let mut pass = plan(&["discrete"], 0, 1).estimators[0].1.one_pass().unwrap();
            pass.add(&samples).unwrap();
            let found = pass.finish(&samples.labels, &[]).unwrap();
            let told = found[0].warnings.iter().any(|w| w.starts_with("no p-value") && w.contains("--sample"));
            assert_eq!((found[0].p_value.is_none(), told), (per_cell < 5.0, per_cell < 5.0), "{found:?}");
            // the chi-square limit is near 0.000 at two rows per cell
            assert!(found[0].p_value.is_none_or(|p| p > 0.001), "{found:?}");
            assert!(per_cell > 5.0 || found.iter().all(|r| r.interval_low.is_none_or(|low| low <= 0.0)), "{found:?}");
        }
    }

    #[test]
    fn what_cannot_be_estimated_says_why_as_all_at_once_does() {
        let base = linear_samples(0.5, 400, 1, 3);
        let constant = samples_of(&vec![vec![2.5]; 400], &vec![vec![1.0]; 400]);
        let flat = Samples { y: constant.y, ..base.clone() };
        let copy = Samples { y: Arc::clone(&base.x), ..base.clone() };
        let mut determined = base.clone();
        determined.z = Some(Arc::clone(&base.x));
        determined.labels.given = Some("z".to_owned());
        let few = Samples { rows: (0..3).collect(), ..base.clone() };
        for (name, samples) in [("gaussian", &flat), ("gaussian", &determined), ("gaussian", &few), ("discrete", &flat)]
        {
            let [found, expected] = both(name, samples, &[150]).map(Result::unwrap_err);
            assert_eq!(found, expected);
        }
        let [found, _] = both("gaussian", &copy, &[150]).map(Result::unwrap);
        assert!(found[0].value.is_infinite() && found[0].warnings[0].starts_with("infinite (copy)"), "{found:?}");
        // a constant, a copy of another column, and z that is constant in part
        let wide: Vec<Vec<f64>> = (0..400).map(|r| base.x.row(r)[0]).map(|v| vec![v, 7.0, 1.0 - 2.0 * v]).collect();
        let mut wide = Samples { x: samples_of(&wide, &wide).x, ..base.clone() };
        assert_alike("gaussian", &wide, &[64]);
        wide.z = Some(linear_samples(0.0, 400, 1, 9).x);
        wide.labels.given = Some("z".to_owned());
        let [found, _] = both("gaussian", &wide, &[64]).map(Result::unwrap);
        assert!(found[0].warnings.iter().any(|w| w == "constant, left out: x1"), "{found:?}");
        // continuous columns have more pairs than can be counted
        let many = linear_samples(0.0, (1 << 20) + 5, 1, 8);
        let error = plan(&["discrete"], 0, 1).estimators[0].1.one_pass().unwrap().add(&many).unwrap_err().to_string();
        assert!(
            error.starts_with("more than 1048576 different pairs of categories in the first 1048581 rows"),
            "{error}"
        );
    }
}
