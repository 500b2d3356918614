//! A multilayer perceptron: its shape, its forward pass and its backward pass.
//!
//! Parameters live outside, in one flat slice: per layer the weight `[outputs, inputs]` then the bias `[outputs]`
//! (`PyTorch`'s layout). Rows go through all layers tile by tile, so that a tile stays in cache.

use rand::Rng;

use super::product::{View, multiply};
use crate::rng;

/// Rows that go through all layers together: 256 × 64 floats are 64 KiB, half of a small L2.
const TILE: usize = 256;

/// Narrow outputs are computed this wide: `gemm` drops from about 135 to 12 GFLOP/s at an output width of 2.
const NARROW: usize = 16;

/// What a layer does to its sums.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    Identity,
    /// max(0, z).
    Relu,
    /// z, or 0.01 z below zero.
    LeakyRelu,
    /// tanh z.
    Tanh,
    /// 1 / (1 + e⁻ᶻ).
    Sigmoid,
}

impl Activation {
    fn apply(self, z: f32) -> f32 {
        match self {
            Self::Identity => z,
            Self::Relu => z.max(0.0),
            Self::LeakyRelu => z.max(0.01 * z),
            Self::Tanh => z.tanh(),
            Self::Sigmoid => 1.0 / (1.0 + (-z).exp()),
        }
    }

    /// Derivative, from the activated value.
    fn slope(self, y: f32) -> f32 {
        match self {
            Self::Identity => 1.0,
            Self::Relu => f32::from(u8::from(y > 0.0)),
            Self::LeakyRelu => {
                if y > 0.0 {
                    1.0
                } else {
                    0.01
                }
            }
            Self::Tanh => 1.0 - y * y,
            Self::Sigmoid => y * (1.0 - y),
        }
    }
}

/// The shape of a perceptron.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mlp {
    widths: Vec<usize>,
    hidden: Activation,
    output: Activation,
}

/// What a forward pass leaves for the backward pass; reused, so that passes allocate nothing once it is warm.
#[derive(Clone, Debug, Default)]
pub struct Tape {
    activations: Vec<Vec<f32>>,
    rows: usize,
    padded_weight: Vec<f32>,
    padded_rows: Vec<f32>,
    padded_grad: Vec<f32>,
    deltas: [Vec<f32>; 2],
}

impl Tape {
    /// Output of the last forward pass, `[rows, outputs]`.
    pub fn output(&self) -> &[f32] {
        self.activations.last().map_or(&[], |a| a)
    }
}

fn grow(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    buffer.resize(len, 0.0);
    buffer
}

impl Mlp {
    /// A perceptron of these widths: inputs, hidden layers, outputs.
    ///
    /// # Panics
    /// When there are fewer than two widths, or one is 0.
    pub fn new(widths: &[usize], hidden: Activation, output: Activation) -> Self {
        assert!(widths.len() >= 2 && widths.iter().all(|&w| w > 0), "a perceptron needs positive widths");
        Self { widths: widths.to_vec(), hidden, output }
    }

    /// Width of the input.
    pub fn inputs(&self) -> usize {
        self.widths[0]
    }

    /// Width of the output.
    pub fn outputs(&self) -> usize {
        self.widths[self.widths.len() - 1]
    }

    /// Layers.
    pub fn layers(&self) -> usize {
        self.widths.len() - 1
    }

    /// Shape `[outputs, inputs]` of layer `layer`'s weight and where it starts in the flat parameters.
    pub fn weight(&self, layer: usize) -> ([usize; 2], usize) {
        let offset = (0..layer).map(|l| self.widths[l + 1] * (self.widths[l] + 1)).sum();
        ([self.widths[layer + 1], self.widths[layer]], offset)
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.widths.windows(2).map(|w| w[1] * (w[0] + 1)).sum()
    }

    /// What layer `layer` does to its sums.
    pub(super) fn activation(&self, layer: usize) -> Activation {
        if layer + 1 == self.layers() { self.output } else { self.hidden }
    }

    /// Appends fresh parameters: U(−1/√inputs, 1/√inputs) for weights and biases, `PyTorch`'s default for `Linear`.
    pub fn init<R: Rng + ?Sized>(&self, rng: &mut R, out: &mut Vec<f32>) {
        for layer in 0..self.layers() {
            let ([outputs, inputs], _) = self.weight(layer);
            let bound = 1.0 / libm::sqrt(inputs as f64);
            out.extend((0..outputs * (inputs + 1)).map(|_| rng::uniform(rng, -bound, bound) as f32));
        }
    }

