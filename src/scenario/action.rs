//! Actions: from an action vector to a control, the one step of the particle worlds that every code base does
//! differently, and to an utterance.

use serde::{Deserialize, Serialize};

use crate::rng::{Stream, below, uniform};

/// How the moving part of an action becomes a control `u` (before the body's gain). Nothing is clamped here: a tanh
/// actor is bounded by itself, and the probe policy is meant to be Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Decoder {
    /// Two components in [-1, 1]: `u = a`, |u| ≤ 1 per axis (PMIC).
    #[default]
    Force2,
    /// Five components in [-1, 1] (no-op, right, left, up, down): `u = (a1 − a2, a3 − a4)`, |u| ≤ 2 per axis.
    Mpe5,
    /// Five components in [0, 1] (no-op, left, right, down, up): `u = (a2 − a1, a4 − a3)`, |u| ≤ 1 per axis. The
    /// differences are taken in `f32`, as mpe2 takes them.
    Mpe2,
}

impl Decoder {
    /// Elements of the moving part of an action.
    pub fn width(self) -> usize {
        match self {
            Self::Force2 => 2,
            Self::Mpe5 | Self::Mpe2 => 5,
        }
    }

    /// Least element of an action; the largest is 1.
    pub fn low(self) -> f32 {
        match self {
            Self::Force2 | Self::Mpe5 => -1.0,
            Self::Mpe2 => 0.0,
        }
    }

    /// Largest |u| per axis that actions in their range reach.
    pub fn bound(self) -> f64 {
        match self {
            Self::Force2 | Self::Mpe2 => 1.0,
            Self::Mpe5 => 2.0,
        }
    }

    /// The control of an action whose first `width` elements move the body.
    pub fn control(self, action: &[f32]) -> [f64; 2] {
        let a = |i: usize| f64::from(action[i]);
        match self {
            Self::Force2 => [a(0), a(1)],
            Self::Mpe5 => [a(1) - a(2), a(3) - a(4)],
            Self::Mpe2 => [f64::from(action[2] - action[1]), f64::from(action[4] - action[3])],
        }
    }

    /// Writes an action `[width]` whose control is `u`, up to `f32` rounding.
    fn encode(self, u: [f64; 2], action: &mut [f32]) {
        match self {
            Self::Force2 => action.copy_from_slice(&[u[0] as f32, u[1] as f32]),
            Self::Mpe5 => {
                let half = [0.5 * u[0] as f32, 0.5 * u[1] as f32];
                action.copy_from_slice(&[0.0, half[0], -half[0], half[1], -half[1]]);
            }
            Self::Mpe2 => {
                let [x, y] = u.map(|c| c as f32);
                action.copy_from_slice(&[0.0, (-x).max(0.0), x.max(0.0), (-y).max(0.0), y.max(0.0)]);
            }
        }
    }

    /// The move among the five whose control is nearest to `u`: the no-op, or the larger component's direction.
    fn nearest_move(self, u: [f64; 2]) -> usize {
        let axis = usize::from(u[1].abs() > u[0].abs());
        if u[axis].abs() < 0.5 {
            return 0;
        }
        let forward = u[axis] > 0.0;
        1 + 2 * axis + usize::from(forward == (self == Self::Mpe2))
    }
}

/// An action that no agent of the scenario can take.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum ActionError {
    /// A discrete action has no such number.
    #[error("a discrete action must be in [0, {last}], found {found}")]
    OutOfRange {
        /// The last action.
        last: usize,
        /// What was given.
        found: usize,
    },
    /// A row of a store of discrete actions is not one-hot.
    #[error("a discrete action must be one-hot (one 1, else 0) over its {width} {what}, found {found:?}")]
    NotOneHot {
        /// `moves` or `words`.
        what: &'static str,
        /// How many there are.
        width: usize,
        /// What was given.
        found: Vec<f32>,
    },
    /// A value that is no number.
    #[error("action component {at} must be finite, found {found}")]
    NotFinite {
        /// Its place in the action.
        at: usize,
        /// What was given.
        found: f32,
    },
}

/// What every agent of a scenario can do: move, and say one of `words` (or a vector of that many components).
///
/// An action `[width]` is the decoder's part, then the utterance; one-hot in both parts when discrete. Discrete actions
/// are numbered `move + 5 · word`, as mpe2 numbers them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionSpace {
    /// From action to control.
    pub decoder: Decoder,
    /// Whether actions are choices.
    pub discrete: bool,
    /// Width of an utterance; 0 for silent agents.
    pub words: usize,
}

impl ActionSpace {
    /// Elements of an action.
    pub fn width(&self) -> usize {
        self.decoder.width() + self.words
    }

    /// How many discrete actions there are; `None` when they are continuous.
    pub fn choices(&self) -> Option<usize> {
        self.discrete.then(|| self.decoder.width() * self.words.max(1))
    }

    /// Writes an action that pushes with `u` (the nearest move when discrete) and says nothing (the first word).
    pub fn encode(&self, u: [f64; 2], action: &mut [f32]) {
        let (body, words) = action.split_at_mut(self.decoder.width());
        words.fill(0.0);
        if self.discrete {
            body.fill(0.0);
            body[self.decoder.nearest_move(u)] = 1.0;
            words.iter_mut().take(1).for_each(|word| *word = 1.0);
        } else {
            self.decoder.encode(u, body);
        }
    }

