//! A multilayer perceptron: its shape, its parameters, and its passes over dense rows.
//!
//! Parameters live outside, in one flat slice: per layer the weight `[outputs, inputs]` then the bias `[outputs]`
//! (`PyTorch`'s layout). The passes themselves are in `passes`; whoever keeps parameters for many passes packs them
//! once ([`Mlp::pack`]) and uses those directly.

use rand::Rng;

use super::passes::{Input, Packed, Passes};
use crate::rng;

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
    /// The factor below zero, where the function is a line on either side of it.
    pub(super) fn leak(self) -> Option<f32> {
        match self {
            Self::Identity => Some(1.0),
            Self::Relu => Some(0.0),
            Self::LeakyRelu => Some(0.01),
            Self::Tanh | Self::Sigmoid => None,
        }
    }

    /// Derivative, from the activated value.
    pub(super) fn slope(self, y: f32) -> f32 {
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
    passes: Passes,
    packed: Packed,
    grads: Packed,
    rows: usize,
}

impl Tape {
    /// Output of the last forward pass, `[rows, outputs]`.
    pub fn output(&self) -> &[f32] {
        self.passes.output()
    }
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
        self.pack_forward(params, &mut tape.packed);
        tape.rows = rows;
        self.forward_packed(&tape.packed, self.dense(input), rows, &mut tape.passes)
    }

    /// Backward pass of the forward pass in `tape`: adds ∂L/∂params to `grads` and writes ∂L/∂input to `grad_input`.
    ///
    /// `params` and `input` are those of the forward pass; `grad_output` is ∂L/∂output, `[rows, outputs]`; `grads` has
    /// one element per parameter (empty: not wanted).
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
        grad_input: Option<&mut [f32]>,
    ) {
        let Tape { passes, packed, grads: packed_grads, rows } = tape;
        assert!(grads.is_empty() || grads.len() == self.parameters());
        self.pack_backward(params, packed);
        let wanted = (!grads.is_empty()).then(|| {
            self.clear_grads(packed_grads);
            &mut *packed_grads
        });
        self.backward_packed(packed, self.dense(input), *rows, passes, grad_output, wanted, grad_input);
        if !grads.is_empty() {
            self.unpack_grads(packed_grads, grads);
        }
    }

    /// Rows of inputs one after the other.
    fn dense<'a>(&self, data: &'a [f32]) -> Input<'a> {
        Input { data, stride: self.inputs() }
    }
}

#[cfg(test)]
impl Mlp {
    /// The forward pass as candle computes it, whose autograd is the reference of tests; parameters from `at` on.
    pub(crate) fn by_candle(
        &self,
        params: &candle_core::Tensor,
        mut at: usize,
        x: &candle_core::Tensor,
    ) -> candle_core::Tensor {
        let mut h = x.clone();
        for layer in 0..self.layers() {
            let [o, i] = self.weight(layer).0;
            let weight = params.narrow(0, at, o * i).unwrap().reshape((o, i)).unwrap();
            let bias = params.narrow(0, at + o * i, o).unwrap();
            at += o * (i + 1);
            h = candle_nn::Module::forward(&candle_nn::Linear::new(weight, Some(bias)), &h).unwrap();
            h = match self.activation(layer) {
                Activation::Identity => h,
                Activation::Relu => h.relu().unwrap(),
                Activation::LeakyRelu => candle_nn::ops::leaky_relu(&h, 0.01).unwrap(),
                Activation::Tanh => h.tanh().unwrap(),
                Activation::Sigmoid => candle_nn::ops::sigmoid(&h).unwrap(),
            };
        }
        h
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
        let h = mlp.by_candle(&vars, 0, &x);
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
            (vec![9, 16, 5, 3], Relu, Tanh, 70),
            (vec![9, 16, 5, 20], Sigmoid, Tanh, 131),
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
