//! Forward and backward passes of a perceptron over packed parameters.
//!
//! Rows go through all layers tile by tile, so that a tile stays in the first-level cache. Per layer the forward pass
//! is one product with bias and activation fused in, the backward pass two: gradients of the weights, and of the
//! inputs with the slope of the layer before fused in. Layers with few outputs are dot products instead.

use std::ops::Range;

use super::kernel::{Finish, Left, Product};
use super::mlp::{Activation, Mlp};
use super::rows::Rows;
use super::simd::{LANES, Level};
use super::vector::{ColumnSums, Dots, sigmoid_in_place, tanh_in_place};

/// Rows that go through all layers together: 128 × 64 floats are 32 KiB.
pub(crate) const TILE: usize = 128;

/// A last layer behind another with at most this many outputs is computed by dot products: padded to 16 it took 15 µs
/// per 1024 × 64 rows, as dot products 4 (two outputs).
const FEW: usize = 8;

/// Rows of inputs, `stride` floats apart.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Input<'a> {
    pub(crate) data: &'a [f32],
    pub(crate) stride: usize,
}

impl<'a> Input<'a> {
    fn rows(self, start: usize) -> &'a [f32] {
        &self.data[start * self.stride..]
    }
}

/// Parameters, or their gradients, laid out for the kernels.
#[derive(Clone, Debug, Default)]
pub(crate) struct Packed {
    layers: Vec<Layer>,
    /// Which column of the first weight belongs to each column of the input; empty: the same one.
    pub(crate) columns: Vec<u32>,
    /// Columns of the first weight whose input gradient is wanted; empty: all.
    pub(crate) wanted: Range<usize>,
}

/// One layer.
#[derive(Clone, Debug, Default)]
struct Layer {
    /// `[inputs, outputs]`: the weight transposed; nothing where there are few outputs.
    transposed: Rows,
    /// `[outputs, inputs]`; of the first layer only the wanted columns.
    natural: Rows,
    /// `[1, outputs]`.
    bias: Rows,
}

/// Buffers of the passes: what the forward leaves for the backward.
#[derive(Clone, Debug, Default)]
pub(crate) struct Passes {
    /// What each layer gives, `[rows, outputs]`; of the last layer nothing where it has few outputs.
    activations: Vec<Rows>,
    output: Vec<f32>,
    deltas: [Rows; 2],
}

impl Passes {
    /// `[rows, outputs]` of the last forward pass.
    pub(crate) fn output(&self) -> &[f32] {
        &self.output
    }
}

impl Mlp {
    /// Whether `layer` is computed by dot products.
    fn few(&self, layer: usize) -> bool {
        layer > 0 && layer + 1 == self.layers() && self.outputs() <= FEW
    }

    /// Lays out parameters for both passes, keeping `columns` and `wanted` as they are.
    pub(crate) fn pack(&self, params: &[f32], packed: &mut Packed) {
        self.pack_forward(params, packed);
        self.pack_backward(params, packed);
    }

    /// Lays out what the forward pass needs.
    pub(crate) fn pack_forward(&self, params: &[f32], packed: &mut Packed) {
        assert!(params.len() >= self.parameters());
        packed.layers.resize_with(self.layers(), Layer::default);
        for at in 0..self.layers() {
            let ([outputs, inputs], offset) = self.weight(at);
            let (weight, rest) = params[offset..].split_at(outputs * inputs);
            let layer = &mut packed.layers[at];
            layer.bias.shape(1, outputs);
            layer.bias.flat_mut()[..outputs].copy_from_slice(&rest[..outputs]);
            if self.few(at) {
                self.pack_natural(params, packed, at);
                continue;
            }
            layer.transposed.shape(inputs, outputs);
            let stride = layer.transposed.stride();
            for (c, row) in layer.transposed.flat_mut().chunks_exact_mut(stride).enumerate() {
                let c = if at == 0 && !packed.columns.is_empty() { packed.columns[c] as usize } else { c };
                row.iter_mut().zip(weight[c..].iter().step_by(inputs)).for_each(|(to, from)| *to = *from);
            }
        }
    }

    /// Lays out what the backward pass needs beside that.
    pub(crate) fn pack_backward(&self, params: &[f32], packed: &mut Packed) {
        (0..self.layers()).filter(|&at| !self.few(at)).for_each(|at| self.pack_natural(params, packed, at));
    }

