//! Which rows are wanted: an SQL condition over columns, with SQL's three truth values.
//!
//! [`parse`] makes the tree, [`bind`] checks it against the columns' kinds, [`eval`] asks it for each row. A missing cell
//! and NaN are NULL; a condition that is neither true nor false keeps no row.

mod bind;
mod eval;
mod parse;

pub(super) use eval::Value;

use super::PairsError;

/// What is compared: columns by number, values, conditions.
#[derive(Clone, Debug, PartialEq)]
enum Expr {
    Column(usize),
    Null,
    Integer(i128),
    Float(f64),
    Truth(bool),
    Text(String),
    Instant(i128),
    Not(Box<Self>),
    Minus(Box<Self>),
    And(Box<[Self; 2]>),
    Or(Box<[Self; 2]>),
    Compare(Compare, Box<[Self; 2]>),
    Arithmetic(Arithmetic, Box<[Self; 2]>),
    /// Value, lowest, highest.
    Between(Box<[Self; 3]>),
    In(Box<Self>, Vec<Self>),
    IsNull(Box<Self>),
    Is(bool, Box<Self>),
    Like(Box<Self>, Vec<Like>),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Compare {
    Equal,
    Unequal,
    Less,
    LessEqual,
    Greater,
    GreaterEqual,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Arithmetic {
    Add,
    Subtract,
    Multiply,
    Divide,
    Remainder,
}

/// A piece of a pattern of LIKE.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Like {
    Any,
    One,
    This(char),
}

/// What a column holds, or an expression is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Integers or floats, which compare with each other by their exact values.
    Number,
    /// Words.
    Text,
    /// True and false.
    Truth,
    /// Instants, in nanoseconds since 1970.
    Instant,
    /// NULL, which is of every kind.
    Null,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Number => "a number",
            Self::Text => "text",
            Self::Truth => "true or false",
            Self::Instant => "a date",
            Self::Null => "NULL",
        }
    }
}

/// A condition over named columns.
#[derive(Clone, Debug, PartialEq)]
pub struct Predicate {
    text: String,
    columns: Vec<String>,
    root: Expr,
}

impl Predicate {
    /// Reads `a > 3 AND b IS NOT NULL`.
    ///
    /// # Errors
    /// [`PairsError::Where`] that says what is wrong, and what there is.
    pub fn parse(text: &str) -> Result<Self, PairsError> {
        let (root, columns) = parse::parse(text).map_err(|message| fault(text, message))?;
        Ok(Self { text: text.to_owned(), columns, root })
    }

    /// As it was written.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The columns that it names, each once.
    pub fn columns(&self) -> &[String] {
        &self.columns
    }

    /// Checks it against what the columns hold, in the order of [`Self::columns`].
    ///
    /// # Errors
    /// [`PairsError::Where`] when things are compared that are no match.
    pub(super) fn bind(&self, kinds: &[Kind]) -> Result<Bound, PairsError> {
        bind::bind(&self.root, &self.columns, kinds).map(Bound).map_err(|message| fault(&self.text, message))
    }
}

/// A condition whose parts fit each other and the columns.
#[derive(Clone, Debug)]
pub(super) struct Bound(Expr);

impl Bound {
    /// Whether the condition is true of a row, of which `cell` gives the value of column c.
    pub(super) fn keeps<'a>(&'a self, cell: &dyn Fn(usize) -> Value<'a>) -> bool {
        eval::value(&self.0, cell) == Value::Truth(true)
    }
}

fn fault(text: &str, message: String) -> PairsError {
    PairsError::Where { text: text.to_owned(), message }
}

#[cfg(test)]
mod tests;
