//! Information given z by two critics of one family: I(x; y | z) = I(x; y, z) − I(x; z).

use std::sync::Arc;

use super::contrast::{Contrast, Reader, diverged};
use super::given::{NO_NULL, cells, permuted_within, too_wide};
use super::knn::Points;
use super::prepare::{Prepared, gather, prepare};
use super::{Estimate, Kind, MiError, Protocol, block_interval, p_value};
use crate::rng::Seeds;
use crate::schema::{Columns, Samples};

/// The row: how much better a critic that sees y and z knows x than one that sees z alone, on the same held-out samples.
pub(super) fn row(
    contrast: &Contrast,
    samples: &Samples,
    z: &Arc<Columns>,
    protocol: Protocol,
    seeds: &Seeds,
) -> Result<Estimate, MiError> {
    let given = samples.labels.given.clone().unwrap_or_default();
    let beside = |y: Arc<Columns>, label: String| {
        let mut labels = samples.labels.clone();
        labels.y = label;
        Samples { y, z: None, labels, ..samples.clone() }
    };
    let both = prepare(&beside(joined(&samples.y, z), format!("{} and {given}", samples.labels.y)), seeds)?;
    // the same split, since it is drawn from the same stream
    let alone = prepare(&beside(Arc::clone(z), given), seeds)?;
    let read = |data: &Prepared, name: &str| contrast.read(data, &seeds.child(name)).ok_or_else(|| diverged(samples));
    let (mut with_y, mut without) = (read(&both, "y and z")?, read(&alone, "z alone")?);
    let values: Vec<f64> = with_y.values.iter().zip(&without.values).map(|(a, b)| a - b).collect();
    let of = block_interval(&values, &both.test_blocks);
    // the difference of two lower bounds is neither bound; a critic of z that learnt nothing leaves to y what z tells
    let learnt = with_y.learnt && without.learnt;
    let mut row = contrast.row_of(samples, &both, of, Kind::Estimate, learnt);
    // each critic may be short of what it can know by as much as it lost between training and held-out episodes; and no
    // information is under 0, whatever two critics say
    row.interval_low = row.interval_low.map(|low| low - without.gap);
    row.interval_high = row.interval_high.map(|high| (high + with_y.gap).max(0.0));
    if !learnt {
        row.warnings.push("no interval: a difference of two critics, and one learnt nothing".to_owned());
    }
    if learnt && of.high < 0.0 {
        row.warnings.push("below 0: the critic of z alone knows more than that of y and z, so both err".to_owned());
    }
    for (reader, name) in [(&with_y, "y and z"), (&without, "z alone")] {
        row.warnings.extend(reader.warnings.iter().map(|w| format!("critic of {name}: {w}")));
    }
    if let Some(why) = too_wide(alone.y_width) {
        row.warnings.push(why);
    } else if both.test_episodes.len() == both.test.len() {
        row.p_value = null([(&mut with_y, &both), (&mut without, &alone)], protocol, seeds);
    } else {
        row.warnings.push(NO_NULL.to_owned());
    }
    Ok(row)
}

/// The columns of y, then those of z.
fn joined(y: &Columns, z: &Columns) -> Arc<Columns> {
    let data = (0..y.rows()).flat_map(|r| y.row(r).iter().chain(z.row(r)).copied()).collect();
    Arc::new(Columns::new(data, y.names.iter().chain(&z.names).cloned().collect()))
}

