//! The matrix product of the networks, C = A B, with what follows it fused in: bias and activation, or a slope.
//!
//! Its operands have few columns (16 to 64) and many rows. B and C have rows padded to whole vectors; a block of C
//! (6 × 64 with AVX-512) stays in registers while one row of B after the other is multiplied by elements of A, read
//! where they lie: nothing is packed or copied. On a Zen 5 core, GFLOP/s of this and of the `gemm` crate 0.19 at the
//! shapes of an update: 128 × 64 × 54 269 and 248, 128 × 32 × 18 246 and 195, 54 × 64 × 128 with A transposed 266 and
//! 231; there is no pass over C for bias, activation or slope besides.
#![expect(unsafe_code, reason = "the inner loop reads and writes through pointers; every bound is asserted before it")]
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use super::simd::{LANES, Level, Operation, Simd};

/// The left operand: element (m, k) lies at `start + m·row + k·col` of `data`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Left<'a> {
    pub(crate) data: &'a [f32],
    pub(crate) row: usize,
    pub(crate) col: usize,
}

/// What happens to a block of sums before it is stored.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Finish<'a> {
    /// C = sums.
    Set,
    /// C += sums.
    Add,
    /// C = max(z, leak z) with z = sums + bias, one bias per column.
    Bias {
        /// As long as a row of C.
        bias: &'a [f32],
        /// 0: `ReLU`; 1: identity.
        leak: f32,
    },
    /// C = sums where `y` > 0, else leak · sums; `y` is laid out as C.
    Slope {
        /// The activated values.
        y: &'a [f32],
        /// 0: `ReLU`; 1: identity.
        leak: f32,
    },
}

/// C = A B for `m × k` by `k × n`, then `finish`.
#[derive(Debug)]
pub(crate) struct Product<'a> {
    /// Rows of C, columns of C (a multiple of 16), inner dimension.
    pub(crate) size: [usize; 3],
    pub(crate) a: Left<'a>,
    /// Rows of `n` floats.
    pub(crate) b: &'a [f32],
    /// Rows of `n` floats.
    pub(crate) c: &'a mut [f32],
    pub(crate) finish: Finish<'a>,
}

impl Product<'_> {
    /// Computes it with the best instructions of this processor.
    pub(crate) fn compute(self) {
        Level::best().run(self);
    }
}

impl Operation for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { size: [m, n, k], a, b, c, finish } = self;
        assert!(n.is_multiple_of(LANES) && b.len() >= k * n && c.len() >= m * n, "{m} × {n} × {k}");
        let last = m.saturating_sub(1) * a.row + k.saturating_sub(1) * a.col;
        assert!(m == 0 || k == 0 || a.data.len() > last, "{m} × {k} by {} and {}", a.row, a.col);
        let of = Shape { size: [m, n, k], a, b: b.as_ptr(), c: c.as_mut_ptr() };
        // SAFETY: `a`, `b`, `c` and what `finish` reads hold every element of these sizes
        unsafe {
            match finish {
                Finish::Set => of.panels(simd, Set),
                Finish::Add => of.panels(simd, Add { c: of.c }),
                Finish::Bias { bias, leak } => {
                    assert!(bias.len() >= n);
                    of.panels(simd, Bias { bias: bias.as_ptr(), leak: simd.splat(leak) });
                }
                Finish::Slope { y, leak } => {
                    assert!(y.len() >= m * n);
                    of.panels(simd, Slope { y: y.as_ptr(), leak: simd.splat(leak) });
                }
            }
        }
    }
}

/// What happens to a vector of sums; as a type, so that a block's sums never leave the registers before.
trait Last<S: Simd>: Copy {
    /// The value stored at offset `at` of C, in column `column`.
    ///
    /// # Safety
    /// Both must be within what the operands hold.
    unsafe fn of(self, simd: S, sums: S::V, at: usize, column: usize) -> S::V;
}

#[derive(Clone, Copy)]
struct Set;

