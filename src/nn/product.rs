//! f32 matrix products on one thread, row-major, through the `gemm` crate (kernel chosen at run time by the CPU).
#![expect(unsafe_code, reason = "gemm's entry point takes raw pointers; bounds are checked here before the call")]

use gemm::Parallelism;

/// A read-only matrix: `rows × cols` with the distance between rows, optionally seen transposed.
#[derive(Clone, Copy, Debug)]
pub(super) struct View<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
}

impl<'a> View<'a> {
    /// A dense row-major `rows × cols` matrix.
    pub(super) fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        assert!(data.len() >= rows * cols, "matrix of {rows} × {cols} over {} elements", data.len());
        Self { data, rows, cols, row_stride: cols, col_stride: 1 }
    }

    /// The same matrix transposed.
    pub(super) fn t(self) -> Self {
        Self {
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
            data: self.data,
        }
    }
}

/// `out = a b`, or `out += a b`; `out` is dense row-major.
pub(super) fn multiply(a: View<'_>, b: View<'_>, out: &mut [f32], accumulate: bool) {
    let (m, n, k) = (a.rows, b.cols, a.cols);
    assert_eq!(k, b.rows, "inner dimensions of a product");
    assert!(out.len() >= m * n, "product of {m} × {n} into {} elements", out.len());
    if m == 0 || n == 0 {
        return;
    }
    // SAFETY: `View::new` checked that both operands hold `rows × cols` elements at these strides, the assertion
    // above that `out` holds m × n; `out` is a unique borrow, so it overlaps neither operand.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            accumulate,
            a.data.as_ptr(),
            a.col_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.col_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_equal_the_triple_loop_for_plain_transposed_and_accumulated_operands() {
        let a: Vec<f32> = (0..6).map(|i| i as f32).collect();
        let b: Vec<f32> = (0..12).map(|i| 1.0 - i as f32).collect();
        let mut out = vec![f32::NAN; 8];
        multiply(View::new(&a, 2, 3), View::new(&b, 4, 3).t(), &mut out, false);
        for i in 0..2 {
            for j in 0..4 {
                let expected: f32 = (0..3).map(|k| a[i * 3 + k] * b[j * 3 + k]).sum();
                assert_eq!(out[i * 4 + j], expected);
            }
        }
        let before = out.clone();
        multiply(View::new(&a, 3, 2).t(), View::new(&b, 3, 4), &mut out, true);
        for i in 0..2 {
            for j in 0..4 {
                let expected: f32 = (0..3).map(|k| a[k * 2 + i] * b[k * 4 + j]).sum();
                assert_eq!(out[i * 4 + j], before[i * 4 + j] + expected);
            }
        }
    }
}
