//! Element-wise functions and sums in vectors: e^x, ln x, tanh x, and what the passes need beside products.
//!
//! Error bounds (held by tests, every instruction set): `exp` 3e−7 relative in [−87, 87]; `ln` 2e−7 absolute plus 1e−7
//! relative for normal positive numbers; `tanh` 5e−7 absolute and 1e−6 relative.
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use super::simd::{LANES, Level, Operation, Simd};

/// Horner's rule, highest power first.
#[inline(always)]
fn polynomial<S: Simd, const N: usize>(s: S, x: S::V, coefficients: [f32; N]) -> S::V {
    let mut y = s.splat(coefficients[0]);
    for c in &coefficients[1..] {
        y = s.fma(y, x, s.splat(*c));
    }
    y
}

/// e^x for x held to [−87, 87]; Cephes' `expf`.
#[inline(always)]
pub(crate) fn exp<S: Simd>(s: S, x: S::V) -> S::V {
    // constants first: no number stays no number
    let x = s.max(s.splat(-87.0), s.min(s.splat(87.0), x));
    let n = s.round(s.mul(x, s.splat(core::f32::consts::LOG2_E)));
    let r = s.fma(n, s.splat(-0.693_359_4), x);
    let r = s.fma(n, s.splat(2.121_944_4e-4), r);
    let p = polynomial(s, r, [1.987_569_1e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5]);
    let y = s.add(s.fma(p, s.mul(r, r), r), s.splat(1.0));
    s.scale(y, n)
}

/// ln x for normal positive x; Cephes' `logf`.
#[inline(always)]
pub(crate) fn ln<S: Simd>(s: S, x: S::V) -> S::V {
    let (e, m) = s.split(x);
    let above = s.sub(m, s.splat(core::f32::consts::SQRT_2));
    let m = s.positive(above, s.mul(m, s.splat(0.5)), m);
    let e = s.positive(above, s.add(e, s.splat(1.0)), e);
    let f = s.sub(m, s.splat(1.0));
    let z = s.mul(f, f);
    let p = polynomial(
        s,
        f,
        [
            7.037_683_6e-2,
            -1.151_461e-1,
            1.167_699_9e-1,
            -1.242_014_1e-1,
            1.424_932_3e-1,
            -1.666_805_8e-1,
            2.000_071_5e-1,
            -2.499_999_4e-1,
            3.333_333e-1,
        ],
    );
    let y = s.fma(s.mul(p, f), z, s.mul(e, s.splat(-2.121_944_4e-4)));
    let y = s.fma(s.splat(-0.5), z, y);
    s.fma(e, s.splat(0.693_359_4), s.add(f, y))
}

/// tanh x by a rational function (the one of Eigen), held to [−1, 1].
#[inline(always)]
pub(crate) fn tanh<S: Simd>(s: S, x: S::V) -> S::V {
    let x = s.max(s.splat(-7.905_311), s.min(s.splat(7.905_311), x));
    let z = s.mul(x, x);
    let p = polynomial(
        s,
        z,
        [
            -2.760_768_5e-16,
            2.000_188e-13,
            -8.604_672e-11,
            5.122_297_1e-8,
            1.485_722_4e-5,
            6.372_619_3e-4,
            4.893_524_6e-3,
        ],
    );
    let q = polynomial(s, z, [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3]);
    let y = s.div(s.mul(x, p), q);
    s.max(s.splat(-1.0), s.min(s.splat(1.0), y))
}

/// A function of one vector.
pub(crate) trait Map {
    /// Its value.
    fn of<S: Simd>(&self, s: S, x: S::V) -> S::V;
}

/// Applies a function to every element; the tail goes through a padded copy.
struct InPlace<'a, F> {
    function: F,
    values: &'a mut [f32],
}

