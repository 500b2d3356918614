//! Objectives of the neural estimators and of Du-MIE: pure functions on slices, values in, values and gradients out.
//!
//! `t` is a critic's score. sp is softplus, ln(1 + e^z). Per-sample values are what the trainer adds to a reward;
//! a loss is minus their mean. Sums run in f64, in a fixed order.

use std::f64::consts::{LN_2, TAU};

/// ln(1 + e^z), without overflow.
pub fn softplus(z: f32) -> f32 {
    z.max(0.0) + (-z.abs()).exp().ln_1p()
}

/// softplus and its slope, the logistic function, from one exponential.
fn softplus_slope(z: f32) -> (f32, f32) {
    let e = (-z.abs()).exp();
    (z.max(0.0) + e.ln_1p(), if z < 0.0 { e / (1.0 + e) } else { 1.0 / (1.0 + e) })
}

/// Shifted JSD lower bound per sample and the loss −mean v, with gradients.
///
/// `v_i` = \[ln 2 − `sp(−t_i)`\] − `mean_k` \[`sp(t_ik)` − ln 2\]; its mean is at most 2·JSD ≤ 2 ln 2 (subtract 2 ln 2 for the
/// value as the paper prints it). `positive` is `[n]`, `negative` `[n, k]`; writes `values` `[n]` and ∂loss/∂t.
pub fn jsd(
    positive: &[f32],
    negative: &[f32],
    values: &mut [f32],
    grad_positive: &mut [f32],
    grad_negative: &mut [f32],
) -> f64 {
    let (n, k) = (positive.len(), negatives_per_sample(positive.len(), negative.len()));
    let (scale, scale_negative) = (1.0 / n as f32, 1.0 / (n * k) as f32);
    let mut total = 0.0;
    for i in 0..n {
        let (up, slope) = softplus_slope(-positive[i]);
        grad_positive[i] = -scale * slope;
        let mut down = 0.0;
        for j in i * k..(i + 1) * k {
            let (sp, slope) = softplus_slope(negative[j]);
            down += f64::from(sp);
            grad_negative[j] = scale_negative * slope;
        }
        let value = 2.0 * LN_2 - f64::from(up) - down / k as f64;
        values[i] = value as f32;
        total += value;
    }
    -total / n as f64
}

/// The per-sample values of [`jsd`] alone; returns their mean.
pub fn jsd_values(positive: &[f32], negative: &[f32], values: &mut [f32]) -> f64 {
    let (n, k) = (positive.len(), negatives_per_sample(positive.len(), negative.len()));
    let mut total = 0.0;
    for i in 0..n {
        let down: f64 = negative[i * k..(i + 1) * k].iter().map(|&t| f64::from(softplus(t))).sum();
        let value = 2.0 * LN_2 - f64::from(softplus(-positive[i])) - down / k as f64;
        values[i] = value as f32;
        total += value;
    }
    total / n as f64
}

fn negatives_per_sample(n: usize, negatives: usize) -> usize {
    assert!(n > 0 && negatives >= n && negatives.is_multiple_of(n), "{negatives} negatives for {n} samples");
    negatives / n
}

/// vCLUB per sample: `Σ_d` −(`y_i` − `μ_i)²/2σ_i²` + `mean_k` `Σ_d` (`y_k` − `μ_i)²/2σ_i²`; returns the mean.
///
/// `mu`, `logvar` (ln σ²) and `y` are `[n, d]`; `negatives` `[n, k]` holds rows of `y`. The ln σ² terms cancel.
pub fn club_values(mu: &[f32], logvar: &[f32], y: &[f32], negatives: &[u32], values: &mut [f32]) -> f64 {
    let n = values.len();
    let (k, d) = (negatives_per_sample(n, negatives.len()), y.len() / n);
    let mut total = 0.0;
    for (i, value) in values.iter_mut().enumerate() {
        let (mu, logvar) = (&mu[i * d..(i + 1) * d], &logvar[i * d..(i + 1) * d]);
        let mut sum = 0.0;
        for c in 0..d {
            let square = |row: usize| (y[row * d + c] - mu[c]) * (y[row * d + c] - mu[c]);
            let others: f32 = negatives[i * k..(i + 1) * k].iter().map(|&j| square(j as usize)).sum();
            sum += f64::from(0.5 * (-logvar[c]).exp() * (others / k as f32 - square(i)));
        }
        *value = sum as f32;
        total += sum;
    }
    total / n as f64
}

