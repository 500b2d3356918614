//! A Gaussian q(y|x) with a diagonal covariance: what CLUB and the leave-one-out bound need.

use rand::Rng;

use crate::nn::{Activation, Mlp, Tape};

/// q(y|x) = N(μ(x), diag e^{logvar(x)}), two perceptrons.
///
/// Its parameters are one flat vector: those of `mu`, then those of `logvar`.
#[derive(Clone, Debug, PartialEq)]
pub struct GaussianConditional {
    /// Mean.
    pub mu: Mlp,
    /// Log-variance before scaling, in (−1, 1): its output is tanh.
    pub logvar: Mlp,
    /// Log-variances are within ± this.
    pub range: f32,
}

/// What a forward pass leaves for the backward pass; reused.
#[derive(Clone, Debug, Default)]
pub struct ConditionalTape {
    mu: Tape,
    logvar: Tape,
    scaled: Vec<f32>,
    grad: Vec<f32>,
}

impl ConditionalTape {
    /// Means, `[n, d]`.
    pub fn mu(&self) -> &[f32] {
        self.mu.output()
    }

    /// Log-variances, `[n, d]`.
    pub fn logvar(&self) -> &[f32] {
        &self.scaled
    }
}

impl GaussianConditional {
    /// The parent code's networks: one hidden `ReLU` layer of 32 each, log-variance in (−1, 1).
    pub fn paper(x_width: usize, y_width: usize) -> Self {
        Self::new(&[x_width, 32, y_width], 1.0)
    }

    /// The networks of `estimate-mi`: two hidden `ReLU` layers of 64 each, log-variance in (−10, 10).
    pub fn deep(x_width: usize, y_width: usize) -> Self {
        Self::new(&[x_width, 64, 64, y_width], 10.0)
    }

    fn new(widths: &[usize], range: f32) -> Self {
        let mu = Mlp::new(widths, Activation::Relu, Activation::Identity);
        Self { mu, logvar: Mlp::new(widths, Activation::Relu, Activation::Tanh), range }
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.mu.parameters() + self.logvar.parameters()
    }

    /// Appends fresh parameters.
    pub fn init<R: Rng + ?Sized>(&self, rng: &mut R, out: &mut Vec<f32>) {
        self.mu.init(rng, out);
        self.logvar.init(rng, out);
    }

    /// Means and log-variances for `x` `[n, x]`; they stay in the tape.
    pub fn forward(&self, params: &[f32], x: &[f32], n: usize, tape: &mut ConditionalTape) {
        let (p_mu, p_logvar) = params.split_at(self.mu.parameters());
        self.mu.forward(p_mu, x, n, &mut tape.mu);
        let logvar = self.logvar.forward(p_logvar, x, n, &mut tape.logvar);
        tape.scaled.clear();
        tape.scaled.extend(logvar.iter().map(|v| v * self.range));
    }

    /// Backward pass of the last [`Self::forward`]: adds ∂L/∂params to `grads`, given ∂L/∂μ and ∂L/∂logvar `[n, d]`.
    pub fn backward(
        &self,
        params: &[f32],
        x: &[f32],
        tape: &mut ConditionalTape,
        grad_mu: &[f32],
        grad_logvar: &[f32],
        grads: &mut [f32],
    ) {
        let (p_mu, p_logvar) = params.split_at(self.mu.parameters());
        let (g_mu, g_logvar) = grads.split_at_mut(self.mu.parameters());
        self.mu.backward(p_mu, x, &mut tape.mu, grad_mu, g_mu, None);
        tape.grad.clear();
        tape.grad.extend(grad_logvar.iter().map(|g| g * self.range));
        self.logvar.backward(p_logvar, x, &mut tape.logvar, &tape.grad, g_logvar, None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::losses;
    use crate::rng::{self, Seeds};

    fn loss(q: &GaussianConditional, params: &[f32], x: &[f32], y: &[f32], grads: &mut [f32]) -> f64 {
        let n = x.len() / q.mu.inputs();
        let mut tape = ConditionalTape::default();
        q.forward(params, x, n, &mut tape);
        let (mut gm, mut gl) = (vec![0.0; y.len()], vec![0.0; y.len()]);
        let loss = losses::nll(tape.mu(), tape.logvar(), y, n, &mut gm, &mut gl);
        q.backward(params, x, &mut tape, &gm, &gl, grads);
        loss
    }

    #[test]
    fn gradients_equal_finite_differences() {
        for (q, seed) in [(GaussianConditional::paper(4, 2), 1), (GaussianConditional::deep(4, 2), 2)] {
            let mut rng = Seeds::new(seed).stream("q");
            let mut params = Vec::new();
            q.init(&mut rng, &mut params);
            assert_eq!(params.len(), q.parameters());
            let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
            let (x, y) = (draw(200), draw(100));
            let mut grads = vec![0.0; params.len()];
            loss(&q, &params, &x, &y, &mut grads);
            // separately for the two networks: along its gradient the loss falls as fast as the gradient is long
            for part in [0..q.mu.parameters(), q.mu.parameters()..params.len()] {
                let square: f64 = grads[part.clone()].iter().map(|&g| f64::from(g) * f64::from(g)).sum();
                let h = 1e-2 / square.sqrt();
                let at = |h: f64| {
                    let mut moved = params.clone();
                    part.clone().for_each(|i| moved[i] += (h * f64::from(grads[i])) as f32);
                    loss(&q, &moved, &x, &y, &mut vec![0.0; params.len()])
                };
                let slope = (at(h) - at(-h)) / (2.0 * h);
                assert!((slope / square - 1.0).abs() < 1e-2, "{slope} against {square}");
            }
        }
    }

    #[test]
    fn the_papers_log_variance_stays_within_one_and_the_deep_one_within_ten() {
        for (q, limit) in [(GaussianConditional::paper(1, 1), 1.0), (GaussianConditional::deep(1, 1), 10.0)] {
            let params = vec![5.0; q.parameters()];
            let mut tape = ConditionalTape::default();
            q.forward(&params, &[1e3, -1e3], 2, &mut tape);
            assert!(tape.logvar().iter().all(|v| v.abs() <= limit));
            assert!(tape.logvar()[0] > 0.999_999 * limit);
        }
    }
}