    fn pack_natural(&self, params: &[f32], packed: &mut Packed, at: usize) {
        let ([outputs, inputs], offset) = self.weight(at);
        let range = if at == 0 && !packed.wanted.is_empty() { packed.wanted.clone() } else { 0..inputs };
        let natural = &mut packed.layers[at].natural;
        natural.shape(outputs, range.len());
        let stride = natural.stride();
        let weight = params[offset..offset + outputs * inputs].chunks_exact(inputs);
        for (to, from) in natural.flat_mut().chunks_exact_mut(stride).zip(weight) {
            to[..range.len()].copy_from_slice(&from[range.clone()]);
            to[range.len()..].fill(0.0);
        }
    }

    /// Zero gradients of this shape.
    pub(crate) fn clear_grads(&self, grads: &mut Packed) {
        grads.layers.resize_with(self.layers(), Layer::default);
        for (at, layer) in grads.layers.iter_mut().enumerate() {
            let ([outputs, inputs], _) = self.weight(at);
            let weight = if self.few(at) {
                layer.natural.shape(outputs, inputs);
                &mut layer.natural
            } else {
                layer.transposed.shape(inputs, outputs);
                &mut layer.transposed
            };
            weight.clear();
            layer.bias.shape(1, outputs);
            layer.bias.clear();
        }
    }

    /// Adds gradients to a flat vector in the order of the parameters; `columns` as in [`Packed`].
    pub(crate) fn unpack_grads(&self, grads: &Packed, flat: &mut [f32]) {
        for (at, layer) in grads.layers.iter().enumerate() {
            let ([outputs, inputs], offset) = self.weight(at);
            let (weight, rest) = flat[offset..].split_at_mut(outputs * inputs);
            if self.few(at) {
                for (to, from) in weight.chunks_exact_mut(inputs).zip(layer.natural.iter()) {
                    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
                }
            } else {
                for (c, row) in layer.transposed.iter().enumerate() {
                    let c = if at == 0 && !grads.columns.is_empty() { grads.columns[c] as usize } else { c };
                    weight[c..].iter_mut().step_by(inputs).zip(row).for_each(|(to, from)| *to += from);
                }
            }
            rest.iter_mut().zip(&layer.bias.flat()[..outputs]).for_each(|(to, from)| *to += from);
        }
    }

