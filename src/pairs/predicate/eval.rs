//! The value of a condition in one row.

use std::cmp::Ordering;

use super::{Arithmetic, Compare, Expr, Like};

/// One value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::pairs) enum Value<'a> {
    /// Missing, or neither true nor false.
    Null,
    /// An integer.
    Integer(i128),
    /// A float, not NaN.
    Float(f64),
    /// A word.
    Text(&'a str),
    /// True or false.
    Truth(bool),
    /// Nanoseconds since 1970.
    Instant(i128),
}

impl Value<'_> {
    fn truth(self) -> Option<bool> {
        if let Self::Truth(truth) = self { Some(truth) } else { None }
    }

    fn of(truth: Option<bool>) -> Self {
        truth.map_or(Self::Null, Self::Truth)
    }

    fn float(value: f64) -> Self {
        if value.is_nan() { Self::Null } else { Self::Float(value) }
    }
}

/// The value of a tree whose parts fit.
pub(super) fn value<'a>(tree: &'a Expr, cell: &dyn Fn(usize) -> Value<'a>) -> Value<'a> {
    let of = |tree: &'a Expr| value(tree, cell);
    match tree {
        Expr::Column(c) => cell(*c),
        Expr::Null => Value::Null,
        Expr::Integer(value) => Value::Integer(*value),
        Expr::Float(value) => Value::Float(*value),
        Expr::Truth(truth) => Value::Truth(*truth),
        Expr::Text(text) => Value::Text(text),
        Expr::Instant(instant) => Value::Instant(*instant),
        Expr::Not(inner) => Value::of(of(inner).truth().map(|truth| !truth)),
        Expr::Minus(inner) => arithmetic(Arithmetic::Subtract, Value::Integer(0), of(inner)),
        Expr::And(sides) => Value::of(and(of(&sides[0]).truth(), || of(&sides[1]).truth())),
        Expr::Or(sides) => {
            // a OR b is NOT (NOT a AND NOT b), in three values too
            let not = |side: &'a Expr| of(side).truth().map(|truth| !truth);
            Value::of(and(not(&sides[0]), || not(&sides[1])).map(|truth| !truth))
        }
        Expr::Compare(op, sides) => Value::of(compare(*op, of(&sides[0]), of(&sides[1]))),
        Expr::Arithmetic(op, sides) => arithmetic(*op, of(&sides[0]), of(&sides[1])),
        Expr::Between(parts) => {
            let [value, low, high] = [&parts[0], &parts[1], &parts[2]].map(of);
            Value::of(and(compare(Compare::GreaterEqual, value, low), || compare(Compare::LessEqual, value, high)))
        }
        Expr::In(value, list) => {
            let value = of(value);
            let mut unknown = false;
            for item in list {
                match compare(Compare::Equal, value, of(item)) {
                    Some(true) => return Value::Truth(true),
                    Some(false) => {}
                    None => unknown = true,
                }
            }
            if unknown { Value::Null } else { Value::Truth(false) }
        }
        Expr::IsNull(inner) => Value::Truth(of(inner) == Value::Null),
        Expr::Is(truth, inner) => Value::Truth(of(inner) == Value::Truth(*truth)),
        Expr::Like(inner, pattern) => match of(inner) {
            Value::Text(text) => Value::Truth(like(pattern, text)),
            _ => Value::Null,
        },
    }
}

/// Three-valued AND; the second side is asked only when the first is not false.
fn and(a: Option<bool>, b: impl FnOnce() -> Option<bool>) -> Option<bool> {
    if a == Some(false) {
        return a;
    }
    match b() {
        Some(false) => Some(false),
        Some(true) => a,
        None => None,
    }
}

fn compare(op: Compare, a: Value<'_>, b: Value<'_>) -> Option<bool> {
    let order = order(a, b)?;
    Some(match op {
        Compare::Equal => order.is_eq(),
        Compare::Unequal => order.is_ne(),
        Compare::Less => order.is_lt(),
        Compare::LessEqual => order.is_le(),
        Compare::Greater => order.is_gt(),
        Compare::GreaterEqual => order.is_ge(),
    })
}

/// The order of two values of a kind; none when one is missing.
fn order(a: Value<'_>, b: Value<'_>) -> Option<Ordering> {
    match (a, b) {
        (Value::Integer(a), Value::Integer(b)) | (Value::Instant(a), Value::Instant(b)) => Some(a.cmp(&b)),
        (Value::Float(a), Value::Float(b)) => a.partial_cmp(&b),
        (Value::Integer(a), Value::Float(b)) => mixed(a, b),
        (Value::Float(a), Value::Integer(b)) => mixed(b, a).map(Ordering::reverse),
        (Value::Text(a), Value::Text(b)) => Some(a.cmp(b)),
        (Value::Truth(a), Value::Truth(b)) => Some(a.cmp(&b)),
        _ => None,
    }
}

/// An integer beside a float, exactly: 2⁵³ + 1 is not 2⁵³.
fn mixed(a: i128, b: f64) -> Option<Ordering> {
    if b.is_nan() {
        return None;
    }
    let whole = b.trunc(); // saturates as an i128, beyond every integer of a table
    let order = a.cmp(&(whole as i128));
    Some(order.then_with(|| 0.0.partial_cmp(&(b - whole)).unwrap_or(Ordering::Equal)))
}

/// Integers stay integers but for `/`; what overflows becomes a float; by zero is missing.
fn arithmetic(op: Arithmetic, a: Value<'_>, b: Value<'_>) -> Value<'static> {
    if let (Value::Integer(a), Value::Integer(b)) = (a, b) {
        let exact = match op {
            Arithmetic::Add => a.checked_add(b),
            Arithmetic::Subtract => a.checked_sub(b),
            Arithmetic::Multiply => a.checked_mul(b),
            Arithmetic::Divide => None,
            Arithmetic::Remainder if b == 0 => return Value::Null,
            Arithmetic::Remainder => Some(a.wrapping_rem(b)),
        };
        if let Some(exact) = exact {
            return Value::Integer(exact);
        }
    }
    let number = |value| match value {
        Value::Integer(value) => Some(value as f64),
        Value::Float(value) => Some(value),
        _ => None,
    };
    let (Some(a), Some(b)) = (number(a), number(b)) else { return Value::Null };
    match op {
        Arithmetic::Add => Value::float(a + b),
        Arithmetic::Subtract => Value::float(a - b),
        Arithmetic::Multiply => Value::float(a * b),
        Arithmetic::Divide | Arithmetic::Remainder if b == 0.0 => Value::Null,
        Arithmetic::Divide => Value::float(a / b),
        Arithmetic::Remainder => Value::float(a % b),
    }
}

/// Whether a text fits a pattern: after a mismatch the last `%` takes one character more.
fn like(pattern: &[Like], text: &str) -> bool {
    let text: Vec<char> = text.chars().collect();
    let (mut p, mut t, mut last) = (0, 0, None);
    while t < text.len() {
        match pattern.get(p) {
            Some(Like::Any) => {
                last = Some((p, t));
                p += 1;
            }
            Some(Like::One) => (p, t) = (p + 1, t + 1),
            Some(Like::This(c)) if *c == text[t] => (p, t) = (p + 1, t + 1),
            _ => match &mut last {
                Some((any, from)) => {
                    *from += 1;
                    (p, t) = (*any + 1, *from);
                }
                None => return false,
            },
        }
    }
    pattern[p..].iter().all(|piece| *piece == Like::Any)
}