    /// Writes discrete action number `choice` as one-hot vectors.
    ///
    /// # Errors
    /// [`ActionError::OutOfRange`]; a continuous space has the one action 0.
    pub fn one_hot(&self, choice: usize, action: &mut [f32]) -> Result<(), ActionError> {
        let choices = self.choices().unwrap_or(1);
        if choice >= choices {
            return Err(ActionError::OutOfRange { last: choices - 1, found: choice });
        }
        self.set(choice, action);
        Ok(())
    }

    fn set(&self, choice: usize, action: &mut [f32]) {
        let moves = self.decoder.width();
        action.fill(0.0);
        action[choice % moves] = 1.0;
        if self.words > 0 {
            action[moves + choice / moves] = 1.0;
        }
    }

    /// Writes a random action: components uniform over their range, or one of all choices.
    pub fn sample(&self, rng: &mut Stream, action: &mut [f32]) {
        match self.choices() {
            Some(choices) => self.set(below(rng, choices), action),
            None => action.fill_with(|| uniform(rng, f64::from(self.decoder.low()), 1.0) as f32),
        }
    }

    /// Checks an action `[width]` that came from outside.
    ///
    /// # Errors
    /// [`ActionError::NotFinite`], and [`ActionError::NotOneHot`] when actions are discrete.
    pub fn check(&self, action: &[f32]) -> Result<(), ActionError> {
        if let Some((at, &found)) = action.iter().enumerate().find(|(_, a)| !a.is_finite()) {
            return Err(ActionError::NotFinite { at, found });
        }
        let (body, words) = action.split_at(self.decoder.width());
        for (what, part) in [("moves", body), ("words", words)] {
            let ones = part.iter().filter(|&&a| a == 1.0).count();
            let zeros = part.iter().filter(|&&a| a == 0.0).count();
            if self.discrete && !part.is_empty() && (ones != 1 || zeros != part.len() - 1) {
                return Err(ActionError::NotOneHot { what, width: part.len(), found: part.to_vec() });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Decoder; 3] = [Decoder::Force2, Decoder::Mpe5, Decoder::Mpe2];

    #[test]
    fn what_is_encoded_is_decoded() {
        for decoder in ALL {
            let space = ActionSpace { decoder, discrete: false, words: 2 };
            let mut action = vec![9.0; space.width()];
            space.encode([0.5, -0.25], &mut action);
            assert_eq!(decoder.control(&action), [0.5, -0.25]);
            assert!(action.iter().all(|&a| a >= decoder.low() && a <= 1.0) && action.ends_with(&[0.0, 0.0]));
        }
        assert_eq!(Decoder::Mpe5.control(&[9.0, 1.0, -1.0, -1.0, 1.0]), [2.0, -2.0]);
        assert_eq!(Decoder::Mpe2.control(&[9.0, 1.0, 0.25, 0.0, 0.5]), [-0.75, 0.5]);
        assert_eq!(Decoder::Force2.control(&[3.0, -4.0]), [3.0, -4.0], "nothing is clamped");
    }

    #[test]
    fn a_discrete_push_is_the_nearest_move() {
        for decoder in [Decoder::Mpe5, Decoder::Mpe2] {
            let space = ActionSpace { decoder, discrete: true, words: 3 };
            let mut action = vec![9.0; 8];
            for (u, expected) in [
                ([0.9, 0.3], [1.0, 0.0]),
                ([-0.9, 0.3], [-1.0, 0.0]),
                ([0.2, 0.7], [0.0, 1.0]),
                ([0.2, -0.7], [0.0, -1.0]),
                ([0.2, -0.1], [0.0, 0.0]),
            ] {
                space.encode(u, &mut action);
                assert_eq!(decoder.control(&action), expected, "{decoder:?}");
                assert_eq!(space.check(&action), Ok(()));
                assert_eq!(action[5..], [1.0, 0.0, 0.0]);
            }
        }
    }

    #[test]
    fn choices_are_numbered_as_mpe2_numbers_them_and_end() {
        let space = ActionSpace { decoder: Decoder::Mpe2, discrete: true, words: 10 };
        let mut action = vec![9.0; 15];
        space.one_hot(37, &mut action).unwrap(); // 37 % 5 = 2, right; 37 / 5 = 7, the eighth word
        assert_eq!(space.decoder.control(&action), [1.0, 0.0]);
        assert_eq!((action[5 + 7], action.iter().sum::<f32>()), (1.0, 2.0));
        let error = space.one_hot(50, &mut action).unwrap_err().to_string();
        assert_eq!(error, "a discrete action must be in [0, 49], found 50");
    }

    #[test]
    fn foreign_actions_are_checked() {
        let space = ActionSpace { decoder: Decoder::Mpe2, discrete: true, words: 0 };
        let error = space.check(&[0.0, 0.5, 0.5, 0.0, 0.0]).unwrap_err().to_string();
        assert_eq!(
            error,
            "a discrete action must be one-hot (one 1, else 0) over its 5 moves, found [0.0, 0.5, 0.5, 0.0, 0.0]"
        );
        assert!(space.check(&[1.0, 1.0, 0.0, 0.0, 0.0]).is_err());
        let free = ActionSpace { discrete: false, ..space };
        assert_eq!(free.check(&[0.1, 0.2, 0.3, 0.4, 7.0]), Ok(()));
        let error = free.check(&[0.0, f32::NAN, 0.0, 0.0, 0.0]).unwrap_err().to_string();
        assert_eq!(error, "action component 1 must be finite, found NaN");
    }
}
