//! Small dense symmetric matrices in f64: what the Gaussian estimator needs.

/// Sums behind a covariance: count, sums and products of `width` columns; they add and subtract.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Moments {
    pub(super) n: f64,
    sums: Vec<f64>,
    /// Lower triangle by rows.
    products: Vec<f64>,
}

impl Moments {
    pub(super) fn new(width: usize) -> Self {
        Self { n: 0.0, sums: vec![0.0; width], products: vec![0.0; width * (width + 1) / 2] }
    }

    pub(super) fn add_row(&mut self, row: &[f64]) {
        self.n += 1.0;
        let mut products = self.products.as_mut_slice();
        for (i, (sum, &a)) in self.sums.iter_mut().zip(row).enumerate() {
            *sum += a;
            let (line, rest) = products.split_at_mut(i + 1);
            line.iter_mut().zip(row).for_each(|(p, b)| *p += a * b);
            products = rest;
        }
    }

    pub(super) fn add(&mut self, other: &Self, sign: f64) {
        self.n += sign * other.n;
        self.sums.iter_mut().zip(&other.sums).for_each(|(a, b)| *a += sign * b);
        self.products.iter_mut().zip(&other.products).for_each(|(a, b)| *a += sign * b);
    }

    /// Mean of a column.
    pub(super) fn mean(&self, column: usize) -> f64 {
        self.sums[column] / self.n
    }

    pub(super) fn covariance(&self) -> Symmetric {
        let width = self.sums.len();
        let mut out = Symmetric { width, data: vec![0.0; width * width] };
        let mut at = 0;
        for i in 0..width {
            for j in 0..=i {
                let c = (self.products[at] - self.sums[i] * self.sums[j] / self.n) / (self.n - 1.0);
                out.data[i * width + j] = c;
                out.data[j * width + i] = c;
                at += 1;
            }
        }
        out
    }
}

/// A symmetric matrix, row-major and full.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Symmetric {
    pub(super) width: usize,
    pub(super) data: Vec<f64>,
}

impl Symmetric {
    /// The square block of these rows and columns.
    pub(super) fn block(&self, columns: std::ops::Range<usize>) -> Self {
        let data = columns.clone().flat_map(|i| self.data[i * self.width..][columns.clone()].to_vec()).collect();
        Self { width: columns.len(), data }
    }

    /// The rows and columns of these numbers.
    pub(super) fn picked(&self, columns: &[usize]) -> Self {
        let data = columns.iter().flat_map(|&i| columns.iter().map(move |&j| self.data[i * self.width + j])).collect();
        Self { width: columns.len(), data }
    }

    /// The covariance of what the first `first` columns leave of the others. One of the first whose pivot is under `least`
    /// times its variance is left out, since those before it explain it.
    pub(super) fn given(&self, first: usize, least: f64) -> Self {
        let w = self.width;
        let mut rest = self.data.clone();
        for k in 0..first {
            let pivot = rest[k * w + k];
            if pivot <= least * self.data[k * w + k] {
                continue;
            }
            for i in k + 1..w {
                let factor = rest[i * w + k] / pivot;
                for j in k + 1..w {
                    rest[i * w + j] -= factor * rest[k * w + j];
                }
            }
        }
        Self { width: w, data: rest }.block(first..w)
    }

    /// Cholesky decomposition. A column whose pivot is under `least` times its variance gets 0 and is left out of what
    /// follows.
    pub(super) fn cholesky(&self, least: f64) -> Cholesky {
        let w = self.width;
        let (mut lower, mut pivots) = (vec![0.0; w * w], vec![0.0; w]);
        for i in 0..w {
            for j in 0..i {
                if pivots[j] > 0.0 {
                    let known: f64 = (0..j).map(|k| lower[i * w + k] * lower[j * w + k]).sum();
                    lower[i * w + j] = (self.data[i * w + j] - known) / libm::sqrt(pivots[j]);
                }
            }
            let variance = self.data[i * w + i];
            let pivot = variance - (0..i).map(|k| lower[i * w + k] * lower[i * w + k]).sum::<f64>();
            pivots[i] = if pivot > least * variance { pivot } else { 0.0 };
        }
        Cholesky { lower, pivots }
    }
}

