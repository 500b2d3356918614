//! Whether the parts of a condition fit each other; text beside dates becomes dates.

use super::{Expr, Kind};
use crate::pairs::dates;

/// The tree with its dates, if it is a condition.
pub(super) fn bind(root: &Expr, columns: &[String], kinds: &[Kind]) -> Result<Expr, String> {
    let binder = Binder { columns, kinds };
    let mut root = root.clone();
    binder.condition(&mut root)?;
    Ok(root)
}

struct Binder<'a> {
    columns: &'a [String],
    kinds: &'a [Kind],
}

impl Binder<'_> {
    fn condition(&self, tree: &mut Expr) -> Result<(), String> {
        match self.kind(tree)? {
            Kind::Truth | Kind::Null => Ok(()),
            kind => Err(format!("expected a condition, found {}", self.say(tree, kind))),
        }
    }

    fn number(&self, tree: &mut Expr) -> Result<(), String> {
        match self.kind(tree)? {
            Kind::Number | Kind::Null => Ok(()),
            kind => Err(format!("expected a number, found {}", self.say(tree, kind))),
        }
    }

    /// The kind of a tree whose parts fit.
    fn kind(&self, tree: &mut Expr) -> Result<Kind, String> {
        Ok(match tree {
            Expr::Column(c) => self.kinds[*c],
            Expr::Null => Kind::Null,
            Expr::Integer(_) | Expr::Float(_) => Kind::Number,
            Expr::Truth(_) => Kind::Truth,
            Expr::Text(_) => Kind::Text,
            Expr::Instant(_) => Kind::Instant,
            Expr::Not(inner) | Expr::Is(_, inner) => {
                self.condition(inner)?;
                Kind::Truth
            }
            Expr::And(sides) | Expr::Or(sides) => {
                sides.iter_mut().try_for_each(|side| self.condition(side))?;
                Kind::Truth
            }
            Expr::Minus(inner) => {
                self.number(inner)?;
                Kind::Number
            }
            Expr::Arithmetic(_, sides) => {
                sides.iter_mut().try_for_each(|side| self.number(side))?;
                Kind::Number
            }
            Expr::Compare(_, sides) => {
                let [left, right] = &mut **sides;
                self.alike(left, [right])?
            }
            Expr::Between(parts) => {
                let [value, low, high] = &mut **parts;
                self.alike(value, [low, high])?
            }
            Expr::In(value, list) => self.alike(value, list)?,
            Expr::IsNull(inner) => {
                self.kind(inner)?;
                Kind::Truth
            }
            Expr::Like(inner, _) => match self.kind(inner)? {
                Kind::Text | Kind::Null => Kind::Truth,
                kind => return Err(format!("LIKE needs text, found {}", self.say(inner, kind))),
            },
        })
    }

    /// Checks that a value can be compared with others; text beside a date must be one, and becomes it.
    fn alike<'e>(&self, value: &mut Expr, others: impl IntoIterator<Item = &'e mut Expr>) -> Result<Kind, String> {
        for other in others {
            let kinds = (self.kind(value)?, self.kind(other)?);
            match kinds {
                (Kind::Null, _) | (_, Kind::Null) => {}
                (Kind::Instant, Kind::Text) => self.date(other, value)?,
                (Kind::Text, Kind::Instant) => self.date(value, other)?,
                (a, b) if a == b => {}
                (a, b) => {
                    return Err(format!("{} cannot be compared with {}", self.say(value, a), self.say(other, b)));
                }
            }
        }
        Ok(Kind::Truth)
    }

    fn date(&self, text: &mut Expr, beside: &Expr) -> Result<(), String> {
        let Expr::Text(written) = &*text else {
            let (a, b) = (self.say(beside, Kind::Instant), self.say(text, Kind::Text));
            return Err(format!("{a} cannot be compared with {b}"));
        };
        let instant = dates::parse(written).ok_or_else(|| {
            let beside = self.say(beside, Kind::Instant);
            format!(
                "'{written}' stands beside {beside}, expected a date such as '2024-01-31' or '2024-01-31T12:00:00Z'"
            )
        })?;
        *text = Expr::Instant(instant);
        Ok(())
    }

    fn say(&self, tree: &Expr, kind: Kind) -> String {
        match tree {
            Expr::Column(c) => format!("column {:?} ({})", self.columns[*c], kind.name()),
            Expr::Integer(value) => format!("{value} (a number)"),
            Expr::Float(value) => format!("{value} (a number)"),
            Expr::Text(text) => format!("'{text}' (text)"),
            Expr::Truth(truth) => format!("{truth} (true or false)"),
            _ => format!("an expression ({})", kind.name()),
        }
    }
}
