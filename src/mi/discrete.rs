//! # What it is
//!
//! The information of the observed frequencies of categories, exactly counted; and the same less its bias.
//!
//! # Definition
//!
//! `discrete` = Σ p̂(x,y) ln \[p̂(x,y)/p̂(x)p̂(y)\], the plug-in value. `discrete-mm` = `discrete` − (`K_xy` − `K_x` − `K_y` + 1)/2n
//! (Miller, Madow), K the categories that occur. Given z: Σ p̂(x,y,z) ln \[p̂(x,y,z) p̂(z)/p̂(x,z) p̂(y,z)\], less (`K_xyz` − `K_xz` −
//! `K_yz` + `K_z`)/2n.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, all samples; several columns make one category of equal rows. Nats.
//!
//! # Parameters
//!
//! None. Both intervals cover the truth. That of `discrete-mm` holds all I that the corrected value lies within t standard errors
//! of, the variance growing with I: the spread of the local terms over whole episodes, joined with
//! √((`K_xy` − `K_x` − `K_y` + 1)/2 + φ²)/n, φ² = Σ p̂(x,y)²/p̂(x)p̂(y) − 1, which is the second order of the same expansion and
//! remains when the local terms do not vary: without dependence, and in a copy. Downwards it also reaches as far as with the bias
//! of the pairs that independence would leave unseen, as with two samples' worth of independence mixed in (a copy without exception may
//! have exceptions), and to 0 when the p-value is above 0.05. That of `discrete` reaches up to its own
//! value. `discrete-mm` is held to ln of the fewer categories of x and y, and to minus that remaining
//! error: without dependence, in large tables, that lifts its mean by 0.08 of the error. The p-value permutes whole
//! episodes; given z, x within equal z, if every sample is its own episode.
//!
//! # When it fails
//!
//! Continuous columns: every value is a category of its own, and the value is ln n whatever the dependence. With few
//! samples per pair of categories the bias is no longer as Miller and Madow have it; with less than four there is no
//! interval. All this is said.
//!
//! # Reference
//!
//! Miller 1955, in Information Theory in Psychology; Roulston 1999, Physica D 125, 285–294.
//!
//! # Differences from the reference implementation
//!
//! None known: equal to the published values of small tables (`datasets/tables`).

use super::counts::{Categories, Table};
use super::discrete_pass::DiscretePass;
use super::given::NO_NULL;
use super::interval::{Interval, Scatter, block_interval, t_quantile};
use super::part::Part;
use super::unseen::{Strata, Unseen};
use super::{Build, Estimate, Estimator, Kind, MiError, OnePass, Protocol, Unit, p_value};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::{SampleLabels, Samples};

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "discrete",
    summary: "exact counts of categories, plug-in and with Miller and Madow's correction",
    reference: "Miller 1955; Roulston 1999, Physica D 125",
    value: None,
    build,
};

/// Bias in nats from which it is worth a warning.
const BIASED: f64 = 0.02;

/// Samples per pair of categories below which there is no interval.
const CROWDED: usize = 4;
/// Error of the local terms in nats under which they do not vary.
const FLAT: f64 = 1e-12;

struct Discrete;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(Discrete))
}