impl<F: Map> Operation for InPlace<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let mut chunks = self.values.chunks_exact_mut(S::WIDTH);
        for chunk in &mut chunks {
            let value = self.function.of(s, s.load(chunk));
            s.store(chunk, value);
        }
        let rest = chunks.into_remainder();
        let mut lanes = [0.0; LANES];
        lanes[..rest.len()].copy_from_slice(rest);
        let value = self.function.of(s, s.load(&lanes));
        s.store(&mut lanes, value);
        rest.copy_from_slice(&lanes[..rest.len()]);
    }
}

struct Tanh;

impl Map for Tanh {
    #[inline(always)]
    fn of<S: Simd>(&self, s: S, x: S::V) -> S::V {
        tanh(s, x)
    }
}

struct Sigmoid;

impl Map for Sigmoid {
    #[inline(always)]
    fn of<S: Simd>(&self, s: S, x: S::V) -> S::V {
        let one = s.splat(1.0);
        s.div(one, s.add(one, exp(s, s.sub(s.splat(0.0), x))))
    }
}

struct Exp;

impl Map for Exp {
    #[inline(always)]
    fn of<S: Simd>(&self, s: S, x: S::V) -> S::V {
        exp(s, x)
    }
}

/// eˣ of every element, x held to [−87, 87].
pub(crate) fn exp_in_place(values: &mut [f32]) {
    Level::best().run(InPlace { function: Exp, values });
}

/// tanh of every element.
pub(crate) fn tanh_in_place(values: &mut [f32]) {
    Level::best().run(InPlace { function: Tanh, values });
}

/// 1 / (1 + e⁻ˣ) of every element.
pub(crate) fn sigmoid_in_place(values: &mut [f32]) {
    Level::best().run(InPlace { function: Sigmoid, values });
}

/// Adds the sum of each column of `rows` (as long as `sums`, a multiple of 16) to `sums`.
pub(crate) struct ColumnSums<'a> {
    pub(crate) rows: &'a [f32],
    pub(crate) sums: &'a mut [f32],
}

impl Operation for ColumnSums<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let stride = self.sums.len();
        assert!(stride.is_multiple_of(LANES));
        for column in (0..stride).step_by(S::WIDTH) {
            let mut sum = s.load(&self.sums[column..]);
            for row in self.rows.chunks_exact(stride) {
                sum = s.add(sum, s.load(&row[column..]));
            }
            s.store(&mut self.sums[column..], sum);
        }
    }
}

/// y = X Wᵀ + bias for few outputs, as dot products: a product whose C is narrower than a vector would waste it.
pub(crate) struct Dots<'a> {
    /// Rows of `stride` floats, of which only those that `w` does not multiply by zero count.
    pub(crate) x: &'a [f32],
    /// One row of `stride` floats per output, zero beyond its width.
    pub(crate) w: &'a [f32],
    /// A multiple of 16.
    pub(crate) stride: usize,
    /// One per output.
    pub(crate) bias: &'a [f32],
    /// Rows of as many floats as there are outputs.
    pub(crate) y: &'a mut [f32],
}

