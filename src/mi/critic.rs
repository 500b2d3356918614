//! Critics: a score for every pair (x, y), high where the pair is likelier together than apart.

use rand::Rng;

use crate::nn::{Activation, Mlp, Tape};

/// A separable critic: the score is the dot product of two embeddings.
///
/// Its parameters are one flat vector: those of `x`, then those of `y`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Separable {
    /// Embeds x.
    pub x: Mlp,
    /// Embeds y; as wide as the embedding of x.
    pub y: Mlp,
}

/// What scoring leaves for the backward pass; reused, so that passes allocate nothing once it is warm.
#[derive(Clone, Debug, Default)]
pub struct CriticTape {
    /// Scores of the pairs (`x_i`, `y_i`), `[n]`.
    pub positive: Vec<f32>,
    /// Scores of the pairs (`x_i`, `y_j`) with j = negatives\[i, k\], `[n, k]`.
    pub negative: Vec<f32>,
    negatives: Vec<u32>,
    x: Tape,
    y: Tape,
    grad_x: Vec<f32>,
    grad_y: Vec<f32>,
}

impl Separable {
    /// The paper's critic: one layer of 32 and `LeakyReLU` on either side.
    pub fn paper(x_width: usize, y_width: usize) -> Self {
        let side = |width| Mlp::new(&[width, 32], Activation::LeakyRelu, Activation::LeakyRelu);
        Self { x: side(x_width), y: side(y_width) }
    }

    /// The critic of `estimate-mi`: two `ReLU` layers of 64 and a linear embedding of 32 on either side.
    pub fn deep(x_width: usize, y_width: usize) -> Self {
        let side = |width| Mlp::new(&[width, 64, 64, 32], Activation::Relu, Activation::Identity);
        Self { x: side(x_width), y: side(y_width) }
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.x.parameters() + self.y.parameters()
    }

    /// Appends fresh parameters.
    pub fn init<R: Rng + ?Sized>(&self, rng: &mut R, out: &mut Vec<f32>) {
        self.x.init(rng, out);
        self.y.init(rng, out);
    }

    /// Scores `x` `[n, x]` against `y` `[n, y]` and against the rows of `y` that `negatives` `[n, k]` names (any k).
    pub fn scores(&self, params: &[f32], x: &[f32], y: &[f32], n: usize, negatives: &[u32], tape: &mut CriticTape) {
        let (px, py) = params.split_at(self.x.parameters());
        let width = self.x.outputs();
        let ex = self.x.forward(px, x, n, &mut tape.x);
        let ey = self.y.forward(py, y, n, &mut tape.y);
        let k = negatives.len() / n.max(1);
        tape.positive.resize(n, 0.0);
        tape.negative.resize(n * k, 0.0);
        tape.negatives.clear();
        tape.negatives.extend_from_slice(negatives);
        let row = |j: usize| &ey[j * width..(j + 1) * width];
        for (i, ex) in ex.chunks_exact(width).enumerate() {
            tape.positive[i] = dot(ex, row(i));
            for j in i * k..(i + 1) * k {
                tape.negative[j] = dot(ex, row(negatives[j] as usize));
            }
        }
    }

    /// Backward pass of the last [`Self::scores`]: adds ∂L/∂params to `grads`, given ∂L/∂scores.
    pub fn backward(
        &self,
        params: &[f32],
        x: &[f32],
        y: &[f32],
        tape: &mut CriticTape,
        grad_positive: &[f32],
        grad_negative: &[f32],
        grads: &mut [f32],
    ) {
        let (width, n) = (self.x.outputs(), tape.positive.len());
        let k = tape.negatives.len() / n.max(1);
        let CriticTape { x: tape_x, y: tape_y, grad_x, grad_y, negatives, .. } = tape;
        for grad in [&mut *grad_x, &mut *grad_y] {
            grad.clear();
            grad.resize(n * width, 0.0);
        }
        let (all_x, all_y) = (tape_x.output(), tape_y.output());
        for i in 0..n {
            let at = i * width..(i + 1) * width;
            let (ex, gx) = (&all_x[at.clone()], &mut grad_x[at]);
            let mut pull = |g: f32, j: usize| {
                let at = j * width..(j + 1) * width;
                gx.iter_mut().zip(&all_y[at.clone()]).for_each(|(o, y)| *o += g * y);
                grad_y[at].iter_mut().zip(ex).for_each(|(o, x)| *o += g * x);
            };
            pull(grad_positive[i], i);
            for j in i * k..(i + 1) * k {
                pull(grad_negative[j], negatives[j] as usize);
            }
        }
        let (px, py) = params.split_at(self.x.parameters());
        let (gx, gy) = grads.split_at_mut(self.x.parameters());
        self.x.backward(px, x, tape_x, grad_x, gx, None);
        self.y.backward(py, y, tape_y, grad_y, gy, None);
    }
}

