//! Which rows of y stand for "independent of x": product samples by derangement.

use rand::Rng;

use crate::rng;

/// `k` derangements of `n` rows as indices `[n, k]`: row i never gets itself (unless `n` is 1), and every row serves
/// equally often.
pub fn derangements<R: Rng + ?Sized>(rng: &mut R, n: usize, k: usize) -> Vec<u32> {
    let mut out = vec![0; n * k];
    for j in 0..k {
        for (i, other) in rng::derangement(rng, n).into_iter().enumerate() {
            out[i * k + j] = other as u32;
        }
    }
    out
}

/// All other rows, `[n, n − 1]`, in order: the parent code's n × n negatives without the diagonal.
pub fn all_others(n: usize) -> Vec<u32> {
    (0..n as u32).flat_map(|i| (0..n as u32).filter(move |&j| j != i)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;

    #[test]
    fn derangements_avoid_the_row_itself_and_use_every_row_equally() {
        let (n, k) = (37, 16);
        let negatives = derangements(&mut Seeds::new(1).stream("d"), n, k);
        assert!((0..n * k).all(|at| negatives[at] as usize != at / k));
        assert!((0..n as u32).all(|row| negatives.iter().filter(|&&j| j == row).count() == k));
        assert_eq!(all_others(3), [1, 2, 0, 2, 0, 1]);
    }
}