/// x exchanged within cells of test samples with neighbouring z, critics kept: what y adds to the score of a pair.
fn null([with_y, without]: [(&mut Reader, &Prepared); 2], protocol: Protocol, seeds: &Seeds) -> Option<f64> {
    let (test, width) = (&without.1.test, without.1.y_width);
    let (mut x, mut z) = (Vec::new(), Vec::new());
    gather(&without.1.x, without.1.x_width, test, &mut x);
    gather(&without.1.y, width, test, &mut z);
    let cells = cells(&Points { data: z.iter().map(|&v| f64::from(v)).collect(), width });
    let n = test.len();
    let sums = |(reader, data): (&mut Reader, &Prepared)| {
        let mut y = Vec::new();
        gather(&data.y, data.y_width, test, &mut y);
        let mut rng = seeds.stream("null");
        let mut draw = |b| if b == 0 { (0..n as u32).collect() } else { permuted_within(&cells, n, &mut rng) };
        reader.scorer.sums(&reader.params, [&x, &y], n, &mut (0..=protocol.permutations).map(&mut draw))
    };
    let added: Vec<f64> = sums(with_y).iter().zip(sums(without)).map(|(a, b)| a - b).collect();
    p_value(added[0], &added[1..])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run;
    use crate::mi::run::tests::{linear_samples, plan, samples_of};

    /// x, y and z from three independent normals per row.
    fn samples(n: usize, of: fn([f64; 3]) -> [f64; 3]) -> Samples {
        let noise = linear_samples(0.0, n, 2, 11);
        let rows: Vec<[f64; 3]> =
            (0..n).map(|r| of([noise.x.row(r)[0], noise.x.row(r)[1], noise.y.row(r)[0]])).collect();
        let column = |c: usize| rows.iter().map(|r| vec![r[c]]).collect::<Vec<_>>();
        let mut out = samples_of(&column(0), &column(1));
        out.z = Some(samples_of(&column(2), &column(2)).x);
        out.labels.given = Some("z".to_owned());
        out
    }

    fn estimate(samples: &Samples, name: &str) -> Estimate {
        run(std::slice::from_ref(samples), &plan(&[name], 99, 1), &|| ()).remove(0).rows.unwrap().remove(0)
    }

    #[test]
    fn normals_have_their_closed_forms_given_z() {
        // a chain x → z → y: nothing; y beside its own z: ½ ln 1/(1 − ρ²); a common effect z: ρ = −0.8 given it
        let chain = samples(4000, |[a, b, c]| {
            let z = 0.8 * a + 0.6 * b;
            [a, 0.8 * z + 0.6 * c, z]
        });
        let beside = samples(4000, |[a, b, c]| [a, 0.75 * a + 0.661_437_8 * b + c, c]);
        let collider = samples(4000, |[a, b, c]| [a, b, a + b + 0.5 * c]);
        for (samples, truth) in [(&chain, 0.0), (&beside, 0.4133), (&collider, 0.5108)] {
            let found = estimate(samples, "infonce");
            assert!((found.value - truth).abs() < 0.06, "{truth}: {found:?}");
            assert_eq!(found.p_value.unwrap() <= 0.01, truth > 0.0, "{truth}: {found:?}");
            assert_eq!((found.kind, found.given.as_deref()), (Kind::Estimate, Some("z")));
            // `beside`: z alone tells nothing of x, and its critic learns nothing
            let told = found.warnings.iter().any(|w| w.starts_with("no interval: a difference of two critics"));
            let learnt = !found.warnings.iter().any(|w| w.starts_with("critic of z alone: the critic"));
            assert_eq!((found.interval_low.is_some(), told), (learnt, !learnt), "{found:?}");
            assert!(found.interval_low.is_none_or(|low| low < found.value), "{found:?}");
            assert!(found.interval_high.is_none_or(|high| found.value < high), "{found:?}");
        }
    }

    #[test]
    fn where_z_tells_nearly_all_the_interval_holds_nothing() {
        let near = samples(1500, |[a, b, c]| [a + 0.03 * b, a + 0.03 * c, a]);
        let found = estimate(&near, "infonce");
        let (low, high) = (found.interval_low.unwrap(), found.interval_high.unwrap());
        assert!(low <= 0.0 && 0.0 <= high, "{found:?}");
    }

    #[test]
    fn z_that_teaches_nothing_leaves_no_interval_and_wide_z_no_p_value() {
        let useless = samples(600, |[a, b, c]| [a, a + 0.1 * b, c]);
        let found = estimate(&useless, "infonce");
        assert!(found.interval_low.is_none() && found.warnings.iter().any(|w| w.starts_with("critic of z alone: ")));
        let wide = Samples { z: Some(linear_samples(0.5, 600, 4, 7).x), ..useless };
        let found = estimate(&wide, "infonce");
        assert!(
            found.p_value.is_none() && found.warnings.iter().any(|w| w.contains("in 4 columns they are not alike"))
        );
    }

    #[test]
    fn samples_in_episodes_have_no_p_value_and_say_why() {
        let mut samples = samples(1000, |[a, b, c]| [a, a + b, c]);
        samples.starts = (0..=100).map(|e| 10 * e).collect::<Vec<_>>().into();
        let found = estimate(&samples, "infonce");
        assert!(found.p_value.is_none() && found.warnings.contains(&NO_NULL.to_owned()), "{found:?}");
    }
}
