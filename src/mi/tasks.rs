//! The forty tasks of the benchmark of Czyż et al. 2023 (arXiv 2306.11078): distributions of known information.
//!
//! A task is a base distribution and maps of x and of y that lose nothing: the information is that of the base, and so is
//! its pointwise value, ln p(x,y)/p(x)p(y).

use std::f64::consts::{PI, SQRT_2};
use std::sync::Arc;

use statrs::function::erf::erfc;
use statrs::function::gamma::ln_gamma;

use crate::rng::{self, Stream};
use crate::schema::{Columns, Exchange, SampleLabels, Samples};

/// A distribution of known information.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Task {
    /// Its id in the benchmark.
    pub id: &'static str,
    /// Information in nats.
    pub truth: f64,
    base: Base,
    maps: &'static [Map],
}

/// What is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Base {
    /// `pairs` pairs of unit normals that correlate by `rho`, and independent ones up to `width` columns on either side.
    Pairs { width: usize, pairs: usize, rho: f64 },
    /// Unit normals that all correlate by one half, `width` on either side.
    Dense { width: usize },
    /// x uniform in \[0, 1\], y = x + noise uniform in ± this.
    Noise(f64),
    /// Student's t of both sides together, identity dispersion: uncorrelated, and dependent by its tails.
    Student { width: usize, degrees: usize },
}

/// What is done to x and y, each for itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Map {
    /// Φ of every column.
    NormalCdf,
    /// v √|v| of every column.
    HalfCube,
    /// arsinh of every column.
    Asinh,
    /// Sums of sines that keep the order, one for x and one for y.
    Wiggly,
    /// Quantiles of mixtures of two normals, one for x and one for y; takes uniform margins.
    Bimodal,
    /// x becomes a spiral in the plane; takes a uniform margin.
    Swissroll,
    /// x turns in its columns 0 and 1, y in 1 and 2, by the mean square of the row, in radians.
    Spiral,
}

const PAIR: Base = Base::Pairs { width: 1, pairs: 1, rho: 0.75 };
const ONE: f64 = 0.41333928659223396;
const TWO: f64 = 1.0216512475319814;

const fn task(id: &'static str, truth: f64, base: Base, maps: &'static [Map]) -> Task {
    Task { id, truth, base, maps }
}

const fn sparse(width: usize) -> Base {
    Base::Pairs { width, pairs: 2, rho: 0.8 }
}

const fn student(width: usize, degrees: usize) -> Base {
    Base::Student { width, degrees }
}

