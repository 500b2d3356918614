//! Adam (Kingma & Ba 2015, `PyTorch`'s defaults), gradient clipping and the soft target update.

use serde::{Deserialize, Serialize};

/// Adam's constants.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AdamConfig {
    /// Learning rate.
    pub learning_rate: f32,
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
}

impl AdamConfig {
    /// `PyTorch`'s defaults at this learning rate.
    pub fn new(learning_rate: f32) -> Self {
        Self { learning_rate, beta1: 0.9, beta2: 0.999, epsilon: 1e-8 }
    }
}

/// Adam's state over one flat parameter vector.
#[derive(Clone, Debug, PartialEq)]
pub struct Adam {
    /// Constants.
    pub config: AdamConfig,
    /// First moments, one per parameter.
    pub m: Vec<f32>,
    /// Second moments, one per parameter.
    pub v: Vec<f32>,
    /// Steps taken.
    pub t: u64,
}

impl Adam {
    /// A fresh state for `parameters` parameters.
    pub fn new(config: AdamConfig, parameters: usize) -> Self {
        Self { config, m: vec![0.0; parameters], v: vec![0.0; parameters], t: 0 }
    }

    /// One step down the gradient, in place.
    pub fn step(&mut self, params: &mut [f32], grads: &[f32]) {
        self.t += 1;
        let AdamConfig { learning_rate, beta1, beta2, epsilon } = self.config;
        let power = self.t as f64;
        let correct1 = 1.0 - libm::pow(f64::from(beta1), power);
        let root2 = libm::sqrt(1.0 - libm::pow(f64::from(beta2), power)) as f32;
        let step = (f64::from(learning_rate) / correct1) as f32;
        for (((p, g), m), v) in params.iter_mut().zip(grads).zip(&mut self.m).zip(&mut self.v) {
            *m = beta1 * *m + (1.0 - beta1) * g;
            *v = beta2 * *v + (1.0 - beta2) * g * g;
            *p -= step * *m / (v.sqrt() / root2 + epsilon);
        }
    }
}

/// Scales `grads` so that their L2 norm is at most `limit`; returns the norm before.
pub fn clip_norm(grads: &mut [f32], limit: f32) -> f32 {
    let norm = grads.iter().map(|&g| f64::from(g) * f64::from(g)).sum::<f64>().sqrt() as f32;
    if norm > limit {
        let scale = limit / (norm + 1e-6);
        for g in grads.iter_mut() {
            *g *= scale;
        }
    }
    norm
}

/// `target ← (1 − tau) target + tau source`.
pub fn soft_update(target: &mut [f32], source: &[f32], tau: f32) {
    target.iter_mut().zip(source).for_each(|(t, s)| *t += tau * (s - *t));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_steps_match_pytorch() {
        // torch.optim.Adam(lr=0.1) on p = 1, gradients 2 then -1: by hand from its definition in float64
        let mut adam = Adam::new(AdamConfig::new(0.1), 1);
        let mut p = [1.0f32];
        adam.step(&mut p, &[2.0]);
        assert!((p[0] - 0.9).abs() < 1e-6);
        adam.step(&mut p, &[-1.0]);
        // m = .08, m̂ = .08/.19; v = .004996, v̂ = .004996/.001999
        let expected = 0.9 - 0.1 * (0.08 / 0.19) / ((0.004996f64 / 0.001999).sqrt() + 1e-8);
        assert!((f64::from(p[0]) - expected).abs() < 1e-6);
    }

    #[test]
    fn clipping_keeps_the_direction_and_bounds_the_norm() {
        let mut g = [3.0, 4.0];
        assert_eq!(clip_norm(&mut g, 0.5), 5.0);
        assert!((g[0] / g[1] - 0.75).abs() < 1e-6 && (g[0].hypot(g[1]) - 0.5).abs() < 1e-6);
        let mut small = [0.1, 0.1];
        clip_norm(&mut small, 0.5);
        assert_eq!(small, [0.1, 0.1]);
    }
}
