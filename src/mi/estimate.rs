//! The output row.

use std::f64::consts::LN_2;

use polars::prelude::Column;
use serde::Serialize;

use super::form::{Row, number, text};
use crate::schema::SampleLabels;

/// What the value is to the truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Kind {
    /// Aims at it.
    #[serde(rename = "estimate")]
    Estimate,
    /// Its expectation is at most the truth.
    #[serde(rename = "lower bound")]
    LowerBound,
    /// Its expectation is at least the truth, if the fitted density is good.
    #[serde(rename = "upper bound")]
    UpperBound,
}

impl Kind {
    /// As printed.
    pub fn name(self) -> &'static str {
        match self {
            Self::Estimate => "estimate",
            Self::LowerBound => "lower bound",
            Self::UpperBound => "upper bound",
        }
    }
}

/// The scale of the value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    /// Nats of mutual information.
    Nats,
    /// Bits: nats over ln 2.
    Bits,
    /// 2·JSD, in \[0, 2 ln 2\].
    Jsd,
}

impl Unit {
    /// As printed.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nats => "nats",
            Self::Bits => "bits",
            Self::Jsd => "jsd",
        }
    }
}

/// One line of output. The field order is the order of JSON keys and Parquet columns.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// Estimator, or one of the values it gives beside its main one.
    pub estimator: String,
    /// Columns of x.
    pub x: String,
    /// Columns of y.
    pub y: String,
    /// Columns conditioned on.
    pub given: Option<String>,
    /// Who sent the messages.
    pub sender: Option<String>,
    /// Who received them.
    pub receiver: Option<String>,
    /// Whether they arrived.
    pub delivered: Option<bool>,
    /// What one episode is.
    pub group: String,
    /// The value; infinite (JSON: null) for a deterministic copy.
    pub value: f64,
    /// Its unit.
    pub unit: Unit,
    /// What it is to the truth.
    pub kind: Kind,
    /// Lower end of the 95 % interval: of the truth for an estimate, of its own expectation for a bound.
    pub interval_low: Option<f64>,
    /// Upper end.
    pub interval_high: Option<f64>,
    /// Share of permutations with at least this dependence, the observed one counted.
    pub p_value: Option<f64>,
    /// Samples behind the value (held-out ones for trained estimators).
    pub n: u64,
    /// Independent samples that would give the same standard error.
    pub n_effective: f64,
    /// What to know before trusting it.
    pub warnings: Vec<String>,
}

impl Estimate {
    /// A row with the names filled in and no interval.
    pub fn new(estimator: &str, labels: &SampleLabels, value: f64, unit: Unit, kind: Kind, n: usize) -> Self {
        Self {
            estimator: estimator.to_owned(),
            x: labels.x.clone(),
            y: labels.y.clone(),
            given: labels.given.clone(),
            sender: labels.sender.clone(),
            receiver: labels.receiver.clone(),
            delivered: labels.delivered,
            group: labels.group.clone(),
            value,
            unit,
            kind,
            interval_low: None,
            interval_high: None,
            p_value: None,
            n: n as u64,
            n_effective: n as f64,
            warnings: Vec::new(),
        }
    }
}

impl Estimate {
    /// The same in bits, if it is in nats.
    #[must_use]
    pub fn in_bits(mut self) -> Self {
        if self.unit == Unit::Nats {
            self.unit = Unit::Bits;
            self.value /= LN_2;
            self.interval_low = self.interval_low.map(|v| v / LN_2);
            self.interval_high = self.interval_high.map(|v| v / LN_2);
        }
        self
    }
}

impl Row for Estimate {
    /// Warnings are joined by `; `.
    fn columns(rows: &[Self]) -> Vec<Column> {
        vec![
            text("estimator", rows, |r| Some(r.estimator.clone())),
            text("x", rows, |r| Some(r.x.clone())),
            text("y", rows, |r| Some(r.y.clone())),
            text("given", rows, |r| r.given.clone()),
            text("sender", rows, |r| r.sender.clone()),
            text("receiver", rows, |r| r.receiver.clone()),
            Column::new("delivered".into(), rows.iter().map(|r| r.delivered).collect::<Vec<Option<bool>>>()),
            text("group", rows, |r| Some(r.group.clone())),
            number("value", rows, |r| Some(r.value)),
            text("unit", rows, |r| Some(r.unit.name().to_owned())),
            text("kind", rows, |r| Some(r.kind.name().to_owned())),
            number("interval_low", rows, |r| r.interval_low),
            number("interval_high", rows, |r| r.interval_high),
            number("p_value", rows, |r| r.p_value),
            Column::new("n".into(), rows.iter().map(|r| r.n).collect::<Vec<u64>>()),
            number("n_effective", rows, |r| Some(r.n_effective)),
            text("warnings", rows, |r| Some(r.warnings.join("; "))),
        ]
    }
}

/// A p-value as people read it: three decimals, and none of them a zero that it is not.
pub fn p_text(p: f64) -> String {
    if p < 0.001 { "<0.001".to_owned() } else { format!("{p:.3}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::{to_csv, to_parquet};

    #[test]
    fn the_keys_are_those_of_the_design_in_order() {
        let labels = SampleLabels { x: "a".to_owned(), y: "b".to_owned(), ..SampleLabels::default() };
        let mut row = Estimate::new("gaussian", &labels, f64::INFINITY, Unit::Nats, Kind::LowerBound, 7);
        row.warnings = vec!["one".to_owned(), "two".to_owned()];
        let keys = "estimator x y given sender receiver delivered group value unit kind interval_low interval_high \
                    p_value n n_effective warnings";
        let value = serde_json::to_value(&row).unwrap();
        let found: Vec<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
        assert_eq!(found.join(" "), keys);
        assert_eq!((&value["kind"], &value["unit"]), (&"lower bound".into(), &"nats".into()));
        assert!(value["value"].is_null());
        let csv = String::from_utf8(to_csv(&[row.clone()]).unwrap()).unwrap();
        assert_eq!(csv.lines().next().unwrap(), keys.replace(' ', ","));
        assert!(csv.contains("one; two"), "{csv}");
        assert_eq!(&to_parquet(&[row.clone()]).unwrap()[..4], b"PAR1");
        (row.value, row.interval_low) = (2.0 * LN_2, Some(LN_2));
        let bits = row.in_bits();
        assert_eq!(
            (bits.value, bits.interval_low, bits.interval_high, bits.unit.name()),
            (2.0, Some(1.0), None, "bits")
        );
        let jsd = Estimate::new("jsd", &labels, 0.5, Unit::Jsd, Kind::LowerBound, 7);
        assert_eq!(jsd.clone().in_bits(), jsd);
    }

    #[test]
    fn small_p_values_are_never_zero() {
        assert_eq!([0.0, 0.000_999, 0.001, 0.0449, 1.0].map(p_text), ["<0.001", "<0.001", "0.001", "0.045", "1.000"]);
    }
}