impl<S: Simd> Last<S> for Set {
    #[inline(always)]
    unsafe fn of(self, _: S, sums: S::V, _: usize, _: usize) -> S::V {
        sums
    }
}

#[derive(Clone, Copy)]
struct Add {
    c: *mut f32,
}

impl<S: Simd> Last<S> for Add {
    #[inline(always)]
    unsafe fn of(self, simd: S, sums: S::V, at: usize, _: usize) -> S::V {
        // SAFETY: the caller's promise
        simd.add(unsafe { simd.load_at(self.c.add(at)) }, sums)
    }
}

#[derive(Clone, Copy)]
struct Bias<V> {
    bias: *const f32,
    leak: V,
}

impl<S: Simd> Last<S> for Bias<S::V> {
    #[inline(always)]
    unsafe fn of(self, simd: S, sums: S::V, _: usize, column: usize) -> S::V {
        // SAFETY: the caller's promise
        let z = simd.add(sums, unsafe { simd.load_at(self.bias.add(column)) });
        simd.max(simd.mul(self.leak, z), z)
    }
}

#[derive(Clone, Copy)]
struct Slope<V> {
    y: *const f32,
    leak: V,
}

impl<S: Simd> Last<S> for Slope<S::V> {
    #[inline(always)]
    unsafe fn of(self, simd: S, sums: S::V, at: usize, _: usize) -> S::V {
        // SAFETY: the caller's promise
        let y = unsafe { simd.load_at(self.y.add(at)) };
        simd.positive(y, sums, simd.mul(self.leak, sums))
    }
}

/// The operands of a product whose bounds were checked.
#[derive(Clone, Copy)]
struct Shape<'a> {
    size: [usize; 3],
    a: Left<'a>,
    b: *const f32,
    c: *mut f32,
}