    /// Forward pass of `[rows, inputs]`; the output stays in the tape.
    ///
    /// # Panics
    /// When a slice is shorter than its shape.
    pub fn forward<'t>(&self, params: &[f32], input: &[f32], rows: usize, tape: &'t mut Tape) -> &'t [f32] {
        assert!(params.len() >= self.parameters() && input.len() >= rows * self.inputs());
        tape.rows = rows;
        tape.activations.resize_with(self.layers(), Vec::new);
        for layer in 0..self.layers() {
            grow(&mut tape.activations[layer], rows * self.widths[layer + 1]);
        }
        for start in (0..rows).step_by(TILE) {
            let tile = start..rows.min(start + TILE);
            for layer in 0..self.layers() {
                self.forward_layer(params, input, layer, tile.clone(), tape);
            }
        }
        tape.output()
    }

    fn forward_layer(
        &self,
        params: &[f32],
        input: &[f32],
        layer: usize,
        tile: std::ops::Range<usize>,
        tape: &mut Tape,
    ) {
        let ([outputs, inputs], offset) = self.weight(layer);
        let (rows, activation) = (tile.len(), self.activation(layer));
        let weight = &params[offset..offset + outputs * inputs];
        let bias = &params[offset + outputs * inputs..offset + outputs * (inputs + 1)];
        let (before, after) = tape.activations.split_at_mut(layer);
        let x = before.last().map_or(input, |a| a.as_slice());
        let x = View::new(&x[tile.start * inputs..tile.end * inputs], rows, inputs);
        let y = &mut after[0][tile.start * outputs..tile.end * outputs];
        if outputs < NARROW {
            let wide = grow(&mut tape.padded_weight, NARROW * inputs);
            wide[..outputs * inputs].copy_from_slice(weight);
            wide[outputs * inputs..].fill(0.0);
            let sums = grow(&mut tape.padded_rows, rows * NARROW);
            multiply(x, View::new(wide, NARROW, inputs).t(), sums, false);
            for (sum, y) in sums.chunks_exact(NARROW).zip(y.chunks_exact_mut(outputs)) {
                y.copy_from_slice(&sum[..outputs]);
            }
        } else {
            multiply(x, View::new(weight, outputs, inputs).t(), y, false);
        }
        match activation {
            Activation::Relu => finish(y, bias, |z| z.max(0.0)),
            Activation::LeakyRelu => finish(y, bias, |z| z.max(0.01 * z)),
            other => finish(y, bias, |z| other.apply(z)),
        }
    }

    /// Backward pass of the forward pass in `tape`: adds ∂L/∂params to `grads` and writes ∂L/∂input to `grad_input`.
    ///
    /// `grad_output` is ∂L/∂output, `[rows, outputs]`; `grads` has one element per parameter (empty: not wanted).
    ///
    /// # Panics
    /// When a slice does not have its shape.
    pub fn backward(
        &self,
        params: &[f32],
        input: &[f32],
        tape: &mut Tape,
        grad_output: &[f32],
        grads: &mut [f32],
        mut grad_input: Option<&mut [f32]>,
    ) {
        let (rows, layers) = (tape.rows, self.layers());
        assert!(grad_output.len() >= rows * self.outputs());
        assert!(grads.is_empty() || grads.len() == self.parameters());
        let [mut delta, mut next] = std::mem::take(&mut tape.deltas);
        for start in (0..rows).step_by(TILE) {
            let end = rows.min(start + TILE);
            let n = end - start;
            for layer in (0..layers).rev() {
                let ([outputs, inputs], offset) = self.weight(layer);
                let y = &tape.activations[layer][start * outputs..end * outputs];
                // delta = ∂L/∂(sums of this layer), padded to a width that the product likes
                let width = if outputs < NARROW { NARROW } else { outputs };
                let activation = self.activation(layer);
                if layer + 1 == layers {
                    let given = &grad_output[start * outputs..end * outputs];
                    let delta = grow(&mut delta, n * width);
                    for ((d, g), y) in
                        delta.chunks_exact_mut(width).zip(given.chunks_exact(outputs)).zip(y.chunks_exact(outputs))
                    {
                        for o in 0..outputs {
                            d[o] = g[o] * activation.slope(y[o]);
                        }
                        d[outputs..].fill(0.0);
                    }
                } else {
                    slope_in_place(&mut delta[..n * outputs], y, activation);
                }
                let x = if layer == 0 { input } else { &tape.activations[layer - 1] };
                let x = &x[start * inputs..end * inputs];
                if !grads.is_empty() {
                    let (grad_weight, grad_bias) =
                        grads[offset..offset + outputs * (inputs + 1)].split_at_mut(outputs * inputs);
                    let d = View::new(&delta, n, width);
                    if width == outputs {
                        multiply(d.t(), View::new(x, n, inputs), grad_weight, true);
                    } else {
                        let wide = grow(&mut tape.padded_grad, width * inputs);
                        multiply(d.t(), View::new(x, n, inputs), wide, false);
                        grad_weight.iter_mut().zip(wide.iter()).for_each(|(g, w)| *g += w);
                    }
                    for d in delta[..n * width].chunks_exact(width) {
                        grad_bias.iter_mut().zip(d).for_each(|(g, d)| *g += d);
                    }
                }
                let target: &mut [f32] = if layer > 0 {
                    grow(&mut next, n * inputs)
                } else if let Some(grad_input) = grad_input.as_deref_mut() {
                    &mut grad_input[start * inputs..end * inputs]
                } else {
                    continue;
                };
                let weight = &params[offset..offset + outputs * inputs];
                if width == outputs {
                    multiply(View::new(&delta, n, width), View::new(weight, outputs, inputs), target, false);
                } else {
                    let wide = grow(&mut tape.padded_weight, width * inputs);
                    wide[..outputs * inputs].copy_from_slice(weight);
                    wide[outputs * inputs..].fill(0.0);
                    multiply(View::new(&delta, n, width), View::new(wide, width, inputs), target, false);
                }
                if layer > 0 {
                    std::mem::swap(&mut delta, &mut next);
                }
            }
        }
        tape.deltas = [delta, next];
    }
}

