//! Information given z: what z leaves of x and y, and a null test that keeps z.

use std::sync::Arc;

use rand::Rng;

use super::MiError;
use super::knn::{Points, Tree};
use super::linear::Moments;
use super::prepare::scales;
use crate::rng;
use crate::schema::{Columns, Samples};

/// Unexplained share of a column's variance under which z determines it.
const DETERMINED: f64 = 1e-10;

/// Samples whose x and y are what a linear regression on z leaves of them, without z, and how many columns z has;
/// the samples themselves when there is no z.
pub(super) fn residuals(samples: &Samples, warnings: &mut Vec<String>) -> Result<(Samples, usize), MiError> {
    let Some(z) = &samples.z else { return Ok((samples.clone(), 0)) };
    let label = samples.labels.given.clone().unwrap_or_default();
    let of_z = scales(z, &samples.rows, &label, warnings)?;
    let one = |columns: &Columns, label: &str, warnings: &mut Vec<String>| -> Result<Arc<Columns>, MiError> {
        let own = scales(columns, &samples.rows, label, warnings)?;
        let (first, width) = (of_z.len(), of_z.len() + own.len());
        let fill = |r: usize, row: &mut Vec<f64>| {
            row.clear();
            row.extend(of_z.iter().map(|s| s.of(z.row(r))));
            row.extend(own.iter().map(|s| s.of(columns.row(r))));
        };
        let (mut moments, mut row) = (Moments::new(width), Vec::with_capacity(width));
        for &r in &samples.rows {
            fill(r as usize, &mut row);
            moments.add_row(&row);
        }
        let decomposed = moments.covariance().cholesky(0.0);
        let alone = (0..own.len()).map(|c| {
            let of_z_and_c: Vec<usize> = (0..first).chain([first + c]).collect();
            moments.covariance().picked(&of_z_and_c).cholesky(DETERMINED).pivots[first] > 0.0
        });
        let left: Vec<bool> = alone.collect();
        if !left.contains(&true) {
            return Err(MiError::Constant { column: format!("what {} leaves of {label}", given_label(samples)) });
        }
        let (mut data, mut scratch) = (Vec::with_capacity(columns.rows() * own.len()), Vec::new());
        for r in 0..columns.rows() {
            fill(r, &mut row);
            let rest = decomposed.unexplained(&row, first, &mut scratch);
            data.extend(rest.zip(&left).map(|(v, &left)| if left { v } else { 0.0 }));
        }
        let names = own.iter().map(|s| columns.names[s.column].clone()).collect();
        Ok(Arc::new(Columns::new(data, names)))
    };
    let x = one(&samples.x, &samples.labels.x, warnings)?;
    let y = one(&samples.y, &samples.labels.y, warnings)?;
    Ok((Samples { x, y, z: None, ..samples.clone() }, of_z.len()))
}

fn given_label(samples: &Samples) -> &str {
    samples.labels.given.as_deref().unwrap_or_default()
}

/// Points put into cells of at most sixteen neighbours in z; equal points may stand in several.
pub(super) fn cells(z: &Points) -> Vec<Vec<u32>> {
    Tree::new(z).cells().map(<[u32]>::to_vec).collect()
}

/// A permutation of `0..n` that leaves every number in its cell.
pub(super) fn permuted_within<R: Rng + ?Sized>(cells: &[Vec<u32>], n: usize, rng: &mut R) -> Vec<u32> {
    let mut out = vec![0; n];
    for cell in cells {
        let order = rng::permutation(rng, cell.len());
        cell.iter().zip(order).for_each(|(&to, from)| out[to as usize] = cell[from]);
    }
    out
}

/// Most columns of z in which neighbours are near enough to be exchanged: in eight, independent normals beside one z were
/// called dependent at 5 % in two of three sets of 400; in three, as often as they should.
const NARROW: usize = 3;

/// Why neighbours in `width` columns of z cannot be exchanged, if so.
pub(super) fn too_wide(width: usize) -> Option<String> {
    (width > NARROW).then(|| {
        format!(
            "no p-value: given z, neighbours in z are exchanged, and in {width} columns they are not alike; gcmi takes \
             more than {NARROW}"
        )
    })
}

/// Said when samples of one episode depend on each other, so that none can be exchanged with its neighbours in z.
pub(super) const NO_NULL: &str =
    "no p-value: given z, samples are exchanged one by one, and here they stand in episodes";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::{linear_samples, samples_of};
    use crate::rng::Seeds;

    #[test]
    fn residuals_do_not_correlate_with_z_and_keep_what_is_left() {
        let base = linear_samples(0.5, 500, 2, 1);
        let z: Vec<Vec<f64>> = (0..500).map(|r| vec![base.x.row(r)[0] + base.y.row(r)[1], base.x.row(r)[1]]).collect();
        let mut samples = base;
        samples.z = Some(samples_of(&z, &z).x);
        let (rest, width) = residuals(&samples, &mut Vec::new()).unwrap();
        assert_eq!((width, rest.z.is_none(), rest.y.width()), (2, true, 2));
        for columns in [&rest.x, &rest.y] {
            for c in 0..2 {
                for d in 0..2 {
                    let dot: f64 = (0..500).map(|r| columns.row(r)[c] * z[r][d]).sum();
                    assert!(dot.abs() < 1e-7, "{c} {d}: {dot}");
                }
            }
        }
        // x1 is z1: nothing is left of it
        assert!((0..500).all(|r| rest.x.row(r)[1] == 0.0 && rest.x.row(r)[0] != 0.0));
        samples.z = Some(Arc::clone(&samples.x));
        samples.labels.given = Some("z".to_owned());
        let none = residuals(&samples, &mut Vec::new()).unwrap_err().to_string();
        assert!(none.starts_with("what z leaves of x is constant"), "{none}");
    }

    #[test]
    fn permutations_stay_within_cells_of_neighbours() {
        let z = Points { data: (0..100).map(f64::from).collect(), width: 1 };
        let cells = cells(&z);
        let found = permuted_within(&cells, 100, &mut Seeds::new(1).stream("p"));
        let mut sorted = found.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..100).collect::<Vec<u32>>());
        assert!(found.iter().enumerate().all(|(to, &from)| (to as f64 - f64::from(from)).abs() < 16.0));
        assert!(found.iter().enumerate().filter(|(to, from)| *to != **from as usize).count() > 70);
    }
}
