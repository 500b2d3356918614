//! Forward passes over few rows, for acting: no packing, no allocation, and a row's numbers do not depend on the rows
//! beside it, so that worlds stepped together and one by one act alike, to the bit.
//!
//! Every sum runs over the inputs in order, starting from the bias, fused where the processor can. [`Mlp::forward`] is
//! the pass for minibatches; the two agree to rounding. Here the weights are laid out anew after each change, inputs by
//! outputs. `reports/rollout` has what acting costs.
#![cfg_attr(
    target_arch = "x86_64",
    expect(unsafe_code, reason = "calls of functions compiled for instructions that were found at run time")
)]

use super::{Activation, Mlp};

/// Columns are padded to whole groups of this many: an AVX-512 register.
const LANES: usize = 16;

/// A perceptron laid out for acting.
#[derive(Clone, Debug)]
pub struct FewRows {
    layers: Vec<Layer>,
    instructions: Instructions,
}

#[derive(Clone, Debug)]
struct Layer {
    inputs: usize,
    outputs: usize,
    /// Outputs, padded.
    stride: usize,
    /// `[inputs, stride]`, zeros in the padding.
    weight: Vec<f32>,
    /// `[stride]`.
    bias: Vec<f32>,
    activation: Activation,
}

/// What a pass computes in; reused, so that passes allocate nothing once it is warm.
#[derive(Clone, Debug, Default)]
pub struct FewScratch {
    sums: Vec<f32>,
    values: [Vec<f32>; 2],
}

/// Which instructions the processor has. All but `Any` fuse, and give the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Instructions {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Fma,
    Any,
}

impl Instructions {
    fn found() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") {
                return Self::Avx512;
            }
            if is_x86_feature_detected!("avx") && is_x86_feature_detected!("fma") {
                return Self::Fma;
            }
        }
        Self::Any
    }
}

impl FewRows {
    /// `mlp` with these parameters.
    ///
    /// # Panics
    /// When there are fewer parameters than the perceptron has.
    pub fn new(mlp: &Mlp, params: &[f32]) -> Self {
        let layers = (0..mlp.layers()).map(|l| Layer::new(mlp.weight(l).0, mlp.activation(l))).collect();
        let mut rows = Self { layers, instructions: Instructions::found() };
        rows.set(params);
        rows
    }

    /// Takes over changed parameters of the same perceptron.
    ///
    /// # Panics
    /// When there are fewer parameters than the perceptron has.
    pub fn set(&mut self, params: &[f32]) {
        let mut rest = params;
        for layer in &mut self.layers {
            let (weight, others) = rest.split_at(layer.outputs * layer.inputs);
            let (bias, others) = others.split_at(layer.outputs);
            layer.set(weight, bias);
            rest = others;
        }
    }

    /// Forward pass of `[rows, inputs]`; returns `[rows, outputs]`.
    ///
    /// # Panics
    /// When the input is shorter than its shape.
    pub fn forward<'s>(&self, input: &[f32], rows: usize, scratch: &'s mut FewScratch) -> &'s [f32] {
        let FewScratch { sums, values: [from, to] } = scratch;
        let mut width = self.layers[0].inputs;
        from.clear();
        from.extend_from_slice(&input[..rows * width]);
        for layer in &self.layers {
            sums.resize(rows * layer.stride, 0.0);
            layer.sums(self.instructions, from, rows, sums);
            to.clear();
            for row in sums.chunks_exact(layer.stride) {
                to.extend_from_slice(&row[..layer.outputs]);
            }
            match layer.activation {
                Activation::Identity => {}
                Activation::Relu => to.iter_mut().for_each(|z| *z = z.max(0.0)),
                Activation::LeakyRelu => to.iter_mut().for_each(|z| *z = z.max(0.01 * *z)),
                Activation::Tanh => to.iter_mut().for_each(|z| *z = z.tanh()),
                Activation::Sigmoid => to.iter_mut().for_each(|z| *z = 1.0 / (1.0 + (-*z).exp())),
            }
            std::mem::swap(from, to);
            width = layer.outputs;
        }
        &from[..rows * width]
    }
}