impl Estimator for Discrete {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let (rows, labels, n) = (&samples.rows, &samples.labels, samples.len());
        if n < 2 {
            let widths = samples.x.width() + samples.y.width();
            return Err(MiError::TooFewSamples { needed: 2, widths, found: n });
        }
        let (x, y) = (Categories::new(&samples.x), Categories::new(&samples.y));
        let [distinct_x, distinct_y] = Table::new(&x, &y, rows, rows).occurring();
        for (distinct, label) in [(distinct_x, &labels.x), (distinct_y, &labels.y)] {
            if distinct == 1 {
                return Err(MiError::Constant { column: label.clone() });
            }
        }
        // I(x; y | z) = I(xz; yz) − H(z), and where x keeps its z, the pairs of xz and yz are the triples
        let z = samples.z.as_deref().map(Categories::new);
        let (x, y) = z.as_ref().map_or((x.clone(), y.clone()), |z| (x.joined(z), y.joined(z)));
        let table = Table::new(&x, &y, rows, rows);
        let of_z = z.as_ref().map(|z| Table::new(z, z, rows, rows));
        let mut terms = table.local(&x, &y, rows, rows);
        if let (Some(of_z), Some(z)) = (&of_z, &z) {
            terms.iter_mut().zip(of_z.local(z, z, rows, rows)).for_each(|(t, h)| *t -= h);
        }
        let local = block_interval(&terms, &samples.episodes());
        let all = Part::all(samples);
        let information = |from: &[u32]| Table::new(&x, &y, from, rows).information();
        let mut notes = samples.notes.clone();
        let null = match &z {
            None => Some(all.null(samples, *protocol, seeds, &information)),
            Some(z) => all.null_within(&z.cells(rows), *protocol, seeds, &information),
        };
        if null.is_none() {
            notes.push(NO_NULL.to_owned());
        }
        let p = p_value(table.information(), null.as_deref().unwrap_or_default());
        let words = [&samples.x, &samples.y].map(|c| (0..c.width()).any(|at| c.is_words(at)));
        let strata = strata_of(z.as_ref(), [&x, &y], rows);
        let counted = Counted { table, of_z, strata, distinct: [distinct_x, distinct_y], n, words };
        Ok(counted.rows(labels, local, p, notes))
    }

    fn one_pass(&self) -> Option<Box<dyn OnePass>> {
        Some(Box::<DiscretePass>::default())
    }

    fn takes_words(&self) -> bool {
        true
    }

    fn takes_given(&self) -> bool {
        true
    }
}

/// Counts of categories, from which the rows follow.
pub(super) struct Counted {
    /// x and y, each with z if there is one.
    pub(super) table: Table,
    /// z with itself.
    pub(super) of_z: Option<Table>,
    /// Which value of z belongs to which categories.
    pub(super) strata: Strata,
    /// Categories of x, and of y.
    pub(super) distinct: [usize; 2],
    pub(super) n: usize,
    /// Whether x, and y, hold words.
    pub(super) words: [bool; 2],
}

impl Counted {
    /// Plug-in information, nats.
    pub(super) fn information(&self) -> f64 {
        self.table.information() - self.of_z.as_ref().map_or(0.0, Table::information)
    }

    /// The two rows; `local` is the mean of the local terms with its error, `p` the p-value of both.
    pub(super) fn rows(
        &self,
        labels: &SampleLabels,
        local: Interval,
        p: Option<f64>,
        notes: Vec<String>,
    ) -> Vec<Estimate> {
        let (table, n) = (&self.table, self.n);
        let strata = self.of_z.as_ref().map_or(1, |of_z| of_z.occurring()[0]);
        let (value, degrees) = (self.information(), table.degrees() + (strata - 1) as f64);
        let bias = degrees / (2.0 * n as f64);
        let mut warnings = notes;
        for (at, label) in [&labels.x, &labels.y].into_iter().enumerate() {
            warnings.extend(sparse(self.distinct[at], n, self.words[at], label));
        }
        // where pairs of categories occur a few times, their frequencies say little about the error either
        let crowded = table.pairs() * CROWDED > n;
        if crowded {
            warnings
                .push(format!("{} pairs of categories in {n} samples: no interval; merge categories", table.pairs()));
        }
        if bias > BIASED {
            warnings.push(format!(
                "few samples per pair of categories: the plug-in value is about {bias:.3} nats too high"
            ));
        }
        if local.blocks < 10 {
            warnings.push(format!("few blocks: the interval rests on {} episodes", local.blocks));
        }
        // terms that do not vary cannot tell how many samples are independent
        let independent = if local.error > FLAT { local.n_effective } else { local.blocks as f64 };
        let second = 0.5 * degrees + table.association() - strata as f64;
        let chance = libm::sqrt(second.max(0.0)) / independent;
        let scatter = Scatter { seen: value, error: local.error, chance, n: independent };
        let (corrected, t) = (value - bias, t_quantile(local.blocks));
        let (mut low, high) = scatter.around(corrected, t);
        if !crowded {
            let unseen = Unseen::of(table, &self.strata, n, independent);
            low = low.min(scatter.around(corrected - unseen.pairs / (2.0 * n as f64), t).0);
            low = low.min(Scatter { error: unseen.error, ..scatter }.around(unseen.value - bias, t).0);
        }
        if p.is_some_and(|p| p > 0.05) {
            low = low.min(0.0);
        }
        let row = |name: &str, value: f64| {
            let mut row = Estimate::new(name, labels, value, Unit::Nats, Kind::Estimate, n);
            row.n_effective = independent;
            row.p_value = p;
            if local.blocks > 1 && !crowded {
                (row.interval_low, row.interval_high) = (Some(low.min(value)), Some(high.max(value)));
            }
            row.warnings.clone_from(&warnings);
            row
        };
        let most = libm::log(self.distinct[0].min(self.distinct[1]) as f64);
        vec![row("discrete", value), row("discrete-mm", corrected.clamp(-chance, most))]
    }
}

