//! Sums over cyclic shifts: dot products of every row with rows further on, and the gradient of those.
//!
//! Rows stand as columns here, one line per feature, so that sixteen neighbours are one vector and a shift is an
//! offset. Whoever calls repeats the first or last columns at the end or start of each line for the wrap.
#![expect(unsafe_code, reason = "the inner loops read and write through pointers; every bound is asserted before them")]
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use super::simd::{LANES, Operation, Simd};

/// Lines of floats, `stride` apart.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lines<'a> {
    pub(crate) data: &'a [f32],
    pub(crate) stride: usize,
}

impl Lines<'_> {
    /// Checks that `lines` lines hold columns `offset..offset + n`.
    fn check(self, lines: usize, offset: usize, n: usize) {
        assert!(
            offset + n <= self.stride && self.data.len() >= lines * self.stride,
            "{lines} lines of {}",
            self.stride
        );
    }

    #[inline(always)]
    unsafe fn at<S: Simd>(self, simd: S, line: usize, column: usize) -> S::V {
        // SAFETY: the caller has checked lines and columns
        unsafe { simd.load_at(self.data.as_ptr().add(line * self.stride + column)) }
    }
}

/// `out[s][i] = Σ_f a[f][a_offset + i] b[f][i + shifts[s]]` for i in `0..n`, n rounded up to whole vectors.
pub(crate) struct SlidingDots<'a> {
    pub(crate) n: usize,
    pub(crate) features: usize,
    pub(crate) a: Lines<'a>,
    pub(crate) a_offset: usize,
    pub(crate) b: Lines<'a>,
    pub(crate) shifts: &'a [usize],
    /// One line of `out_stride` floats per shift; written from column `out_offset`.
    pub(crate) out: &'a mut [f32],
    pub(crate) out_stride: usize,
    pub(crate) out_offset: usize,
}

impl Operation for SlidingDots<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let n = self.n.next_multiple_of(LANES);
        self.a.check(self.features, self.a_offset, n);
        self.shifts.iter().for_each(|&shift| self.b.check(self.features, shift, n));
        let lines = self.shifts.len();
        assert!(self.out_offset + n <= self.out_stride && self.out.len() >= lines * self.out_stride);
        for i in (0..n).step_by(S::WIDTH) {
            let (fours, rest) = self.shifts.as_chunks::<4>();
            // SAFETY: the columns of every line were checked above
            unsafe {
                for (s, shifts) in fours.iter().enumerate() {
                    let mut sums = [simd.splat(0.0); 4];
                    for f in 0..self.features {
                        let a = self.a.at(simd, f, self.a_offset + i);
                        for l in 0..4 {
                            sums[l] = simd.fma(a, self.b.at(simd, f, i + shifts[l]), sums[l]);
                        }
                    }
                    for l in 0..4 {
                        let to = self.out.as_mut_ptr().add((4 * s + l) * self.out_stride + self.out_offset + i);
                        simd.store_at(to, sums[l]);
                    }
                }
                for (s, shift) in rest.iter().enumerate() {
                    let mut sum = simd.splat(0.0);
                    for f in 0..self.features {
                        let b = self.b.at(simd, f, i + shift);
                        sum = simd.fma(self.a.at(simd, f, self.a_offset + i), b, sum);
                    }
                    let line = 4 * fours.len() + s;
                    simd.store_at(self.out.as_mut_ptr().add(line * self.out_stride + self.out_offset + i), sum);
                }
            }
        }
    }
}

/// Features that share what is read of g; more would not fit 16 registers.
const TOGETHER: usize = 4;

/// `out[f][i] = Σ_s g[s][i + g_offsets[s]] b[f][i + b_offsets[s]]` for i in `0..n`, n rounded up to whole vectors.
pub(crate) struct SlidingSums<'a> {
    pub(crate) n: usize,
    pub(crate) features: usize,
    pub(crate) g: Lines<'a>,
    pub(crate) g_offsets: &'a [usize],
    pub(crate) b: Lines<'a>,
    pub(crate) b_offsets: &'a [usize],
    /// One line of `out_stride` floats per feature.
    pub(crate) out: &'a mut [f32],
    pub(crate) out_stride: usize,
}

impl Operation for SlidingSums<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let n = self.n.next_multiple_of(LANES);
        assert!(self.g_offsets.len() == self.b_offsets.len());
        self.g_offsets.iter().for_each(|&at| self.g.check(self.g_offsets.len(), at, n));
        self.b_offsets.iter().for_each(|&at| self.b.check(self.features, at, n));
        assert!(n <= self.out_stride && self.out.len() >= self.features * self.out_stride);
        for f in (0..self.features).step_by(TOGETHER) {
            let together = TOGETHER.min(self.features - f);
            for i in (0..n).step_by(S::WIDTH) {
                let mut sums = [simd.splat(0.0); TOGETHER];
                // SAFETY: the columns of every line were checked above
                unsafe {
                    for (s, (g, b)) in self.g_offsets.iter().zip(self.b_offsets).enumerate() {
                        let g = self.g.at(simd, s, i + g);
                        if together == TOGETHER {
                            for l in 0..TOGETHER {
                                sums[l] = simd.fma(g, self.b.at(simd, f + l, i + b), sums[l]);
                            }
                        } else {
                            for l in 0..together {
                                sums[l] = simd.fma(g, self.b.at(simd, f + l, i + b), sums[l]);
                            }
                        }
                    }
                    for l in 0..together {
                        simd.store_at(self.out.as_mut_ptr().add((f + l) * self.out_stride + i), sums[l]);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::simd::Level;
    use super::*;

    #[test]
    fn sliding_sums_equal_the_plain_loops_on_every_instruction_set() {
        let of = |n: usize, k: usize| (0..n).map(|i| (i * k % 19) as f32 - 9.0).collect::<Vec<_>>();
        let (n, features, stride, shifts) = (21, 7, 48, [0, 3, 11, 16, 5]);
        let (a, b, g) = (of(features * stride, 5), of(features * stride, 7), of(5 * stride, 3));
        let lines = |data| Lines { data, stride };
        for level in Level::available() {
            let mut out = vec![0.0; 5 * stride];
            level.run(SlidingDots {
                n,
                features,
                a: lines(&a),
                a_offset: 2,
                b: lines(&b),
                shifts: &shifts,
                out: &mut out,
                out_stride: stride,
                out_offset: 1,
            });
            for (s, shift) in shifts.iter().enumerate() {
                for i in 0..n {
                    let exact: f32 = (0..features).map(|f| a[f * stride + 2 + i] * b[f * stride + i + shift]).sum();
                    assert_eq!(out[s * stride + 1 + i], exact, "{s} {i} {level:?}");
                }
            }
            let mut out = vec![0.0; features * stride];
            level.run(SlidingSums {
                n,
                features,
                g: lines(&g),
                g_offsets: &[1, 2, 3, 4, 0],
                b: lines(&b),
                b_offsets: &shifts,
                out: &mut out,
                out_stride: stride,
            });
            for f in 0..features {
                for i in 0..n {
                    let term = |s: usize| g[s * stride + i + [1, 2, 3, 4, 0][s]] * b[f * stride + i + shifts[s]];
                    assert_eq!(out[f * stride + i], (0..5).map(term).sum::<f32>(), "{f} {i} {level:?}");
                }
            }
        }
    }
}