/// All forty.
pub const TASKS: &[Task] = &[
    task("1v1-normal-0.75", ONE, PAIR, &[]),
    task("normal_cdf-1v1-normal-0.75", ONE, PAIR, &[Map::NormalCdf]),
    task("1v1-additive-0.1", 1.7094379663467407, Base::Noise(0.1), &[]),
    task("1v1-additive-0.75", 1.0 / 3.0, Base::Noise(0.75), &[]),
    task("1v1-bimodal-0.75", ONE, PAIR, &[Map::NormalCdf, Map::Bimodal]),
    task("wiggly-1v1-normal-0.75", ONE, PAIR, &[Map::Wiggly]),
    task("half_cube-1v1-normal-0.75", ONE, PAIR, &[Map::HalfCube]),
    task("student-identity-1-1-1", 0.22417142752923613, student(1, 1), &[]),
    task("asinh-student-identity-1-1-1", 0.22417142752923613, student(1, 1), &[Map::Asinh]),
    task("swissroll_x-normal_cdf-1v1-normal-0.75", ONE, PAIR, &[Map::NormalCdf, Map::Swissroll]),
    task("multinormal-dense-2-2-0.5", 0.2938933324510593, Base::Dense { width: 2 }, &[]),
    task("multinormal-dense-3-3-0.5", 0.41333928659223407, Base::Dense { width: 3 }, &[]),
    task("multinormal-dense-5-5-0.5", 0.5928118328288701, Base::Dense { width: 5 }, &[]),
    task("multinormal-dense-25-25-0.5", 1.2921837216593204, Base::Dense { width: 25 }, &[]),
    task("multinormal-dense-50-50-0.5", 1.6242653743036897, Base::Dense { width: 50 }, &[]),
    task("multinormal-sparse-2-2-2-2.0", TWO, sparse(2), &[]),
    task("multinormal-sparse-3-3-2-2.0", TWO, sparse(3), &[]),
    task("multinormal-sparse-5-5-2-2.0", TWO, sparse(5), &[]),
    task("multinormal-sparse-25-25-2-2.0", TWO, sparse(25), &[]),
    task("student-identity-2-2-1", 0.43194562200144127, student(2, 1), &[]),
    task("student-identity-2-2-2", 0.1931471805599454, student(2, 2), &[]),
    task("student-identity-3-3-2", 0.29092192268276484, student(3, 2), &[]),
    task("student-identity-3-3-3", 0.17871185309236282, student(3, 3), &[]),
    task("student-identity-5-5-2", 0.44815067691532917, student(5, 2), &[]),
    task("student-identity-5-5-3", 0.29854362265275824, student(5, 3), &[]),
    task("normal_cdf-multinormal-sparse-3-3-2-2.0", TWO, sparse(3), &[Map::NormalCdf]),
    task("normal_cdf-multinormal-sparse-5-5-2-2.0", TWO, sparse(5), &[Map::NormalCdf]),
    task("normal_cdf-multinormal-sparse-25-25-2-2.0", TWO, sparse(25), &[Map::NormalCdf]),
    task("half_cube-multinormal-sparse-3-3-2-2.0", TWO, sparse(3), &[Map::HalfCube]),
    task("half_cube-multinormal-sparse-5-5-2-2.0", TWO, sparse(5), &[Map::HalfCube]),
    task("half_cube-multinormal-sparse-25-25-2-2.0", TWO, sparse(25), &[Map::HalfCube]),
    task("spiral-multinormal-sparse-3-3-2-2.0", TWO, sparse(3), &[Map::Spiral]),
    task("spiral-multinormal-sparse-5-5-2-2.0", TWO, sparse(5), &[Map::Spiral]),
    task("spiral-multinormal-sparse-25-25-2-2.0", TWO, sparse(25), &[Map::Spiral]),
    task("spiral-normal_cdf-multinormal-sparse-3-3-2-2.0", TWO, sparse(3), &[Map::NormalCdf, Map::Spiral]),
    task("spiral-normal_cdf-multinormal-sparse-5-5-2-2.0", TWO, sparse(5), &[Map::NormalCdf, Map::Spiral]),
    task("spiral-normal_cdf-multinormal-sparse-25-25-2-2.0", TWO, sparse(25), &[Map::NormalCdf, Map::Spiral]),
    task("asinh-student-identity-2-2-1", 0.43194562200144127, student(2, 1), &[Map::Asinh]),
    task("asinh-student-identity-3-3-2", 0.29092192268276484, student(3, 2), &[Map::Asinh]),
    task("asinh-student-identity-5-5-2", 0.44815067691532917, student(5, 2), &[Map::Asinh]),
];

impl Task {
    /// `n` samples, each its own episode.
    pub fn samples(&self, n: usize, rng: &mut Stream) -> Samples {
        let (mut x, mut y) = (Vec::new(), Vec::new());
        for _ in 0..n {
            let (mut a, mut b) = self.base.draw(rng);
            for map in self.maps {
                (a, b) = (map.apply(&a, true), map.apply(&b, false));
            }
            x.extend(a);
            y.extend(b);
        }
        let columns = |data: Vec<f64>, name: &str| {
            let width = data.len() / n.max(1);
            Arc::new(Columns::new(data, (0..width).map(|i| format!("{name}{i}")).collect()))
        };
        Samples {
            x: columns(x, "x"),
            y: columns(y, "y"),
            z: None,
            starts: (0..=n).collect::<Vec<_>>().into(),
            rows: (0..n as u32).collect(),
            exchange: Exchange::Episodes,
            labels: SampleLabels {
                x: "x".to_owned(),
                y: "y".to_owned(),
                group: self.id.to_owned(),
                ..SampleLabels::default()
            },
            notes: Vec::new(),
        }
    }

    /// ln p(x,y)/p(x)p(y) in nats of one draw.
    pub fn pointwise(&self, rng: &mut Stream) -> f64 {
        let (x, y) = self.base.draw(rng);
        self.base.pointwise(&x, &y)
    }
}

impl Base {
    fn draw(self, rng: &mut Stream) -> (Vec<f64>, Vec<f64>) {
        let mut normals = |count: usize| (0..count).map(|_| rng::normal(rng)).collect::<Vec<f64>>();
        match self {
            Self::Pairs { width, pairs, rho } => {
                let (x, mut y) = (normals(width), normals(width));
                let rest = libm::sqrt(1.0 - rho * rho);
                y.iter_mut().zip(&x).take(pairs).for_each(|(y, x)| *y = rho * x + rest * *y);
                (x, y)
            }
            Self::Dense { width } => {
                let shared = normals(1)[0];
                let mut side = || normals(width).into_iter().map(|v| (v + shared) / SQRT_2).collect();
                (side(), side())
            }
            Self::Noise(range) => {
                let x = rng::uniform(rng, 0.0, 1.0);
                (vec![x], vec![x + rng::uniform(rng, -range, range)])
            }
            Self::Student { width, degrees } => {
                let square = normals(degrees).iter().map(|v| v * v).sum::<f64>() / degrees as f64;
                let scale = 1.0 / libm::sqrt(square);
                let mut side = || normals(width).into_iter().map(|v| v * scale).collect();
                (side(), side())
            }
        }
    }

