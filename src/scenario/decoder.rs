//! From an action to a force: the one step of the particle worlds that every code base does differently.

use serde::{Deserialize, Serialize};

/// How an action vector becomes a control `u` (before the body's gain). Nothing is clamped here: a tanh actor is
/// bounded by itself, and the probe policy is meant to be Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Decoder {
    /// Two components in [-1, 1]: `u = a`, |u| ≤ 1 per axis (PMIC).
    #[default]
    Force2,
    /// Five components in [-1, 1] (no-op, right, left, up, down): `u = (a1 − a2, a3 − a4)`, |u| ≤ 2 per axis.
    Mpe5,
}

impl Decoder {
    /// Elements of an action.
    pub fn width(self) -> usize {
        match self {
            Self::Force2 => 2,
            Self::Mpe5 => 5,
        }
    }

    /// Largest |u| per axis that actions in [-1, 1] reach.
    pub fn bound(self) -> f64 {
        match self {
            Self::Force2 => 1.0,
            Self::Mpe5 => 2.0,
        }
    }

    /// The control of an action `[width]`.
    pub fn control(self, action: &[f32]) -> [f64; 2] {
        let a = |i: usize| f64::from(action[i]);
        match self {
            Self::Force2 => [a(0), a(1)],
            Self::Mpe5 => [a(1) - a(2), a(3) - a(4)],
        }
    }

    /// Writes an action `[width]` whose control is `u`, up to `f32` rounding.
    pub fn encode(self, u: [f64; 2], action: &mut [f32]) {
        match self {
            Self::Force2 => action.copy_from_slice(&[u[0] as f32, u[1] as f32]),
            Self::Mpe5 => {
                let half = [0.5 * u[0] as f32, 0.5 * u[1] as f32];
                action.copy_from_slice(&[0.0, half[0], -half[0], half[1], -half[1]]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_encoded_is_decoded() {
        for decoder in [Decoder::Force2, Decoder::Mpe5] {
            let mut action = vec![0.0; decoder.width()];
            decoder.encode([0.5, -0.25], &mut action);
            assert_eq!(decoder.control(&action), [0.5, -0.25]);
        }
        assert_eq!(Decoder::Mpe5.control(&[9.0, 1.0, -1.0, -1.0, 1.0]), [2.0, -2.0]);
        assert_eq!(Decoder::Force2.control(&[3.0, -4.0]), [3.0, -4.0], "nothing is clamped");
    }
}
