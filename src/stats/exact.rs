//! Sums without rounding, so that their value does not depend on order or grouping.

use serde::{Deserialize, Serialize};

/// Limbs of 32 bits that cover every finite f64, and 96 bits of carries above.
const LIMBS: usize = 70;
/// Additions that fit before the carries are passed on.
const LIMIT: u32 = 1 << 30;

/// The exact sum of finite numbers: a fixed-point number of 2240 bits, its lowest bit 2⁻¹⁰⁷⁴.
///
/// Neal, "Fast exact summation using small and large superaccumulators" (2015), the small one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Vec<(usize, i64)>", into = "Vec<(usize, i64)>")]
pub struct ExactSum {
    /// Limb i counts 2^(32 i − 1074).
    limbs: Box<[i64; LIMBS]>,
    /// Additions since the carries were passed on.
    pending: u32,
}

impl Default for ExactSum {
    fn default() -> Self {
        Self { limbs: Box::new([0; LIMBS]), pending: 0 }
    }
}

impl ExactSum {
    /// Adds a finite number; others are an error of the caller's and add nothing.
    pub fn add(&mut self, value: f64) {
        let bits = value.to_bits();
        let (exponent, fraction) = ((bits >> 52 & 0x7ff) as usize, bits & ((1 << 52) - 1));
        if exponent == 0x7ff {
            return;
        }
        // subnormal numbers have the exponent of the smallest normal ones and no leading bit
        let (place, mantissa) = if exponent == 0 { (0, fraction) } else { (exponent - 1, fraction | 1 << 52) };
        let wide = u128::from(mantissa) << (place % 32);
        let sign = if value.is_sign_negative() { -1 } else { 1 };
        for (limb, digits) in self.limbs[place / 32..].iter_mut().zip([wide, wide >> 32, wide >> 64]) {
            *limb += sign * i64::from(digits as u32);
        }
        self.pending += 1;
        if self.pending == LIMIT {
            self.carry();
        }
    }

    /// Adds another sum.
    pub fn merge(&mut self, other: &Self) {
        let mut other = other.clone();
        other.carry();
        self.carry();
        for (limb, more) in self.limbs.iter_mut().zip(other.limbs.iter()) {
            *limb += more;
        }
        self.carry();
    }

    /// Passes the carries on: afterwards equal sums have equal limbs, all but the highest in 0..2³².
    fn carry(&mut self) {
        for i in 0..LIMBS - 1 {
            let carry = self.limbs[i] >> 32;
            self.limbs[i] -= carry << 32;
            self.limbs[i + 1] += carry;
        }
        self.pending = 0;
    }

    /// The sum as a number, within one unit of its last place; equal sums give equal numbers.
    pub fn value(&self) -> f64 {
        let mut sum = self.clone();
        sum.carry();
        let negative = sum.limbs[LIMBS - 1] < 0;
        if negative {
            sum.limbs.iter_mut().for_each(|limb| *limb = -*limb);
            sum.carry();
        }
        let mut value = 0.0;
        for (i, &limb) in sum.limbs.iter().enumerate() {
            if limb != 0 {
                // two factors: the power alone can be below the smallest number, or above the largest
                let half = 16 * i as i32 - 537;
                value += limb as f64 * power_of_two(half) * power_of_two(half);
            }
        }
        if negative { -value } else { value }
    }
}

/// 2^n for n within ±1022.
fn power_of_two(n: i32) -> f64 {
    f64::from_bits(((n + 1023) as u64) << 52)
}

impl From<ExactSum> for Vec<(usize, i64)> {
    fn from(mut sum: ExactSum) -> Self {
        sum.carry();
        sum.limbs.iter().copied().enumerate().filter(|&(_, limb)| limb != 0).collect()
    }
}

impl TryFrom<Vec<(usize, i64)>> for ExactSum {
    type Error = String;

    fn try_from(limbs: Vec<(usize, i64)>) -> Result<Self, String> {
        let mut sum = Self::default();
        for (i, limb) in limbs {
            let fits = i < LIMBS && limb >> 32 == 0 || i == LIMBS - 1 && limb > i64::MIN / 2 && limb < i64::MAX / 2;
            if !fits || sum.limbs[i] != 0 {
                return Err(format!("limb {i} of an exact sum cannot be {limb}"));
            }
            sum.limbs[i] = limb;
        }
        Ok(sum)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn sum(values: &[f64]) -> ExactSum {
        let mut sum = ExactSum::default();
        for &value in values {
            sum.add(value);
        }
        sum
    }

    #[test]
    fn what_rounding_would_lose_is_kept() {
        assert_eq!(sum(&[1e300, 1.0, -1e300]).value(), 1.0);
        assert_eq!(sum(&[0.1; 10]).value(), 1.0);
        assert_eq!(sum(&[f64::from_bits(1), f64::MIN_POSITIVE]).value(), f64::from_bits(1 | 1 << 52));
        assert_eq!(sum(&[-2.5, 1.0]).value(), -1.5);
        assert_eq!(sum(&[f64::MAX, -f64::MAX]).value(), 0.0);
        assert_eq!(sum(&[f64::MAX]).value(), f64::MAX);
        assert_eq!(ExactSum::default().value(), 0.0);
    }

    proptest! {
        #[test]
        fn order_and_grouping_change_nothing(bits in prop::collection::vec(any::<u64>(), 1..40), cut in 0usize..40) {
            let values: Vec<f64> = bits.iter().map(|&b| f64::from_bits(b)).filter(|v| v.is_finite()).collect();
            let cut = cut.min(values.len());
            let (mut one, mut two) = (sum(&values), sum(&values[cut..]));
            two.merge(&sum(&values[..cut]));
            one.carry();
            prop_assert_eq!(&one, &two);
            let text = serde_json::to_string(&one).unwrap();
            prop_assert_eq!(serde_json::from_str::<ExactSum>(&text).unwrap().value().to_bits(), one.value().to_bits());
        }

        #[test]
        fn small_numbers_add_up_as_integers_do(values in prop::collection::vec(-1_000_000i64..1_000_000, 0..50)) {
            let floats: Vec<f64> = values.iter().map(|&v| v as f64 / 1024.0).collect();
            prop_assert_eq!(sum(&floats).value(), values.iter().sum::<i64>() as f64 / 1024.0);
        }
    }

    #[test]
    fn limbs_that_no_sum_has_are_refused() {
        assert!(serde_json::from_str::<ExactSum>("[[70, 1]]").is_err());
        assert!(serde_json::from_str::<ExactSum>("[[3, -1]]").is_err());
        assert!(serde_json::from_str::<ExactSum>("[[3, 1], [3, 1]]").is_err());
    }
}