    /// Forward pass; the output `[rows, outputs]` stays in `passes`.
    pub(crate) fn forward_packed<'p>(
        &self,
        packed: &Packed,
        input: Input<'_>,
        rows: usize,
        passes: &'p mut Passes,
    ) -> &'p [f32] {
        let last = self.layers() - 1;
        let Passes { activations, output, .. } = passes;
        activations.resize_with(self.layers(), Rows::default);
        for (at, activation) in activations.iter_mut().enumerate() {
            activation.shape(if self.few(at) { 0 } else { rows }, self.weight(at).0[0]);
        }
        output.resize(rows * self.outputs(), 0.0);
        for start in (0..rows).step_by(TILE) {
            let n = TILE.min(rows - start);
            for (at, layer) in packed.layers.iter().enumerate() {
                let ([outputs, inputs], _) = self.weight(at);
                let (before, after) = activations.split_at_mut(at);
                let input = before.last().map_or(input, Input::of);
                if self.few(at) {
                    let y = &mut output[start * outputs..(start + n) * outputs];
                    let (stride, bias) = (input.stride, &layer.bias.flat()[..outputs]);
                    let x = &input.rows(start)[..n * stride];
                    Level::best().run(Dots { x, w: layer.natural.flat(), stride, bias, y });
                    self.activation(at).apply(y);
                    continue;
                }
                let stride = after[0].stride();
                let c = &mut after[0].flat_mut()[start * stride..(start + n) * stride];
                let activation = self.activation(at);
                Product {
                    size: [n, stride, inputs],
                    a: Left { data: input.rows(start), row: input.stride, col: 1 },
                    b: layer.transposed.flat(),
                    c,
                    finish: Finish::Bias { bias: layer.bias.flat(), leak: activation.leak().unwrap_or(1.0) },
                }
                .compute();
                if at < last {
                    if activation.leak().is_none() {
                        activation.apply(c);
                    }
                    continue;
                }
                let y = &mut output[start * outputs..(start + n) * outputs];
                for (to, from) in y.chunks_exact_mut(outputs).zip(c.chunks_exact(stride)) {
                    to.copy_from_slice(&from[..outputs]);
                }
                if activation.leak().is_none() {
                    activation.apply(y);
                }
            }
        }
        output
    }

    /// Backward pass of the last forward pass in `passes`: adds to `grads`, writes ∂L/∂input `[rows, wanted]`.
    pub(crate) fn backward_packed(
        &self,
        packed: &Packed,
        input: Input<'_>,
        rows: usize,
        passes: &mut Passes,
        grad_output: &[f32],
        mut grads: Option<&mut Packed>,
        mut grad_input: Option<&mut [f32]>,
    ) {
        let Passes { activations, output, deltas } = passes;
        let [mut delta, mut next] = std::mem::take(deltas);
        assert!(grad_output.len() >= rows * self.outputs() && output.len() == rows * self.outputs());
        for start in (0..rows).step_by(TILE) {
            let n = TILE.min(rows - start);
            // delta = ∂L/∂(sums of a layer), from the last layer to the first
            let (outputs, last) = (self.outputs(), self.activation(self.layers() - 1));
            delta.shape(n, outputs);
            let stride = delta.stride();
            let range = start * outputs..(start + n) * outputs;
            let given = grad_output[range.clone()].chunks_exact(outputs).zip(output[range].chunks_exact(outputs));
            for (to, (g, y)) in delta.flat_mut().chunks_exact_mut(stride).zip(given) {
                for o in 0..outputs {
                    to[o] = g[o] * last.slope(y[o]);
                }
            }
            for at in (0..self.layers()).rev() {
                let ([outputs, inputs], _) = self.weight(at);
                let stride = delta.stride();
                let x = if at == 0 { input } else { Input::of(&activations[at - 1]) };
                if let Some(grads) = &mut grads {
                    let layer = &mut grads.layers[at];
                    let columns = Left { data: delta.flat(), row: 1, col: stride };
                    if self.few(at) {
                        let natural = &mut layer.natural;
                        Product {
                            size: [outputs, natural.stride(), n],
                            a: columns,
                            b: x.rows(start),
                            c: natural.flat_mut(),
                            finish: Finish::Add,
                        }
                        .compute();
                    } else {
                        Product {
                            size: [inputs, stride, n],
                            a: Left { data: x.rows(start), row: 1, col: x.stride },
                            b: delta.flat(),
                            c: layer.transposed.flat_mut(),
                            finish: Finish::Add,
                        }
                        .compute();
                    }
                    Level::best().run(ColumnSums { rows: delta.flat(), sums: layer.bias.flat_mut() });
                }
                if at == 0 && grad_input.is_none() {
                    continue;
                }
                let natural = &packed.layers[at].natural;
                next.shape(n, natural.width());
                let width = next.stride();
                let before = (at > 0).then(|| self.activation(at - 1));
                let finish = match before.and_then(Activation::leak) {
                    Some(leak) => Finish::Slope { y: &activations[at - 1].flat()[start * width..], leak },
                    None => Finish::Set,
                };
                Product {
                    size: [n, width, outputs],
                    a: Left { data: delta.flat(), row: stride, col: 1 },
                    b: natural.flat(),
                    c: next.flat_mut(),
                    finish,
                }
                .compute();
                if let (Some(before), true) = (before, matches!(finish, Finish::Set)) {
                    let y = &activations[at - 1].flat()[start * width..];
                    next.flat_mut().iter_mut().zip(y).for_each(|(d, &y)| *d *= before.slope(y));
                }
                std::mem::swap(&mut delta, &mut next);
            }
            if let Some(grad_input) = &mut grad_input {
                let width = delta.width();
                let to = &mut grad_input[start * width..(start + n) * width];
                to.chunks_exact_mut(width).zip(delta.iter()).for_each(|(to, from)| to.copy_from_slice(from));
            }
        }
        *deltas = [delta, next];
    }
}

impl<'a> Input<'a> {
    /// What a layer gave, as the input of the next.
    fn of(rows: &'a Rows) -> Self {
        Self { data: rows.flat(), stride: rows.stride() }
    }
}

impl Activation {
    /// Applies it to every element.
    fn apply(self, values: &mut [f32]) {
        match self {
            Self::Identity => {}
            Self::Tanh => tanh_in_place(values),
            Self::Sigmoid => sigmoid_in_place(values),
            Self::Relu | Self::LeakyRelu => {
                let leak = self.leak().unwrap_or(0.0);
                for y in values.iter_mut() {
                    *y = if *y > 0.0 { *y } else { leak * *y };
                }
            }
        }
    }
}

// a tile's rows are whole vectors
const _: () = assert!(TILE.is_multiple_of(LANES));