    fn pointwise(self, x: &[f64], y: &[f64]) -> f64 {
        let square = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>();
        match self {
            Self::Pairs { pairs, rho, .. } => {
                let s = 1.0 - rho * rho;
                let one = |(x, y): (&f64, &f64)| {
                    -0.5 * libm::log(s) - (rho * rho * (x * x + y * y) - 2.0 * rho * x * y) / (2.0 * s)
                };
                x.iter().zip(y).take(pairs).map(one).sum()
            }
            Self::Dense { width } => {
                // covariance ½ (I + 11ᵀ) of d columns: determinant 2⁻ᵈ (d + 1), quadratic form 2 (v·v − (Σv)²/(d + 1))
                let form = |square: f64, sum: f64, d: usize| 2.0 * (square - sum * sum / (d as f64 + 1.0));
                let (sum_x, sum_y) = (x.iter().sum::<f64>(), y.iter().sum::<f64>());
                let ln = |d: usize| libm::log(d as f64 + 1.0);
                let alone = form(square(x), sum_x, width) + form(square(y), sum_y, width);
                let both = form(square(x) + square(y), sum_x + sum_y, 2 * width);
                0.5 * (2.0 * ln(width) - ln(2 * width) + alone - both)
            }
            Self::Noise(range) => {
                // p(y|x) = 1/2ε; p(y) = the part of [y − ε, y + ε] in [0, 1], over 2ε
                let inside = (y[0] + range).min(1.0) - (y[0] - range).max(0.0);
                -libm::log(inside)
            }
            Self::Student { width, degrees } => {
                let v = degrees as f64;
                let ln_density = |square: f64, d: usize| {
                    let d = d as f64;
                    ln_gamma(f64::midpoint(v, d))
                        - ln_gamma(v / 2.0)
                        - 0.5 * d * libm::log(v * PI)
                        - 0.5 * (v + d) * libm::log1p(square / v)
                };
                let (in_x, in_y) = (square(x), square(y));
                ln_density(in_x + in_y, 2 * width) - ln_density(in_x, width) - ln_density(in_y, width)
            }
        }
    }
}

impl Map {
    fn apply(self, row: &[f64], is_x: bool) -> Vec<f64> {
        let each = |f: &dyn Fn(f64) -> f64| row.iter().map(|&v| f(v)).collect();
        match self {
            Self::NormalCdf => each(&cdf),
            Self::HalfCube => each(&|v| v * libm::sqrt(v.abs())),
            Self::Asinh => each(&libm::asinh),
            Self::Wiggly if is_x => {
                each(&|v| v + 0.4 * libm::sin(v) + 0.2 * libm::sin(1.7 * v + 1.0) + 0.03 * libm::sin(3.3 * v - 2.5))
            }
            Self::Wiggly => each(&|v| {
                v - 0.4 * libm::sin(0.4 * v) + 0.17 * libm::sin(1.3 * v + 3.5) + 0.02 * libm::sin(4.3 * v - 2.5)
            }),
            Self::Bimodal if is_x => each(&|u| quantile(|v| 0.3 * cdf(v) + 0.7 * cdf(v - 5.0), u)),
            Self::Bimodal => each(&|u| quantile(|v| 0.5 * cdf(v + 1.0) + 0.5 * cdf(v - 3.0), u)),
            Self::Swissroll if is_x => {
                let t = 1.5 * PI * (1.0 + 2.0 * row[0]);
                vec![t * libm::cos(t) / 21.0, t * libm::sin(t) / 21.0]
            }
            Self::Swissroll => row.to_vec(),
            Self::Spiral => {
                let angle = row.iter().map(|v| v * v).sum::<f64>() / row.len() as f64;
                let (i, j) = if is_x { (0, 1) } else { (1, 2) };
                let (sin, cos) = (libm::sin(angle), libm::cos(angle));
                let mut out = row.to_vec();
                (out[i], out[j]) = (cos * row[i] - sin * row[j], sin * row[i] + cos * row[j]);
                out
            }
        }
    }
}