/// Mean Gaussian −ln q(y|x) in nats, `Σ_d` ½\[(y − μ)²/σ² + ln σ² + ln 2π\], with its gradients: the loss that CLUB's q
/// learns by. All slices are `[n, d]`, `n` is the number of samples.
///
/// The parent code minimises `Σ_d` \[(μ − y)²/σ² + ln σ²\]: twice this, less a constant.
pub fn nll(mu: &[f32], logvar: &[f32], y: &[f32], n: usize, grad_mu: &mut [f32], grad_logvar: &mut [f32]) -> f64 {
    let scale = 1.0 / n as f32;
    let mut total = 0.0;
    // 1/σ² stands where its gradient will
    grad_logvar.iter_mut().zip(logvar).for_each(|(to, logvar)| *to = -logvar);
    crate::nn::exp_in_place(grad_logvar);
    for i in 0..y.len() {
        let (error, precision) = (mu[i] - y[i], grad_logvar[i]);
        let square = error * error * precision;
        grad_mu[i] = scale * error * precision;
        grad_logvar[i] = 0.5 * scale * (1.0 - square);
        total += f64::from(square + logvar[i]);
    }
    0.5 * (total / n as f64 + (y.len() / n) as f64 * libm::log(TAU))
}

/// ln q(y|x) in nats per sample, `[n]`, of the Gaussian of [`nll`].
pub fn log_density(mu: &[f32], logvar: &[f32], y: &[f32], values: &mut [f64]) {
    let d = y.len() / values.len();
    for (i, value) in values.iter_mut().enumerate() {
        *value = (i * d..(i + 1) * d).map(|j| log_normal(mu[j], logvar[j], y[j])).sum();
    }
}