/// Adds the bias and applies the activation, row by row.
fn finish(y: &mut [f32], bias: &[f32], activation: impl Fn(f32) -> f32) {
    for row in y.chunks_exact_mut(bias.len()) {
        row.iter_mut().zip(bias).for_each(|(y, b)| *y = activation(*y + b));
    }
}

/// Multiplies `delta` by the activation's slope at `y`.
fn slope_in_place(delta: &mut [f32], y: &[f32], activation: Activation) {
    match activation {
        Activation::Identity => {}
        Activation::Relu => delta.iter_mut().zip(y).for_each(|(d, &y)| *d = if y > 0.0 { *d } else { 0.0 }),
        other => delta.iter_mut().zip(y).for_each(|(d, &y)| *d *= other.slope(y)),
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{D, DType, Device, Tensor, Var};

    use super::*;
    use crate::rng::Seeds;

    /// Forward, parameter gradients and input gradients of Σ w·output by candle's autograd.
    fn reference(mlp: &Mlp, params: &[f32], x: &[f32], rows: usize, w: &[f32]) -> [Vec<f32>; 3] {
        let dev = &Device::Cpu;
        let vars = Var::from_tensor(&Tensor::from_slice(params, params.len(), dev).unwrap()).unwrap();
        let x = Var::from_tensor(&Tensor::from_slice(x, (rows, mlp.inputs()), dev).unwrap()).unwrap();
        let mut h = x.as_tensor().clone();
        for layer in 0..mlp.layers() {
            let ([o, i], at) = mlp.weight(layer);
            let weight = vars.narrow(0, at, o * i).unwrap().reshape((o, i)).unwrap();
            let bias = vars.narrow(0, at + o * i, o).unwrap();
            let linear = candle_nn::Linear::new(weight, Some(bias));
            h = candle_nn::Module::forward(&linear, &h).unwrap();
            h = match mlp.activation(layer) {
                Activation::Identity => h,
                Activation::Relu => h.relu().unwrap(),
                Activation::LeakyRelu => candle_nn::ops::leaky_relu(&h, 0.01).unwrap(),
                Activation::Tanh => h.tanh().unwrap(),
                Activation::Sigmoid => candle_nn::ops::sigmoid(&h).unwrap(),
            };
        }
        let w = Tensor::from_slice(w, (rows, mlp.outputs()), dev).unwrap();
        let loss = (&h * w).unwrap().sum(D::Minus1).unwrap().sum_all().unwrap();
        let grads = loss.backward().unwrap();
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_dtype(DType::F32).unwrap().to_vec1().unwrap();
        [flat(&h), flat(grads.get(&vars).unwrap()), flat(grads.get(&x).unwrap())]
    }

    #[test]
    fn passes_equal_candles_autograd() {
        use Activation::{Identity, LeakyRelu, Relu, Sigmoid, Tanh};
        let cases = [
            (vec![18, 64, 64, 2], Relu, Tanh, 1024),
            (vec![7, 64, 64, 1], Relu, Identity, 300),
            (vec![5, 32], LeakyRelu, LeakyRelu, 257),
            (vec![16, 32, 20], Relu, Tanh, 3),
            (vec![9, 16, 5], Relu, Sigmoid, 70),
            (vec![1, 17, 3], Tanh, Identity, 1),
        ];
        for (case, (widths, hidden, output, rows)) in cases.into_iter().enumerate() {
            let mlp = Mlp::new(&widths, hidden, output);
            let mut rng = Seeds::new(case as u64).stream("mlp");
            let mut params = Vec::new();
            mlp.init(&mut rng, &mut params);
            let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
            let (x, w) = (draw(rows * mlp.inputs()), draw(rows * mlp.outputs()));
            let [y, grad_params, grad_x] = reference(&mlp, &params, &x, rows, &w);
            let mut tape = Tape::default();
            for _ in 0..2 {
                let mut grads = vec![0.0; mlp.parameters()];
                let mut grad_input = vec![0.0; x.len()];
                close(mlp.forward(&params, &x, rows, &mut tape), &y);
                mlp.backward(&params, &x, &mut tape, &w, &mut grads, Some(&mut grad_input));
                close(&grads, &grad_params);
                close(&grad_input, &grad_x);
            }
        }
    }

    fn close(a: &[f32], b: &[f32]) {
        assert_eq!(a.len(), b.len());
        let scale = b.iter().fold(1.0f32, |m, v| m.max(v.abs()));
        let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst <= 1e-5 * scale, "differs by {worst} at scale {scale}");
    }
}