/// A covariance decomposed.
#[derive(Clone, Debug)]
pub(super) struct Cholesky {
    lower: Vec<f64>,
    /// Column i's variance that the columns before it do not explain; 0 for one that they explain entirely.
    pub(super) pivots: Vec<f64>,
}

impl Cholesky {
    /// ln of the determinant, columns that the others explain left out.
    pub(super) fn log_determinant(&self) -> f64 {
        self.pivots.iter().filter(|p| **p > 0.0).map(|&p| libm::log(p)).sum()
    }

    /// Squared Mahalanobis distance of a row from zero; `scratch` is overwritten.
    pub(super) fn distance(&self, row: &[f64], scratch: &mut Vec<f64>) -> f64 {
        let w = self.pivots.len();
        scratch.clear();
        let mut sum = 0.0;
        for i in 0..w {
            let known: f64 = self.lower[i * w..i * w + i].iter().zip(&*scratch).map(|(l, s)| l * s).sum();
            let pivot = self.pivots[i];
            let z = if pivot > 0.0 { (row[i] - known) / libm::sqrt(pivot) } else { 0.0 };
            scratch.push(z);
            sum += z * z;
        }
        sum
    }
}

impl Cholesky {
    /// What the first `first` values of a row do not explain of the others; `scratch` is overwritten.
    pub(super) fn unexplained<'a>(
        &'a self,
        row: &'a [f64],
        first: usize,
        scratch: &'a mut Vec<f64>,
    ) -> impl Iterator<Item = f64> + 'a {
        let w = self.pivots.len();
        self.distance(row, scratch);
        let scratch = &*scratch;
        (first..w).map(move |c| {
            let known: f64 = self.lower[c * w..c * w + first].iter().zip(scratch).map(|(l, s)| l * s).sum();
            row[c] - known
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pivots_multiply_to_the_determinant_and_find_dependent_columns() {
        let mut moments = Moments::new(3);
        for (a, b) in [(1.0, 2.0), (2.0, 1.0), (4.0, 5.0), (0.0, -3.0)] {
            moments.add_row(&[a, b, 2.0 * a - b]);
        }
        let c = moments.covariance();
        let whole = c.cholesky(1e-9);
        let pivots = &whole.pivots;
        let det = c.data[0] * c.data[4] - c.data[1] * c.data[3];
        assert!((pivots[0] * pivots[1] - det).abs() < 1e-9 * det);
        assert_eq!(pivots[2], 0.0);
        // S⁻¹ of the leading block by hand
        let (a, b) = (1.5, -2.0);
        let by_hand = (c.data[4] * a * a - 2.0 * c.data[1] * a * b + c.data[0] * b * b) / det;
        assert!((whole.distance(&[a, b, 9.0], &mut Vec::new()) - by_hand).abs() < 1e-9);
        assert_eq!(c.block(1..3).data[1], c.data[5]);
        // what a leaves of b and of 2a − b has the same variance, and is each other's opposite
        let left = c.given(1, 1e-9).data;
        assert!(
            (left[0] - pivots[1]).abs() < 1e-9 && (left[0] - left[3]).abs() < 1e-9 && (left[0] + left[1]).abs() < 1e-9
        );
        assert!(c.given(2, 1e-9).data[0].abs() < 1e-9);
        let mut less = moments.clone();
        let mut one = Moments::new(3);
        one.add_row(&[4.0, 5.0, 3.0]);
        less.add(&one, -1.0);
        assert_eq!(less.n, 3.0);
        assert!((less.covariance().data[0] - 1.0).abs() < 1e-12);
    }
}