impl Layer {
    fn new([outputs, inputs]: [usize; 2], activation: Activation) -> Self {
        let stride = outputs.next_multiple_of(LANES);
        let (weight, bias) = (vec![0.0; inputs * stride], vec![0.0; stride]);
        Self { inputs, outputs, stride, weight, bias, activation }
    }

    fn set(&mut self, weight: &[f32], bias: &[f32]) {
        for (output, row) in weight.chunks_exact(self.inputs).enumerate() {
            for (input, &value) in row.iter().enumerate() {
                self.weight[input * self.stride + output] = value;
            }
        }
        self.bias[..self.outputs].copy_from_slice(bias);
    }

    /// `[rows, stride]` sums before the activation.
    fn sums(&self, instructions: Instructions, input: &[f32], rows: usize, out: &mut [f32]) {
        match instructions {
            // SAFETY: `Instructions::found` saw that the processor has what the function is compiled for
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512 => unsafe { avx512::sums(self, input, rows, out) },
            // SAFETY: as above
            #[cfg(target_arch = "x86_64")]
            Instructions::Fma => unsafe { fma::sums(self, input, rows, out) },
            Instructions::Any => self.plain_sums(input, rows, out),
        }
    }

    fn plain_sums(&self, input: &[f32], rows: usize, out: &mut [f32]) {
        let rows = input.chunks_exact(self.inputs).zip(out.chunks_exact_mut(self.stride)).take(rows);
        for (input, sums) in rows {
            sums.copy_from_slice(&self.bias);
            for (x, weight) in input.iter().zip(self.weight.chunks_exact(self.stride)) {
                sums.iter_mut().zip(weight).for_each(|(sum, w)| *sum += x * w);
            }
        }
    }
}

/// The sums in tiles of `$rows` rows by `$wide` registers, which all stay in registers; then what is left, one row or
/// one register at a time.
#[cfg(target_arch = "x86_64")]
macro_rules! tiled {
    ($module:ident, $features:literal, $lanes:literal, $rows:literal, $wide:literal, $load:ident, $splat:ident, $fused:ident, $store:ident) => {
        mod $module {
            use std::arch::x86_64::{$fused, $load, $splat, $store};

            use super::Layer;

            #[target_feature(enable = $features)]
            pub(super) fn sums(layer: &Layer, input: &[f32], rows: usize, out: &mut [f32]) {
                const WIDE: usize = $wide * $lanes;
                let mut row = 0;
                while row < rows {
                    let tall = row + $rows <= rows;
                    let (x, y) = (&input[row * layer.inputs..], &mut out[row * layer.stride..]);
                    let mut column = 0;
                    while column < layer.stride {
                        let wide = column + WIDE <= layer.stride;
                        match (tall, wide) {
                            (true, true) => tile::<$rows, $wide>(layer, x, column, y),
                            (true, false) => tile::<$rows, 1>(layer, x, column, y),
                            (false, true) => tile::<1, $wide>(layer, x, column, y),
                            (false, false) => tile::<1, 1>(layer, x, column, y),
                        }
                        column += if wide { WIDE } else { $lanes };
                    }
                    row += if tall { $rows } else { 1 };
                }
            }

            #[target_feature(enable = $features)]
            fn tile<const R: usize, const C: usize>(layer: &Layer, input: &[f32], column: usize, out: &mut [f32]) {
                let (inputs, stride) = (layer.inputs, layer.stride);
                let x: [&[f32]; R] = std::array::from_fn(|r| &input[r * inputs..][..inputs]);
                let bias = &layer.bias[column..][..C * $lanes];
                let mut sums = [[$splat(0.0); C]; R];
                for c in 0..C {
                    // SAFETY: `bias` holds C registers
                    let bias = unsafe { $load(bias.as_ptr().add(c * $lanes)) };
                    for row in &mut sums {
                        row[c] = bias;
                    }
                }
                for i in 0..inputs {
                    let weight = &layer.weight[i * stride + column..][..C * $lanes];
                    let mut w = [$splat(0.0); C];
                    for c in 0..C {
                        // SAFETY: `weight` holds C registers
                        w[c] = unsafe { $load(weight.as_ptr().add(c * $lanes)) };
                    }
                    for r in 0..R {
                        let x = $splat(x[r][i]);
                        for c in 0..C {
                            sums[r][c] = $fused(x, w[c], sums[r][c]);
                        }
                    }
                }
                for r in 0..R {
                    let out = &mut out[r * stride + column..][..C * $lanes];
                    for c in 0..C {
                        // SAFETY: `out` holds C registers
                        unsafe { $store(out.as_mut_ptr().add(c * $lanes), sums[r][c]) };
                    }
                }
            }
        }
    };
}

