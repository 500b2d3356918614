//! Parameters that candle owns: one flat `f32` variable, read as a slice, changed in place, named in files.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::Deref;

use candle_core::{CpuStorage, Device, InplaceOp1, Layout, Storage, Tensor, Var};
use candle_nn::VarBuilder;

use super::{Mlp, NnError};

/// A flat vector of parameters in a candle variable.
#[derive(Debug)]
pub struct Params {
    var: Var,
    len: usize,
}

/// A read lock on parameters; dereferences to the slice.
#[derive(Debug)]
pub struct ParamsRef<'a> {
    storage: candle_core::StorageRef<'a>,
}

impl Deref for ParamsRef<'_> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &*self.storage {
            Storage::Cpu(cpu) => cpu.as_slice::<f32>().unwrap_or(&[]),
            _ => &[],
        }
    }
}

/// An in-place change of the whole vector, as candle's custom operation.
struct Update<F>(RefCell<Option<F>>);

impl<F: FnOnce(&mut [f32])> InplaceOp1 for Update<F> {
    fn name(&self) -> &'static str {
        "update"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, _layout: &Layout) -> candle_core::Result<()> {
        let CpuStorage::F32(values) = storage else {
            return Err(candle_core::Error::Msg("parameters must be f32".to_owned()));
        };
        if let Some(change) = self.0.borrow_mut().take() {
            change(values);
        }
        Ok(())
    }
}

impl Params {
    /// Takes over a flat vector.
    ///
    /// # Errors
    /// [`NnError::Candle`] when candle refuses the allocation.
    pub fn new(values: Vec<f32>) -> Result<Self, NnError> {
        let len = values.len();
        Ok(Self { var: Var::from_tensor(&Tensor::from_vec(values, len, &Device::Cpu)?)?, len })
    }

    /// Number of parameters.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The parameters as a slice, for as long as the guard lives.
    pub fn read(&self) -> ParamsRef<'_> {
        ParamsRef { storage: self.var.storage_and_layout().0 }
    }

    /// Changes the parameters in place.
    ///
    /// # Errors
    /// [`NnError::Candle`].
    pub fn update(&self, change: impl FnOnce(&mut [f32])) -> Result<(), NnError> {
        Ok(self.var.inplace_op1(&Update(RefCell::new(Some(change))))?)
    }

    /// A second, independent copy.
    ///
    /// # Errors
    /// [`NnError::Candle`].
    pub fn duplicate(&self) -> Result<Self, NnError> {
        Self::new(self.read().to_vec())
    }
}

/// Adds `mlp`'s tensors to `out` under `PyTorch`'s names: `<prefix>.<layer>.weight` `[outputs, inputs]`, `….bias`.
///
/// # Errors
/// [`NnError::Candle`].
pub fn to_tensors(prefix: &str, mlp: &Mlp, params: &[f32], out: &mut BTreeMap<String, Tensor>) -> Result<(), NnError> {
    for layer in 0..mlp.layers() {
        let ([outputs, inputs], at) = mlp.weight(layer);
        let weight = Tensor::from_slice(&params[at..at + outputs * inputs], (outputs, inputs), &Device::Cpu)?;
        let bias = &params[at + outputs * inputs..at + outputs * (inputs + 1)];
        out.insert(format!("{prefix}.{layer}.weight"), weight);
        out.insert(format!("{prefix}.{layer}.bias"), Tensor::from_slice(bias, outputs, &Device::Cpu)?);
    }
    Ok(())
}

/// Appends the parameters of `mlp` found under `prefix`, in flat order; a missing name or wrong shape is an error.
///
/// # Errors
/// [`NnError::Candle`] that names the tensor and both shapes.
pub fn from_tensors(builder: &VarBuilder<'_>, prefix: &str, mlp: &Mlp, out: &mut Vec<f32>) -> Result<(), NnError> {
    for layer in 0..mlp.layers() {
        let ([outputs, inputs], _) = mlp.weight(layer);
        let part = builder.pp(prefix).pp(layer);
        out.extend(part.get((outputs, inputs), "weight")?.flatten_all()?.to_vec1::<f32>()?);
        out.extend(part.get(outputs, "bias")?.to_vec1::<f32>()?);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::Activation;

    #[test]
    fn parameters_change_in_place_and_survive_a_round_trip_by_name() {
        let mlp = Mlp::new(&[3, 4, 2], Activation::Relu, Activation::Tanh);
        let params = Params::new((0..mlp.parameters()).map(|i| i as f32).collect()).unwrap();
        params.update(|p| p.iter_mut().for_each(|v| *v *= 2.0)).unwrap();
        assert_eq!(params.read()[3], 6.0);
        let mut named = BTreeMap::new();
        to_tensors("actor", &mlp, &params.read(), &mut named).unwrap();
        assert_eq!(named["actor.0.weight"].dims(), [4, 3]);
        let builder = VarBuilder::from_tensors(named.into_iter().collect(), candle_core::DType::F32, &Device::Cpu);
        let mut flat = Vec::new();
        from_tensors(&builder, "actor", &mlp, &mut flat).unwrap();
        assert_eq!(flat, *params.read());
        let wrong = Mlp::new(&[3, 5, 2], Activation::Relu, Activation::Tanh);
        assert!(from_tensors(&builder, "actor", &wrong, &mut Vec::new()).is_err());
    }
}