/// ln of the normal density of mean `mu` and log-variance `logvar` at `y`, in nats.
pub fn log_normal(mu: f32, logvar: f32, y: f32) -> f64 {
    let (error, logvar) = (f64::from(mu) - f64::from(y), f64::from(logvar));
    -0.5 * (error * error * libm::exp(-logvar) + logvar + libm::log(TAU))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Seeds};

    /// Exact critic of a bivariate normal: ln p(x,y)/p(x)p(y).
    fn exact(rho: f64, x: f64, y: f64) -> f64 {
        let s = 1.0 - rho * rho;
        -0.5 * s.ln() - (rho * rho * (x * x + y * y) - 2.0 * rho * x * y) / (2.0 * s)
    }

    #[test]
    fn exact_critic_and_exact_q_give_the_values_of_the_bivariate_normal() {
        // rho, J (unshifted), CLUB: Monte Carlo over 4e6 draws, and ρ²/(1−ρ²)
        let table = [
            (0.1, -1.3838, 0.0101),
            (0.3, -1.3623, 0.0989),
            (0.5, -1.3123, 0.3333),
            (0.75, -1.1705, 1.2857),
            (0.9, -0.9576, 4.2632),
        ];
        let (n, k) = (200_000, 2);
        for (rho, j, club) in table {
            let mut rng = Seeds::new(1).stream("pairs");
            let x: Vec<f64> = (0..n).map(|_| rng::normal(&mut rng)).collect();
            let y: Vec<f64> = x.iter().map(|x| rho * x + (1.0 - rho * rho).sqrt() * rng::normal(&mut rng)).collect();
            let negatives = crate::mi::derangements(&mut rng, n, k);
            let positive: Vec<f32> = (0..n).map(|i| exact(rho, x[i], y[i]) as f32).collect();
            let negative: Vec<f32> =
                negatives.iter().enumerate().map(|(i, &j)| exact(rho, x[i / k], y[j as usize]) as f32).collect();
            let mut values = vec![0.0; n];
            let shifted = jsd_values(&positive, &negative, &mut values);
            let standard_error = |v: &[f32]| {
                let mean = v.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64;
                (v.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>()).sqrt() / n as f64
            };
            let tolerance = 4.0 * standard_error(&values) + 1e-4;
            assert!((shifted - 2.0 * LN_2 - j).abs() < tolerance, "J at {rho}: {}", shifted - 2.0 * LN_2);
            let mu: Vec<f32> = x.iter().map(|x| (rho * x) as f32).collect();
            let logvar = vec![(1.0 - rho * rho).ln() as f32; n];
            let y: Vec<f32> = y.iter().map(|&y| y as f32).collect();
            let found = club_values(&mu, &logvar, &y, &negatives, &mut values);
            assert!((found - club).abs() < 4.0 * standard_error(&values) + 1e-4, "CLUB at {rho}: {found}");
        }
    }

    #[test]
    fn jsd_gradients_are_the_slope_of_the_loss_and_values_agree() {
        let mut rng = Seeds::new(2).stream("t");
        let mut draw = |n: usize| (0..n).map(|_| 2.0 * rng::normal(&mut rng) as f32).collect::<Vec<_>>();
        let (positive, negative) = (draw(5), draw(15));
        let mut buffers = [vec![0.0; 5], vec![0.0; 5], vec![0.0; 15]];
        let [values, gp, gn] = &mut buffers;
        let loss = jsd(&positive, &negative, values, gp, gn);
        let mut again = vec![0.0; 5];
        assert!((jsd_values(&positive, &negative, &mut again) + loss).abs() < 1e-12);
        assert_eq!(*values, again);
        let h = 1e-2;
        for i in 0..20 {
            let at = |h: f32| {
                let (mut p, mut q) = (positive.clone(), negative.clone());
                if i < 5 {
                    p[i] += h;
                } else {
                    q[i - 5] += h;
                }
                -jsd_values(&p, &q, &mut [0.0; 5])
            };
            let slope = (at(h) - at(-h)) / (2.0 * f64::from(h));
            let found = if i < 5 { gp[i] } else { gn[i - 5] };
            assert!((slope - f64::from(found)).abs() < 1e-5, "{i}: {slope} against {found}");
        }
    }

    #[test]
    fn extreme_scores_stay_finite() {
        let mut buffers = [vec![0.0; 2], vec![0.0; 2], vec![0.0; 2]];
        let [values, gp, gn] = &mut buffers;
        let loss = jsd(&[200.0, -200.0], &[-200.0, 200.0], values, gp, gn);
        assert!((loss - (200.0 - 2.0 * LN_2)).abs() < 1e-5, "{loss}");
        assert_eq!((gp[0], gp[1], gn[0], gn[1]), (0.0, -0.5, 0.0, 0.5));
    }

    #[test]
    fn nll_is_the_gaussian_log_density_and_its_gradients_its_slopes() {
        let (mu, logvar, y) = ([0.5, -1.0, 0.0, 2.0], [0.0, 1.0, -1.0, 0.3], [1.0, 0.0, 0.2, 2.0]);
        let mut grads = [[0.0; 4]; 2];
        let [gm, gl] = &mut grads;
        let loss = nll(&mu, &logvar, &y, 2, gm, gl);
        let mut values = [0.0; 2];
        log_density(&mu, &logvar, &y, &mut values);
        assert!((loss + f64::midpoint(values[0], values[1])).abs() < 1e-6);
        // N(1; 0.5, 1) and N(0; −1, e) by hand
        let by_hand = -0.5 * (0.25 + TAU.ln()) - 0.5 * ((-1.0f64).exp() + 1.0 + TAU.ln());
        assert!((values[0] - by_hand).abs() < 1e-6);
        for i in 0..4 {
            let at = |h: f32, which: usize| {
                let (mut m, mut l) = (mu, logvar);
                if which == 0 {
                    m[i] += h;
                } else {
                    l[i] += h;
                }
                nll(&m, &l, &y, 2, &mut [0.0; 4], &mut [0.0; 4])
            };
            for (which, found) in [(0, gm[i]), (1, gl[i])] {
                let slope = (at(1e-2, which) - at(-1e-2, which)) / 2e-2;
                assert!((slope - f64::from(found)).abs() < 1e-4, "{i}: {slope} against {found}");
            }
        }
    }
}
