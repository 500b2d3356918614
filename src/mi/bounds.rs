//! Variational objectives on a critic's scores: values, and losses with gradients.
//!
//! `t_i` is the score of pair i, `t_ik` that of `x_i` with its k-th negative. Slices are `[n]` and `[n, k]`. Sums run in
//! f64, in a fixed order.

use super::losses;

/// Scores above this count as this in an exponential that a gradient contains: `f32` ends at 88.
const STEEP: f32 = 30.0;
/// How slowly the mean of e^t that MINE divides by follows the minibatches.
const MEMORY: f64 = 0.99;

/// What a critic is trained by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Objective {
    /// mean \[`t_i` − ln (e^`t_i` + Σ e^`t_ik`)/(k + 1)\].
    InfoNce,
    /// mean `t_i` + 1 − mean e^`t_ik`.
    Nwj,
    /// mean `t_i` − ln mean e^`t_ik`, with a running mean in the gradient.
    DonskerVaradhan {
        /// The running mean; 0 before the first minibatch.
        running: f64,
    },
    /// 2·JSD, as `jsd`.
    JensenShannon,
}

impl Objective {
    /// The value, which training maximises.
    pub(super) fn value(self, positive: &[f32], negative: &[f32]) -> f64 {
        let n = positive.len() as f64;
        let mean = positive.iter().map(|&t| f64::from(t)).sum::<f64>() / n;
        let exponential = || negative.iter().map(|&t| libm::exp(f64::from(t))).sum::<f64>() / negative.len() as f64;
        match self {
            Self::InfoNce => {
                let k = negative.len() / positive.len();
                let rows = positive.iter().zip(negative.chunks_exact(k));
                rows.map(|(&own, others)| infonce(own, others)).sum::<f64>() / n
            }
            Self::Nwj => mean + 1.0 - exponential(),
            Self::DonskerVaradhan { .. } => mean - libm::log(exponential()),
            Self::JensenShannon => losses::jsd_values(positive, negative, &mut vec![0.0; positive.len()]),
        }
    }

    /// The loss, which is minus the value; writes its gradients.
    pub(super) fn loss(
        &mut self,
        positive: &[f32],
        negative: &[f32],
        grad_positive: &mut [f32],
        grad_negative: &mut [f32],
    ) -> f64 {
        let scale = 1.0 / positive.len() as f32;
        let steep = |t: f32| t.min(STEEP).exp();
        let share = 1.0 / negative.len() as f32;
        match self {
            Self::InfoNce => {
                let k = negative.len() / positive.len();
                for (i, (&own, others)) in positive.iter().zip(negative.chunks_exact(k)).enumerate() {
                    let most = others.iter().fold(own, |a, &b| a.max(b));
                    let grads = &mut grad_negative[i * k..(i + 1) * k];
                    grads.iter_mut().zip(others).for_each(|(g, t)| *g = (t - most).exp());
                    let own = (own - most).exp();
                    let total = own + grads.iter().sum::<f32>();
                    for grad in grads {
                        *grad *= scale / total;
                    }
                    grad_positive[i] = -scale * (1.0 - own / total);
                }
            }
            Self::Nwj => {
                grad_positive.fill(-scale);
                grad_negative.iter_mut().zip(negative).for_each(|(g, &t)| *g = share * steep(t));
            }
            Self::DonskerVaradhan { running } => {
                let now = f64::from(share) * negative.iter().map(|&t| f64::from(steep(t))).sum::<f64>();
                *running = if *running > 0.0 { MEMORY * *running + (1.0 - MEMORY) * now } else { now };
                let divided = share / *running as f32;
                grad_positive.fill(-scale);
                grad_negative.iter_mut().zip(negative).for_each(|(g, &t)| *g = divided * steep(t));
            }
            Self::JensenShannon => {
                let mut values = vec![0.0; positive.len()];
                return losses::jsd(positive, negative, &mut values, grad_positive, grad_negative);
            }
        }
        -self.value(positive, negative)
    }
}

