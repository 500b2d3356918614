//! # What it is
//! A radio of limited range.
//!
//! # Definition
//! ι^{ji} = 1 if `|p_j − p_i|` ≤ threshold · unit at the time of sending, else 0. Hard and symmetric.
//!
//! # Shapes and units
//! Bits `[N, N]`; `threshold` in units of `unit` world units.
//!
//! # Parameters
//! `threshold` in [0, 1e6], required (`distance:3`); `unit` in (0, 1e6], by default the scenario's (0.25 where the view
//! is limited).
//!
//! # When it fails
//! With unit 1, thresholds 5 and 3 lose next to nothing in spread and tag: bodies start within 2.83 of each other.
//! Always look at the realised loss rate.
//!
//! # Reference
//! The DBC test environments of arXiv 2512.03528 (5, 3, 1), which give no unit.
//!
//! # Differences from the reference implementation
//! The unit of 0.25 is inferred from the paper's returns, not stated by it.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode, Setting, for_each_link};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "distance",
    summary: "messages reach as far as threshold × unit",
    reference: "arXiv 2512.03528, DBC",
    value: Some("threshold"),
    build,
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Params {
    threshold: f64,
    #[serde(default)]
    unit: Option<f64>,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct Distance {
    threshold: f64,
    unit: f64,
}

fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    let Params { threshold, unit } = spec.params()?;
    let unit = unit.unwrap_or(setting.distance_unit);
    spec.in_range("threshold", threshold, 0.0, 1e6)?;
    spec.in_range("unit", unit, f64::MIN_POSITIVE, 1e6)?;
    Ok(Box::new(Distance { threshold, unit }))
}

impl Link for Distance {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, self)
    }

    fn start(&self, _n: usize, _episode: u64, _seeds: &Seeds) -> Box<dyn LinkEpisode> {
        let range = self.threshold * self.unit;
        Box::new(Range { squared: range * range })
    }
}

struct Range {
    squared: f64,
}

impl LinkEpisode for Range {
    fn emit(&mut self, bodies: &[Body], bits: &mut [bool]) {
        let n = bodies.len();
        bits.fill(true);
        for_each_link(n, |s, r, _| {
            let (dx, dy) = (bodies[s][0] - bodies[r][0], bodies[s][1] - bodies[r][1]);
            bits[s * n + r] = dx * dx + dy * dy <= self.squared;
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{emit_rows, test_setting};

    #[test]
    fn range_is_threshold_times_unit_and_the_boundary_is_inside() {
        let setting = test_setting(0.25);
        for (spec, reach) in [
            (Spec::new("distance").with("threshold", 4), 1.0),
            (Spec::new("distance").with("threshold", 7.9), 1.0),
            (Spec::new("distance").with("threshold", 2).with("unit", 1), 2.0),
            (Spec::new("distance").with("threshold", 0), 0.0),
        ] {
            let bits = &emit_rows(&*build(&spec, &setting).unwrap(), 4, 1, 0)[0];
            for (s, r) in (0..16).map(|c| (c / 4, c % 4)) {
                assert_eq!(bits[s * 4 + r], s.abs_diff(r) as f64 <= reach, "{spec} {s} {r}");
            }
        }
    }

    #[test]
    fn negative_thresholds_and_units_are_refused() {
        let setting = test_setting(0.25);
        let error = |spec: Spec| build(&spec, &setting).err().unwrap().to_string();
        assert_eq!(
            error(Spec::new("distance").with("threshold", -1)),
            "distance: threshold must be in [0, 1000000], found -1"
        );
        assert!(error(Spec::new("distance").with("threshold", 1).with("unit", 0)).contains("unit must be in"));
        assert_eq!(error(Spec::new("distance")), "distance: missing field `threshold`");
    }
}