/// Which categories, joined with z, belong to which value of z.
fn strata_of(z: Option<&Categories>, sides: [&Categories; 2], rows: &[u32]) -> Strata {
    let mut sizes = vec![0; z.map_or(1, |z| z.count)];
    let stratum = |r: u32| z.map_or(0, |z| z.of[r as usize]);
    let [of_x, of_y] = sides.map(|side| {
        let mut of = vec![0; side.count];
        for &r in rows {
            of[side.of[r as usize] as usize] = stratum(r);
        }
        of
    });
    for &r in rows {
        sizes[stratum(r) as usize] += 1;
    }
    Strata { of_x, of_y, sizes }
}

/// Says when nearly every sample is a category of its own, and what to do.
fn sparse(distinct: usize, n: usize, words: bool, label: &str) -> Option<String> {
    if distinct <= 2 || distinct * 2 <= n {
        return None;
    }
    let advice = if words { "merge categories" } else { "take ksg for continuous columns" };
    Some(format!("{label} has {distinct} values in {n} samples: {advice}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::samples_of;
    use crate::rng;
    use crate::schema::Columns;

    fn both(samples: &Samples) -> [Estimate; 2] {
        let rows = Discrete.estimate(samples, &Protocol { permutations: 99 }, &Seeds::new(1)).unwrap();
        rows.try_into().unwrap()
    }

    fn column(values: &[u32]) -> Vec<Vec<f64>> {
        values.iter().map(|&v| vec![f64::from(v)]).collect()
    }

    #[test]
    fn a_table_by_hand() {
        // two of each pair; then four and four
        let none = samples_of(&column(&[0, 0, 1, 1, 0, 0, 1, 1]), &column(&[0, 1, 0, 1, 0, 1, 0, 1]));
        let [plug_in, corrected] = both(&none);
        assert_eq!(plug_in.value, 0.0);
        assert!((corrected.value + 1.0 / 16.0).abs() < 1e-12);
        assert_eq!(plug_in.p_value, Some(1.0));
        let copy = samples_of(&column(&[0, 0, 1, 1, 0, 0, 1, 1]), &column(&[5, 5, 2, 2, 5, 5, 2, 2]));
        let [plug_in, corrected] = both(&copy);
        assert!((plug_in.value - 2f64.ln()).abs() < 1e-12);
        // two pairs, two and two categories: K_xy − K_x − K_y + 1 = −1, and two values have no more than ln 2
        assert_eq!(corrected.value, 2f64.ln());
        assert_eq!((plug_in.estimator.as_str(), corrected.estimator.as_str()), ("discrete", "discrete-mm"));
    }

    #[test]
    fn constants_continuous_columns_and_crowded_tables_are_named() {
        let x = column(&(0..40).collect::<Vec<_>>());
        let y = column(&(0..40).map(|i| i % 2).collect::<Vec<_>>());
        let warnings = both(&samples_of(&x, &y))[0].warnings.join("; ");
        assert!(warnings.contains("x has 40 values in 40 samples: take ksg"), "{warnings}");
        let crowded = column(&(0..40).map(|i| i * i % 13).collect::<Vec<_>>());
        let warnings = both(&samples_of(&crowded, &column(&(0..40).map(|i| i * 7 % 10).collect::<Vec<_>>())))[0]
            .warnings
            .join("; ");
        assert!(
            warnings.contains("few samples per pair of categories: the plug-in value is about 0.250"),
            "{warnings}"
        );
        let mut words = samples_of(&x, &y);
        words.x = std::sync::Arc::new(Columns { words: vec![true], ..(*words.x).clone() });
        let warnings = both(&words)[0].warnings.join("; ");
        assert!(warnings.contains("x has 40 values in 40 samples: merge categories"), "{warnings}");
        let constant = Discrete.estimate(&samples_of(&x, &column(&[1; 40])), &Protocol::default(), &Seeds::new(1));
        assert_eq!(constant.unwrap_err(), MiError::Constant { column: "y".to_owned() });
        let one = Discrete.estimate(&samples_of(&x[..1], &y[..1]), &Protocol::default(), &Seeds::new(1));
        assert_eq!(one.unwrap_err(), MiError::TooFewSamples { needed: 2, widths: 2, found: 1 });
    }

    #[test]
    fn given_z_a_parity_appears_and_a_common_cause_disappears() {
        let mut rng = Seeds::new(9).stream("bits");
        let mut bits = |n: usize| (0..n).map(|_| rng::below(&mut rng, 2) as u32).collect::<Vec<_>>();
        let (a, b) = (bits(2000), bits(2000));
        let parity: Vec<u32> = a.iter().zip(&b).map(|(a, b)| a ^ b).collect();
        let mut samples = samples_of(&column(&a), &column(&b));
        samples.z = Some(samples_of(&column(&parity), &column(&parity)).x);
        let [plug_in, corrected] = both(&samples);
        // H(a | parity), by the counts themselves
        let count = |f: &dyn Fn(usize) -> bool| (0..2000).filter(|&i| f(i)).count() as f64;
        let mut entropy = 0.0;
        for (s, t) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let (both, alone) = (count(&|i| a[i] == s && parity[i] == t), count(&|i| parity[i] == t));
            entropy -= both / 2000.0 * (both / alone).ln();
        }
        assert!((plug_in.value - entropy).abs() < 1e-12, "{} against {entropy}", plug_in.value);
        // 4 triples, 4 and 4 pairs, 2 strata: −2/2n; no more than ln 2
        assert!((corrected.value - (plug_in.value + 2.0 / 4000.0).min(2f64.ln())).abs() < 1e-12);
        assert_eq!(plug_in.p_value, Some(0.01));
        // both are noisy copies of the parity: dependent, but not given it
        let noisy = |seed: u64| {
            let mut rng = Seeds::new(seed).stream("noise");
            parity.iter().map(|&p| p ^ u32::from(rng::bernoulli(&mut rng, 0.2))).collect::<Vec<_>>()
        };
        let copies = samples_of(&column(&noisy(1)), &column(&noisy(2)));
        (samples.x, samples.y) = (copies.x, copies.y);
        let [given, corrected] = both(&samples);
        assert!(corrected.value.abs() < 0.003 && given.p_value.unwrap() > 0.02, "{given:?}");
        samples.z = None;
        assert!(both(&samples)[1].value > 0.05);
    }

    #[test]
    fn values_stay_where_information_can_be_and_intervals_hold_them_and_have_a_length() {
        let numbers = |of: fn(u32) -> u32, n: u32| column(&(0..n).map(of).collect::<Vec<_>>());
        let cases = [
            // a copy of 30 different values, and of a fair coin; all pairs of 6 and 6 once; a die and its parity
            samples_of(&numbers(|i| i, 30), &numbers(|i| i, 30)),
            samples_of(&numbers(|i| i % 2, 30), &numbers(|i| i % 2, 30)),
            samples_of(&numbers(|i| i % 2, 100), &numbers(|i| i % 2, 100)),
            samples_of(&numbers(|i| i / 6, 36), &numbers(|i| i % 6, 36)),
            samples_of(&numbers(|i| i % 6, 60), &numbers(|i| i % 2, 60)),
            samples_of(&numbers(|i| i % 5, 40), &numbers(|i| i * i % 7, 40)),
        ];
        for samples in cases {
            let [plug_in, corrected] = both(&samples);
            let n = samples.len() as f64;
            assert!(corrected.value <= n.ln() && corrected.value > -1.0 / n.sqrt(), "{corrected:?}");
            for row in [plug_in, corrected] {
                if let Some((low, high)) = row.interval_low.zip(row.interval_high) {
                    assert!(low <= row.value && row.value <= high && high - low > 1.0 / n, "{row:?}");
                }
            }
        }
        // samples that repeat within episodes: as many as episodes
        let mut copy = samples_of(&numbers(|i| i / 10 % 2, 200), &numbers(|i| i / 10 % 2, 200));
        let width = |samples: &Samples| both(samples).map(|r| r.interval_high.unwrap() - r.interval_low.unwrap())[1];
        let apart = width(&copy);
        copy.starts = (0..=20).map(|e| 10 * e).collect::<Vec<_>>().into();
        assert!(width(&copy) > 5.0 * apart, "{} {apart}", width(&copy));
    }

    /// n pairs of binary symbols, y equal to x but for a share `flip`; three symbols when `flip` is one half.
    fn noisy(n: usize, flip: f64, seed: u64) -> Samples {
        let mut rng = Seeds::new(seed).stream("flip");
        let symbols = if flip < 0.5 { 2 } else { 3 };
        let x: Vec<u32> = (0..n).map(|_| rng::below(&mut rng, symbols) as u32).collect();
        let y: Vec<u32> = x
            .iter()
            .map(|&x| {
                if flip < 0.5 {
                    x ^ u32::from(rng::bernoulli(&mut rng, flip))
                } else {
                    rng::below(&mut rng, symbols) as u32
                }
            })
            .collect();
        samples_of(&column(&x), &column(&y))
    }

    #[test]
    fn the_interval_covers_the_truth_of_a_binary_channel_and_of_no_channel() {
        for flip in [0.1, 0.3, 0.5] {
            let entropy = |p: f64| if p < 0.5 { -p * p.ln() - (1.0 - p) * (1.0 - p).ln() } else { 2f64.ln() };
            let truth = 2f64.ln() - entropy(flip);
            let run = |seed| {
                let protocol = Protocol { permutations: 0 };
                Discrete.estimate(&noisy(300, flip, seed), &protocol, &Seeds::new(1)).unwrap().remove(1)
            };
            let rows: Vec<Estimate> = (0..200).map(run).collect();
            let inside = |r: &&Estimate| r.interval_low.unwrap() <= truth && truth <= r.interval_high.unwrap();
            let covered = rows.iter().filter(inside).count();
            let mean = rows.iter().map(|r| r.value).sum::<f64>() / 200.0;
            assert!((mean - truth).abs() < 0.006, "{flip}: {mean} against {truth}");
            // 95 % of 200 is 190; 180 or fewer has probability 0.002
            assert!(covered > 180, "{flip}: {covered} of 200");
        }
    }
}