impl Shape<'_> {
    /// All of C, in panels of as many columns as the registers hold sums for.
    #[inline(always)]
    unsafe fn panels<S: Simd, L: Last<S>>(self, simd: S, last: L) {
        let n = self.size[1];
        let mut column = 0;
        while column < n {
            let vectors = (n - column) / S::WIDTH;
            // SAFETY: a panel is no wider than the columns that are left
            unsafe {
                // blocks whose sums, one row of B and one element of A fit 32 registers of 16 lanes, or 16 of fewer
                if S::WIDTH == 16 && vectors >= 4 {
                    self.panel::<S, L, 6, 4>(simd, column, last);
                    column += 4 * S::WIDTH;
                } else if vectors >= 2 {
                    match S::WIDTH {
                        16 => self.panel::<S, L, 12, 2>(simd, column, last),
                        8 => self.panel::<S, L, 6, 2>(simd, column, last),
                        _ => self.panel::<S, L, 4, 2>(simd, column, last),
                    }
                    column += 2 * S::WIDTH;
                } else {
                    self.panel::<S, L, 12, 1>(simd, column, last);
                    column += S::WIDTH;
                }
            }
        }
    }

    /// All rows of `N` vectors of columns, `M` rows at a time.
    #[inline(always)]
    unsafe fn panel<S: Simd, L: Last<S>, const M: usize, const N: usize>(self, simd: S, column: usize, last: L) {
        let m = self.size[0];
        let mut row = 0;
        // SAFETY: `row` and the height of its block stay within the rows of C
        unsafe {
            while row + M <= m {
                self.block::<S, L, M, N>(simd, row, column, last);
                row += M;
            }
            if M > 8 && row + 8 <= m {
                self.block::<S, L, 8, N>(simd, row, column, last);
                row += 8;
            }
            if M > 4 && row + 4 <= m {
                self.block::<S, L, 4, N>(simd, row, column, last);
                row += 4;
            }
            if row + 2 <= m {
                self.block::<S, L, 2, N>(simd, row, column, last);
                row += 2;
            }
            if row < m {
                self.block::<S, L, 1, N>(simd, row, column, last);
            }
        }
    }

    /// `M` rows by `N` vectors of C.
    #[inline(always)]
    unsafe fn block<S: Simd, L: Last<S>, const M: usize, const N: usize>(
        self,
        simd: S,
        row: usize,
        column: usize,
        last: L,
    ) {
        let [_, n, k] = self.size;
        let mut sums = [[simd.splat(0.0); N]; M];
        let mut from = self.a.data.as_ptr().wrapping_add(row * self.a.row);
        let mut line = self.b.wrapping_add(column);
        // SAFETY: `row + M` and `column + N·WIDTH` are within C, whose operands were checked
        unsafe {
            for _ in 0..k {
                let mut right = [simd.splat(0.0); N];
                for j in 0..N {
                    right[j] = simd.load_at(line.add(j * S::WIDTH));
                }
                for i in 0..M {
                    let left = simd.splat(*from.add(i * self.a.row));
                    for j in 0..N {
                        sums[i][j] = simd.fma(left, right[j], sums[i][j]);
                    }
                }
                from = from.wrapping_add(self.a.col);
                line = line.wrapping_add(n);
            }
            for i in 0..M {
                for j in 0..N {
                    let (at, column) = ((row + i) * n + column + j * S::WIDTH, column + j * S::WIDTH);
                    simd.store_at(self.c.add(at), last.of(simd, sums[i][j], at, column));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Seeds};

    #[test]
    fn products_equal_the_triple_loop_on_every_instruction_set() {
        let mut rng = Seeds::new(1).stream("product");
        let mut draw = |n: usize| (0..n).map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32).collect::<Vec<_>>();
        for (m, n, k) in [(1, 16, 1), (6, 64, 64), (13, 80, 3), (128, 64, 54), (54, 64, 128), (29, 32, 7), (2, 48, 0)] {
            for (row, col) in [(k.max(1) + 3, 1), (1, m + 2)] {
                let (a, b, bias) = (draw(m * row + k * col), draw(k * n), draw(n));
                let (c, y) = (draw(m * n), draw(m * n));
                let mut bits = std::collections::BTreeMap::new();
                for level in Level::available() {
                    for (at, finish) in [
                        Finish::Set,
                        Finish::Add,
                        Finish::Bias { bias: &bias, leak: 0.01 },
                        Finish::Slope { y: &y, leak: 0.0 },
                    ]
                    .into_iter()
                    .enumerate()
                    {
                        let mut found = c.clone();
                        let a = Left { data: &a, row, col };
                        level.run(Product { size: [m, n, k], a, b: &b, c: &mut found, finish });
                        // sixteen lanes or eight: the same bits
                        if level != Level::Portable {
                            assert_eq!(bits.entry(at).or_insert_with(|| found.clone()), &found);
                        }
                        for i in 0..m {
                            for j in 0..n {
                                let term = |p: usize| f64::from(a.data[i * row + p * col]) * f64::from(b[p * n + j]);
                                let sum: f64 = (0..k).map(term).sum();
                                let z = sum + f64::from(bias[j]);
                                let exact = match at {
                                    0 => sum,
                                    1 => sum + f64::from(c[i * n + j]),
                                    2 => z.max(0.01 * z),
                                    _ => f64::from(u8::from(y[i * n + j] > 0.0)) * sum,
                                };
                                let error = (f64::from(found[i * n + j]) - exact).abs();
                                assert!(error < 1e-5, "{m} × {n} × {k} at {i}, {j}, finish {at}, {level:?}: {error}");
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    #[should_panic(expected = "3 × 16 × 2")]
    fn a_result_that_is_too_short_is_refused_before_anything_is_written() {
        let (a, b) = ([0.0; 6], [0.0; 32]);
        let a = Left { data: &a, row: 2, col: 1 };
        Product { size: [3, 16, 2], a, b: &b, c: &mut [0.0; 47], finish: Finish::Set }.compute();
    }
}