impl Operation for Dots<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { x, w, stride, bias, y } = self;
        assert!(stride.is_multiple_of(LANES));
        for (x, y) in x.chunks_exact(stride).zip(y.chunks_exact_mut(bias.len())) {
            for ((y, w), bias) in y.iter_mut().zip(w.chunks_exact(stride)).zip(bias) {
                let mut sums = [s.splat(0.0); 4];
                for (x, w) in x.chunks_exact(LANES).zip(w.chunks_exact(LANES)) {
                    for part in 0..LANES / S::WIDTH {
                        let (x, w) = (s.load(&x[part * S::WIDTH..]), s.load(&w[part * S::WIDTH..]));
                        sums[part] = s.fma(x, w, sums[part]);
                    }
                }
                *y = s.sum16(sums) + bias;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest error of a function against its `f64` twin: absolute, relative.
    fn errors(level: Level, function: impl Map, exact: fn(f64) -> f64, points: &[f32]) -> [f64; 2] {
        let mut values = points.to_vec();
        level.run(InPlace { function, values: &mut values });
        let mut worst = [0.0f64; 2];
        for (&x, &y) in points.iter().zip(&values) {
            let (truth, found) = (exact(f64::from(x)), f64::from(y));
            worst[0] = worst[0].max((found - truth).abs());
            worst[1] = worst[1].max(if truth == 0.0 { found.abs() } else { (found / truth - 1.0).abs() });
        }
        worst
    }

    struct Ln;
    impl Map for Ln {
        fn of<S: Simd>(&self, s: S, x: S::V) -> S::V {
            ln(s, x)
        }
    }

    #[test]
    fn functions_stay_within_their_stated_errors_on_every_instruction_set() {
        let grid = |from: f64, to: f64| -> Vec<f32> {
            (0..200_003).map(|i| (from + (to - from) * f64::from(i) / 200_002.0) as f32).collect()
        };
        let small: Vec<f32> = (-120..10).flat_map(|e| [1.0f32, -1.3].map(|m| m * 2f32.powi(e))).collect();
        let positive: Vec<f32> = (-126..127).flat_map(|e| [1.0f32, 1.3, 1.42, 1.9].map(|m| m * 2f32.powi(e))).collect();
        for level in Level::available() {
            let found = errors(level, Exp, f64::exp, &grid(-87.0, 87.0));
            assert!(found[1] < 3e-7, "exp {found:?} {level:?}");
            for points in [&positive, &grid(0.5, 4.0)] {
                let found = points.chunks(1).map(|x| (errors(level, Ln, f64::ln, x)[0], f64::from(x[0]).ln().abs()));
                assert!(found.clone().all(|(e, size)| e < 2e-7 + 1e-7 * size), "ln {level:?}");
            }
            for points in [&small, &grid(-10.0, 10.0)] {
                let found = errors(level, Tanh, f64::tanh, points);
                assert!(found[0] < 5e-7 && found[1] < 1e-6, "tanh {found:?} {level:?}");
            }
            let found = errors(level, Sigmoid, |x| 1.0 / (1.0 + (-x).exp()), &grid(-30.0, 30.0));
            assert!(found[0] < 3e-7, "sigmoid {found:?} {level:?}");
            let mut extreme = [f32::INFINITY, f32::NEG_INFINITY, 200.0, -200.0];
            level.run(InPlace { function: Tanh, values: &mut extreme });
            assert!(extreme.iter().all(|y| (0.999_999..=1.0).contains(&y.abs())), "{extreme:?}");
        }
    }

    #[test]
    fn no_number_stays_no_number() {
        for level in Level::available() {
            let mut values = [f32::NAN; 3];
            level.run(InPlace { function: Tanh, values: &mut values });
            assert!(values.iter().all(|v| v.is_nan()), "{values:?} {level:?}");
        }
    }

    #[test]
    fn dots_and_column_sums_equal_the_plain_loops_on_every_instruction_set() {
        let x: Vec<f32> = (0..5 * 32).map(|i| (i * 37 % 101) as f32 - 50.0).collect();
        let w: Vec<f32> = (0..3 * 32).map(|i| (i * 53 % 17) as f32 - 8.0).collect();
        for level in Level::available() {
            let mut y = [0.0; 15];
            level.run(Dots { x: &x, w: &w, stride: 32, bias: &[1.0, 2.0, 3.0], y: &mut y });
            let mut sums = [1.0; 32];
            level.run(ColumnSums { rows: &x, sums: &mut sums });
            for r in 0..5 {
                for o in 0..3 {
                    let exact: f32 = (0..32).map(|k| x[r * 32 + k] * w[o * 32 + k]).sum();
                    assert_eq!(y[r * 3 + o], exact + o as f32 + 1.0);
                }
            }
            for c in 0..32 {
                assert_eq!(sums[c], 1.0 + (0..5).map(|r| x[r * 32 + c]).sum::<f32>());
            }
        }
    }
}