/// Φ.
fn cdf(v: f64) -> f64 {
    0.5 * erfc(-v / SQRT_2)
}

/// Where an increasing function from 0 to 1 takes the value `u`, by bisection of [−30, 30].
fn quantile(f: impl Fn(f64) -> f64, u: f64) -> f64 {
    let (mut low, mut high) = (-30.0, 30.0);
    for _ in 0..60 {
        let middle = f64::midpoint(low, high);
        if f(middle) < u { low = middle } else { high = middle }
    }
    f64::midpoint(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;

    /// Mean of the pointwise information over `n` draws of one of the streams of a task, and its standard error.
    fn mean(task: &Task, stream: u64, n: usize) -> (f64, f64) {
        let mut rng = Seeds::new(7).child(task.id).indexed_stream("pointwise", stream);
        let (mut sum, mut squares) = (0.0, 0.0);
        for _ in 0..n {
            // less the truth, so that squares keep their digits
            let value = task.pointwise(&mut rng) - task.truth;
            sum += value;
            squares += value * value;
        }
        let mean = sum / n as f64;
        (mean, ((squares / n as f64 - mean * mean) / n as f64).sqrt())
    }

    /// Tasks without maps, each distribution once: maps change nothing.
    fn bases() -> impl Iterator<Item = &'static Task> {
        TASKS.iter().enumerate().filter(|(i, t)| TASKS[..*i].iter().all(|other| other.base != t.base)).map(|(_, t)| t)
    }

    #[test]
    fn the_mean_pointwise_information_is_the_truth_within_three_standard_errors() {
        for task in bases() {
            let (off, error) = mean(task, 0, 50_000);
            assert!(off.abs() < 3.0 * error, "{}: off by {off} ± {error}", task.id);
        }
    }

    /// One million draws are within three standard errors in 99.7 of 100 tries, so there are ten tries, and all draws
    /// together must be within three as well.
    #[test]
    #[ignore = "ten million draws of every distribution, in figures: two minutes"]
    fn the_mean_pointwise_information_is_the_truth_over_a_million_draws() {
        println!("task,truth,off,error,draws_within_3_errors_of_10");
        for task in bases() {
            let tries: Vec<(f64, f64)> = (0..10).map(|stream| mean(task, stream, 1_000_000)).collect();
            let within = tries.iter().filter(|(off, error)| off.abs() < 3.0 * error).count();
            let off = tries.iter().map(|t| t.0).sum::<f64>() / 10.0;
            let error = tries.iter().map(|t| t.1 * t.1).sum::<f64>().sqrt() / 10.0;
            println!("{},{},{off:.6},{error:.6},{within}", task.id, task.truth);
            assert!(within >= 9 && off.abs() < 3.0 * error, "{}: off by {off} ± {error}, {within} of 10", task.id);
        }
    }

    #[test]
    fn there_are_forty_of_the_stated_widths_and_maps_keep_what_they_should() {
        assert_eq!(TASKS.len(), 40);
        for (i, task) in TASKS.iter().enumerate() {
            assert!(TASKS[..i].iter().all(|other| other.id != task.id), "{}", task.id);
            let samples = task.samples(50, &mut Seeds::new(1).stream("widths"));
            let stated = ["2-2", "3-3", "5-5", "25-25", "50-50", "1-1"]
                .into_iter()
                .find(|w| task.id.contains(&format!("-{w}-")))
                .map_or((1, 1), |w| w.split_once('-').map(|(a, b)| (a.parse().unwrap(), b.parse().unwrap())).unwrap());
            let stated = if task.id.starts_with("swissroll") { (2, 1) } else { stated };
            assert_eq!((samples.x.width(), samples.y.width()), stated, "{}", task.id);
            assert!(samples.x.data.iter().chain(&samples.y.data).all(|v| v.is_finite()), "{}", task.id);
        }
        let row = [0.3, -1.2, 2.0];
        for is_x in [true, false] {
            let norm = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>();
            assert!((norm(&Map::Spiral.apply(&row, is_x)) - norm(&row)).abs() < 1e-12);
            for map in [Map::NormalCdf, Map::HalfCube, Map::Asinh, Map::Wiggly] {
                let at = |v: f64| map.apply(&[v], is_x)[0];
                assert!((-40..40).all(|i| at(0.1 * f64::from(i)) < at(0.1 * f64::from(i + 1))), "{map:?}");
            }
        }
        assert!((quantile(cdf, 0.975) - 1.959_963_984_540_054).abs() < 1e-9);
        assert!((cdf(0.0) - 0.5).abs() < 1e-15);
    }
}