// 4 rows: a weight is loaded once for four. 16 of 32 registers hold sums, or 8 of 16.
#[cfg(target_arch = "x86_64")]
tiled!(avx512, "avx512f", 16, 4, 4, _mm512_loadu_ps, _mm512_set1_ps, _mm512_fmadd_ps, _mm512_storeu_ps);
#[cfg(target_arch = "x86_64")]
tiled!(fma, "avx,fma", 8, 4, 2, _mm256_loadu_ps, _mm256_set1_ps, _mm256_fmadd_ps, _mm256_storeu_ps);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::Tape;
    use crate::rng::{Seeds, uniform};

    fn case(widths: &[usize], rows: usize) -> (Mlp, Vec<f32>, Vec<f32>) {
        let mlp = Mlp::new(widths, Activation::Relu, Activation::Tanh);
        let mut rng = Seeds::new(3).stream("rows");
        let mut params = Vec::new();
        mlp.init(&mut rng, &mut params);
        let input = (0..rows * mlp.inputs()).map(|_| uniform(&mut rng, -2.0, 2.0) as f32).collect();
        (mlp, params, input)
    }

    #[test]
    fn a_pass_equals_the_minibatch_pass_to_rounding_and_a_row_is_the_same_alone_and_among_others() {
        for widths in [&[54, 64, 64, 2][..], &[7, 20, 5], &[1, 1], &[3, 130, 17]] {
            let (mlp, params, input) = case(widths, 11);
            let rows = FewRows::new(&mlp, &params);
            let (mut scratch, mut alone, mut tape) = (FewScratch::default(), FewScratch::default(), Tape::default());
            let together = rows.forward(&input, 11, &mut scratch).to_vec();
            let reference = mlp.forward(&params, &input, 11, &mut tape);
            let error = together.iter().zip(reference).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(error < 2e-6, "{widths:?}: {error}");
            for (row, own) in input.chunks_exact(mlp.inputs()).zip(together.chunks_exact(mlp.outputs())) {
                assert_eq!(rows.forward(row, 1, &mut alone), own, "{widths:?}");
            }
        }
    }

    #[test]
    fn every_set_of_instructions_that_fuses_gives_the_same_bits_and_the_plain_one_agrees_to_rounding() {
        let (mlp, params, input) = case(&[54, 64, 64, 2], 7);
        let best = FewRows::new(&mlp, &params);
        let mut scratch = FewScratch::default();
        let expected = best.forward(&input, 7, &mut scratch).to_vec();
        let plain = FewRows { instructions: Instructions::Any, ..best.clone() };
        let error = plain.forward(&input, 7, &mut scratch).iter().zip(&expected).map(|(a, b)| (a - b).abs());
        assert!(error.fold(0.0, f32::max) < 2e-6);
        #[cfg(target_arch = "x86_64")]
        if best.instructions != Instructions::Any {
            let fma = FewRows { instructions: Instructions::Fma, ..best };
            assert_eq!(fma.forward(&input, 7, &mut scratch), expected);
        }
    }

    #[test]
    fn changed_parameters_are_taken_over() {
        let (mlp, params, input) = case(&[5, 20, 3], 2);
        let mut rows = FewRows::new(&mlp, &vec![0.0; params.len()]);
        let mut scratch = FewScratch::default();
        assert_eq!(rows.forward(&input, 2, &mut scratch), [0.0; 6]);
        rows.set(&params);
        let fresh = FewRows::new(&mlp, &params).forward(&input, 2, &mut FewScratch::default()).to_vec();
        assert_eq!(rows.forward(&input, 2, &mut scratch), fresh);
    }
}
