//! Adam (Kingma & Ba 2015, `PyTorch`'s defaults), gradient clipping and the soft target update, in one pass.
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use serde::{Deserialize, Serialize};

use super::simd::{LANES, Level, Operation, Simd};

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
        self.step_and_follow(params, grads, &mut [], 0.0);
    }

    /// [`Self::step`], after which `target` moves towards the parameters: `target ← (1 − tau) target + tau params`.
    /// An empty target is none.
    ///
    /// # Panics
    /// When a slice has not one element per parameter.
    pub fn step_and_follow(&mut self, params: &mut [f32], grads: &[f32], target: &mut [f32], tau: f32) {
        self.t += 1;
        let AdamConfig { learning_rate, beta1, beta2, .. } = self.config;
        let power = self.t as f64;
        let correct1 = 1.0 - libm::pow(f64::from(beta1), power);
        let root2 = libm::sqrt(1.0 - libm::pow(f64::from(beta2), power)) as f32;
        let size = (f64::from(learning_rate) / correct1) as f32;
        let Self { config, m, v, .. } = self;
        Level::best().run(Step { config: *config, size, root2, tau, params, grads, m, v, target });
    }
}

/// One step over all parameters.
struct Step<'a> {
    config: AdamConfig,
    size: f32,
    root2: f32,
    tau: f32,
    params: &'a mut [f32],
    grads: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
    target: &'a mut [f32],
}

/// Slices of one group of parameters.
struct Group<'a> {
    p: &'a mut [f32],
    g: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
    t: &'a mut [f32],
}

impl Step<'_> {
    /// One vector of parameters.
    #[inline(always)]
    fn vector<S: Simd>(&self, s: S, Group { p, g, m, v, t }: Group<'_>) {
        let AdamConfig { beta1, beta2, epsilon, .. } = self.config;
        let g = s.load(g);
        let first = s.add(s.mul(s.splat(beta1), s.load(m)), s.mul(s.splat(1.0 - beta1), g));
        let second = s.add(s.mul(s.splat(beta2), s.load(v)), s.mul(s.splat(1.0 - beta2), s.mul(g, g)));
        s.store(m, first);
        s.store(v, second);
        let root = s.add(s.div(s.sqrt(second), s.splat(self.root2)), s.splat(epsilon));
        let new = s.sub(s.load(p), s.div(s.mul(s.splat(self.size), first), root));
        s.store(p, new);
        if !t.is_empty() {
            let old = s.load(t);
            s.store(t, s.fma(s.splat(self.tau), s.sub(new, old), old));
        }
    }
}

impl Operation for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) {
        let n = self.params.len();
        assert!([self.grads.len(), self.m.len(), self.v.len()] == [n; 3]);
        assert!(self.target.is_empty() || self.target.len() == n);
        let [params, m, v, target] = [&mut self.params, &mut self.m, &mut self.v, &mut self.target].map(std::mem::take);
        let follows = !target.is_empty();
        let whole = n - n % S::WIDTH;
        for at in (0..whole).step_by(S::WIDTH) {
            let range = at..at + S::WIDTH;
            let t = if follows { &mut target[range.clone()] } else { &mut [] };
            let (p, m, v) = (&mut params[range.clone()], &mut m[range.clone()], &mut v[range.clone()]);
            self.vector(s, Group { p, g: &self.grads[range], m, v, t });
        }
        // the tail goes through padded copies
        let rest = whole..n;
        let copy = |from: &[f32]| {
            let mut lanes = [0.0; LANES];
            lanes[..from.len()].copy_from_slice(from);
            lanes
        };
        let (mut p, g) = (copy(&params[rest.clone()]), copy(&self.grads[rest.clone()]));
        let (mut pm, mut pv) = (copy(&m[rest.clone()]), copy(&v[rest.clone()]));
        let mut pt = copy(if follows { &target[rest.clone()] } else { &[] });
        self.vector(s, Group { p: &mut p, g: &g, m: &mut pm, v: &mut pv, t: &mut pt });
        params[rest.clone()].copy_from_slice(&p[..rest.len()]);
        m[rest.clone()].copy_from_slice(&pm[..rest.len()]);
        v[rest.clone()].copy_from_slice(&pv[..rest.len()]);
        if follows {
            target[rest.clone()].copy_from_slice(&pt[..rest.len()]);
        }
    }
}

/// Scales `grads` so that their L2 norm is at most `limit`; returns the norm before.
pub fn clip_norm(grads: &mut [f32], limit: f32) -> f32 {
    // four running sums: one would wait for each addition before the next
    let (fours, rest) = grads.as_chunks::<4>();
    let mut sums = [0.0f64; 4];
    for four in fours {
        (0..4).for_each(|i| sums[i] += f64::from(four[i]) * f64::from(four[i]));
    }
    let rest: f64 = rest.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
    let norm = (sums.iter().sum::<f64>() + rest).sqrt() as f32;
    if norm > limit {
        let scale = limit / (norm + 1e-6);
        for g in grads.iter_mut() {
            *g *= scale;
        }
    }
    norm
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
    fn every_instruction_set_takes_the_step_of_the_definition_and_moves_the_target() {
        let n = 37;
        let of = |k: usize| (0..n).map(|i| ((i * k) % 23) as f32 / 11.0 - 1.0).collect::<Vec<_>>();
        for level in Level::available() {
            let mut adam = Adam::new(AdamConfig::new(0.01), n);
            (adam.m, adam.v) = (of(5), of(7).iter().map(|v| v * v).collect());
            let (mut params, grads, mut target) = (of(3), of(11), of(13));
            let before = (adam.clone(), params.clone(), target.clone());
            let Adam { config, m, v, .. } = &mut adam;
            let (params_of, target_of) = (&mut params, &mut target);
            level.run(Step {
                config: *config,
                size: 0.1,
                root2: 0.5,
                tau: 0.25,
                params: params_of,
                grads: &grads,
                m,
                v,
                target: target_of,
            });
            for i in 0..n {
                let g = f64::from(grads[i]);
                let [b1, b2] = [0.9f32, 0.999].map(|b| [f64::from(b), f64::from(1.0 - b)]);
                let m = b1[0] * f64::from(before.0.m[i]) + b1[1] * g;
                let v = b2[0] * f64::from(before.0.v[i]) + b2[1] * g * g;
                let p = f64::from(before.1[i]) - 0.1 * m / (v.sqrt() / 0.5 + 1e-8);
                let t = 0.75 * f64::from(before.2[i]) + 0.25 * p;
                for (found, exact) in [(adam.m[i], m), (adam.v[i], v), (params[i], p), (target[i], t)] {
                    assert!((f64::from(found) - exact).abs() < 2e-6 * (1.0 + exact.abs()), "{i} {level:?}");
                }
            }
        }
    }

    #[test]
    fn clipping_keeps_the_direction_and_bounds_the_norm() {
        let mut g = [3.0, 4.0];
        assert_eq!(clip_norm(&mut g, 0.5), 5.0);
        assert!((g[0] / g[1] - 0.75).abs() < 1e-6 && (g[0].hypot(g[1]) - 0.5).abs() < 1e-6);
        let mut small = [0.1, 0.1];
        clip_norm(&mut small, 0.5);
        assert_eq!(small, [0.1, 0.1]);
        let mut long = [1.0; 11];
        assert!((clip_norm(&mut long, f32::INFINITY) - 11.0f32.sqrt()).abs() < 1e-6);
    }
}