/// Dot product over eight running sums, which the compiler keeps in vector registers.
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a8, a_rest) = a.as_chunks::<8>();
    let (b8, b_rest) = b.as_chunks::<8>();
    let mut sums = [0.0f32; 8];
    for (a, b) in a8.iter().zip(b8) {
        for l in 0..8 {
            sums[l] += a[l] * b[l];
        }
    }
    sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Tensor, Var};

    use super::*;
    use crate::mi::{derangements, losses};
    use crate::rng::{self, Seeds};

    /// Loss and gradient of the JSD objective by candle's autograd, for the paper's critic.
    fn reference(critic: &Separable, params: &[f32], x: &Tensor, y: &Tensor, negatives: &[u32]) -> (f64, Vec<f32>) {
        let n = x.dims()[0];
        let k = negatives.len() / n;
        let vars = Var::from_slice(params, params.len(), &Device::Cpu).unwrap();
        let embed = |mlp: &Mlp, at: usize, input: &Tensor| {
            let ([o, i], _) = mlp.weight(0);
            let weight = vars.narrow(0, at, o * i).unwrap().reshape((o, i)).unwrap();
            let bias = vars.narrow(0, at + o * i, o).unwrap();
            let linear = candle_nn::Linear::new(weight, Some(bias));
            candle_nn::ops::leaky_relu(&candle_nn::Module::forward(&linear, input).unwrap(), 0.01).unwrap()
        };
        let ex = embed(&critic.x, 0, x);
        let ey = embed(&critic.y, critic.x.parameters(), y);
        let sp = |t: &Tensor| {
            let e = (t.abs().unwrap().neg().unwrap().exp().unwrap() + 1.0).unwrap().log().unwrap();
            (t.relu().unwrap() + e).unwrap()
        };
        let positive = (&ex * &ey).unwrap().sum(1).unwrap();
        let rows = Tensor::from_slice(negatives, n * k, &Device::Cpu).unwrap();
        let others = ey.index_select(&rows, 0).unwrap().reshape((n, k, ())).unwrap();
        let negative = ex.unsqueeze(1).unwrap().broadcast_mul(&others).unwrap().sum(2).unwrap();
        let loss = (sp(&positive.neg().unwrap()).mean_all().unwrap() + sp(&negative).mean_all().unwrap()).unwrap();
        let loss = (loss - 2.0 * std::f64::consts::LN_2).unwrap();
        let grads = loss.backward().unwrap();
        let value = f64::from(loss.to_scalar::<f32>().unwrap());
        (value, grads.get(&vars).unwrap().to_vec1().unwrap())
    }

    fn loss(critic: &Separable, params: &[f32], x: &[f32], y: &[f32], negatives: &[u32], grads: &mut [f32]) -> f64 {
        let n = x.len() / critic.x.inputs();
        let mut tape = CriticTape::default();
        critic.scores(params, x, y, n, negatives, &mut tape);
        let (mut v, mut gp, mut gn) = (vec![0.0; n], vec![0.0; n], vec![0.0; negatives.len()]);
        let loss = losses::jsd(&tape.positive, &tape.negative, &mut v, &mut gp, &mut gn);
        critic.backward(params, x, y, &mut tape, &gp, &gn, grads);
        loss
    }

    #[test]
    fn gradients_equal_candles_autograd() {
        let (n, k) = (300, 16);
        let critic = Separable::paper(7, 2);
        let mut rng = Seeds::new(1).stream("critic");
        let mut params = Vec::new();
        critic.init(&mut rng, &mut params);
        assert_eq!(params.len(), critic.parameters());
        let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
        let (x, y) = (draw(n * 7), draw(n * 2));
        let negatives = derangements(&mut rng, n, k);
        let mut grads = vec![0.0; params.len()];
        let found = loss(&critic, &params, &x, &y, &negatives, &mut grads);
        let tensor = |v: &[f32], w: usize| Tensor::from_slice(v, (n, w), &Device::Cpu).unwrap();
        let (expected, reference) = reference(&critic, &params, &tensor(&x, 7), &tensor(&y, 2), &negatives);
        assert!((found - expected).abs() < 1e-6, "{found} against {expected}");
        let worst = grads.iter().zip(&reference).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-6, "gradients differ by {worst}");
    }

    #[test]
    fn gradients_equal_finite_differences() {
        let critic = Separable::deep(3, 1);
        let mut rng = Seeds::new(2).stream("critic");
        let mut params = Vec::new();
        critic.init(&mut rng, &mut params);
        let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
        let (x, y) = (draw(120), draw(40));
        let negatives = derangements(&mut rng, 40, 4);
        let mut grads = vec![0.0; params.len()];
        loss(&critic, &params, &x, &y, &negatives, &mut grads);
        // along the gradient, the loss falls as fast as the gradient is long
        let square: f64 = grads.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
        let at = |h: f64| {
            let moved: Vec<f32> = params.iter().zip(&grads).map(|(p, g)| p + (h * f64::from(*g)) as f32).collect();
            loss(&critic, &moved, &x, &y, &negatives, &mut vec![0.0; params.len()])
        };
        let h = 1e-2 / square.sqrt();
        let slope = (at(h) - at(-h)) / (2.0 * h);
        assert!((slope / square - 1.0).abs() < 1e-2, "{slope} against {square}");
    }

    #[test]
    fn dot_handles_widths_that_are_no_multiple_of_eight() {
        let a: Vec<f32> = (0..19).map(|i| i as f32).collect();
        assert_eq!(dot(&a, &a), a.iter().map(|a| a * a).sum::<f32>());
        assert_eq!(dot(&[], &[]), 0.0);
    }
}