/// `t_i` − ln (e^`t_i` + Σ e^`t_ik`)/(k + 1): at most ln (k + 1).
pub(super) fn infonce(own: f32, others: &[f32]) -> f64 {
    let most = f64::from(others.iter().fold(own, |a, &b| a.max(b)));
    let own = f64::from(own);
    let sum: f64 = others.iter().map(|&t| libm::exp(f64::from(t) - most)).sum();
    own - most - libm::log((libm::exp(own - most) + sum) / (others.len() + 1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{self, Seeds};

    const ALL: [Objective; 4] =
        [Objective::InfoNce, Objective::Nwj, Objective::DonskerVaradhan { running: 0.0 }, Objective::JensenShannon];

    #[test]
    fn gradients_are_slopes_of_the_loss() {
        let mut rng = Seeds::new(1).stream("t");
        let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
        let scores = [draw(6), draw(24)];
        for objective in ALL {
            let [mut gp, mut gn] = [vec![0.0; 6], vec![0.0; 24]];
            let loss = { objective }.loss(&scores[0], &scores[1], &mut gp, &mut gn);
            assert!((loss + objective.value(&scores[0], &scores[1])).abs() < 1e-6);
            for (part, i) in (0..30).map(|i| if i < 6 { (0, i) } else { (1, i - 6) }) {
                let at = |h: f32| {
                    let mut moved = scores.clone();
                    moved[part][i] += h;
                    -objective.value(&moved[0], &moved[1])
                };
                let slope = (at(1e-2) - at(-1e-2)) / 2e-2;
                let found = [&gp, &gn][part][i];
                assert!((slope - f64::from(found)).abs() < 1e-4, "{objective:?} {part} {i}: {slope} against {found}");
            }
        }
    }

    #[test]
    fn scores_of_zero_are_worth_nothing_and_huge_ones_stay_finite() {
        for mut objective in ALL {
            assert!(objective.value(&[0.0; 3], &[0.0; 12]).abs() < 1e-7);
            let (mut gp, mut gn) = ([0.0; 2], [0.0; 2]);
            objective.loss(&[300.0, -300.0], &[300.0, -300.0], &mut gp, &mut gn);
            assert!(gp.iter().chain(&gn).all(|g| g.is_finite()), "{objective:?}: {gp:?} {gn:?}");
        }
        assert!((infonce(500.0, &[-500.0; 63]) - 64f64.ln()).abs() < 1e-12);
    }

    #[test]
    fn exact_scores_of_the_bivariate_normal_have_its_information() {
        let (rho, n, k): (f64, usize, usize) = (0.75, 100_000, 8);
        let s = 1.0 - rho * rho;
        let exact =
            |x: f64, y: f64| (-0.5 * s.ln() - (rho * rho * (x * x + y * y) - 2.0 * rho * x * y) / (2.0 * s)) as f32;
        let mut rng = Seeds::new(3).stream("pairs");
        let x: Vec<f64> = (0..n).map(|_| rng::normal(&mut rng)).collect();
        let y: Vec<f64> = x.iter().map(|x| rho * x + s.sqrt() * rng::normal(&mut rng)).collect();
        let negatives = crate::mi::derangements(&mut rng, n, k);
        let positive: Vec<f32> = x.iter().zip(&y).map(|(&x, &y)| exact(x, y)).collect();
        let negative: Vec<f32> = negatives.iter().enumerate().map(|(at, &j)| exact(x[at / k], y[j as usize])).collect();
        // −½ ln(1 − ρ²) = 0.41334; standard errors are about 0.003
        for objective in [Objective::Nwj, Objective::DonskerVaradhan { running: 0.0 }] {
            let found = objective.value(&positive, &negative);
            assert!((found - 0.41334).abs() < 0.012, "{objective:?}: {found}");
        }
        let found = Objective::InfoNce.value(&positive, &negative);
        assert!(found < 0.41334 && found > 0.35, "{found}");
    }
}
