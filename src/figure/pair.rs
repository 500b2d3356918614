//! What a picture of one pair of samples shows: [`mi_pair`](super::mi_pair) draws it.

/// One pair of samples, and what was estimated from it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pair {
    /// What stands on the two axes of the scatter.
    pub names: [String; 2],
    /// The words at 0, 1, … of an axis of words; empty for an axis of numbers.
    pub levels: [Vec<String>; 2],
    /// Points of the scatter.
    pub points: Vec<(f64, f64)>,
    /// Estimates with their intervals, on one scale.
    pub estimates: Vec<Whisker>,
    /// The value by the number of samples.
    pub shrunk: Option<Shrunk>,
    /// Networks in training.
    pub trainings: Vec<Training>,
}

/// A value with its interval.
#[derive(Clone, Debug, PartialEq)]
pub struct Whisker {
    /// Estimator.
    pub label: String,
    /// What the value is to the truth: `≥ ` and `≤ ` stand before bounds, and nothing before an estimate.
    pub sign: &'static str,
    /// Value.
    pub value: f64,
    /// Interval, low and high.
    pub band: Option<(f64, f64)>,
}

/// Values on all samples and on parts of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Shrunk {
    /// Estimator.
    pub label: String,
    /// Number of samples, and value.
    pub points: Vec<(f64, f64)>,
    /// The line over 1/n: where it meets 0, and its slope.
    pub line: (f64, f64),
}

/// A network in training.
#[derive(Clone, Debug, PartialEq)]
pub struct Training {
    /// Estimator.
    pub label: String,
    /// What the scores are, with their unit.
    pub score: String,
    /// Step, and the scores of the training and of the validation part.
    pub looks: Vec<(f64, f64, f64)>,
    /// Step of the network that is used.
    pub chosen: f64,
}
