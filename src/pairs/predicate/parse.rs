//! Text to tree. The grammar is that of the sqlparser crate; what is not listed in [`SUPPORTED`] is refused.

use sqlparser::ast::{self, BinaryOperator, UnaryOperator};
use sqlparser::dialect::GenericDialect;
use sqlparser::parser::{Parser, ParserError};
use sqlparser::tokenizer::Token;

use super::{Arithmetic, Compare, Expr, Like};

/// What there is.
const SUPPORTED: &str = "supported are = <> < <= > >=, AND, OR, NOT, BETWEEN, IN (…), IS [NOT] NULL, IS [NOT] TRUE, LIKE, + - * / %, numbers, 'text', TRUE, FALSE, NULL, columns and \"columns with blanks\"";
/// Longest text, bytes, and deepest tree: it is walked by calls.
const LENGTH: usize = 10_000;
const DEPTH: usize = 100;

/// The tree, and the columns by number.
pub(super) fn parse(text: &str) -> Result<(Expr, Vec<String>), String> {
    if text.len() > LENGTH {
        return Err(format!("expected at most {LENGTH} bytes, found {}", text.len()));
    }
    let said = |error: ParserError| match error {
        ParserError::RecursionLimitExceeded => format!("nested deeper than {DEPTH}"),
        ParserError::TokenizerError(message) | ParserError::ParserError(message) => {
            format!("not an SQL condition: {message}")
        }
    };
    let mut parser = Parser::new(&GenericDialect {}).with_recursion_limit(DEPTH).try_with_sql(text).map_err(said)?;
    let tree = parser.parse_expr().map_err(said)?;
    let rest = parser.peek_token();
    if rest.token != Token::EOF {
        return Err(format!("not an SQL condition: expected its end, found {rest}"));
    }
    let mut columns = Vec::new();
    let root = expr(tree, &mut columns, 0)?;
    Ok((root, columns))
}

fn expr(tree: ast::Expr, columns: &mut Vec<String>, depth: usize) -> Result<Expr, String> {
    if depth > DEPTH {
        return Err(format!("nested deeper than {DEPTH}: write IN (…) in place of many OR"));
    }
    let mut inner = |tree: Box<ast::Expr>| expr(*tree, columns, depth + 1);
    let not = |negated: bool, tree: Expr| if negated { Expr::Not(Box::new(tree)) } else { tree };
    Ok(match tree {
        ast::Expr::Nested(tree) => inner(tree)?,
        ast::Expr::Identifier(name) => column(name.value, columns),
        ast::Expr::CompoundIdentifier(names) => {
            column(names.into_iter().map(|name| name.value).collect::<Vec<_>>().join("."), columns)
        }
        ast::Expr::Value(value) => literal(value.value)?,
        ast::Expr::TypedString(text) => literal(text.value.value)?,
        ast::Expr::UnaryOp { op: UnaryOperator::Not, expr } => Expr::Not(Box::new(inner(expr)?)),
        ast::Expr::UnaryOp { op: UnaryOperator::Plus, expr } => inner(expr)?,
        ast::Expr::UnaryOp { op: UnaryOperator::Minus, expr } => match inner(expr)? {
            Expr::Integer(value) => Expr::Integer(-value), // literals are not negative, and i64::MIN is none
            Expr::Float(value) => Expr::Float(-value),
            other => Expr::Minus(Box::new(other)),
        },
        ast::Expr::BinaryOp { left, op, right } => binary(op, Box::new([inner(left)?, inner(right)?]))?,
        ast::Expr::Between { expr, negated, low, high } => {
            not(negated, Expr::Between(Box::new([inner(expr)?, inner(low)?, inner(high)?])))
        }
        ast::Expr::InList { expr, list, negated } => {
            let value = Box::new(inner(expr)?);
            let list = list.into_iter().map(|item| inner(Box::new(item))).collect::<Result<_, _>>()?;
            not(negated, Expr::In(value, list))
        }
        ast::Expr::IsNull(tree) => Expr::IsNull(Box::new(inner(tree)?)),
        ast::Expr::IsNotNull(tree) => not(true, Expr::IsNull(Box::new(inner(tree)?))),
        ast::Expr::IsTrue(tree) => Expr::Is(true, Box::new(inner(tree)?)),
        ast::Expr::IsNotTrue(tree) => not(true, Expr::Is(true, Box::new(inner(tree)?))),
        ast::Expr::IsFalse(tree) => Expr::Is(false, Box::new(inner(tree)?)),
        ast::Expr::IsNotFalse(tree) => not(true, Expr::Is(false, Box::new(inner(tree)?))),
        ast::Expr::Like { negated, any: false, expr, pattern, escape_char } => {
            let Expr::Text(pattern) = inner(pattern)? else {
                return Err("LIKE needs a 'pattern' of text".to_owned());
            };
            let escape = match escape_char.map(|escape| literal(escape.value)).transpose()? {
                Some(Expr::Text(escape)) => escape.chars().next(),
                _ => None,
            };
            not(negated, Expr::Like(Box::new(inner(expr)?), like(&pattern, escape)))
        }
        other => return Err(format!("{} is not supported; {SUPPORTED}", short(&other))),
    })
}

/// The first characters of what cannot be used.
fn short(tree: &ast::Expr) -> String {
    let text = tree.to_string();
    if text.chars().count() > 60 { text.chars().take(60).collect::<String>() + "…" } else { text }
}

fn column(name: String, columns: &mut Vec<String>) -> Expr {
    let known = columns.iter().position(|column| *column == name);
    Expr::Column(known.unwrap_or_else(|| {
        columns.push(name);
        columns.len() - 1
    }))
}

fn literal(value: ast::Value) -> Result<Expr, String> {
    Ok(match value {
        ast::Value::Null => Expr::Null,
        ast::Value::Boolean(truth) => Expr::Truth(truth),
        ast::Value::SingleQuotedString(text) => Expr::Text(text),
        ast::Value::Number(digits, _) => match (digits.parse(), digits.parse::<f64>()) {
            (Ok(integer), _) => Expr::Integer(integer),
            (_, Ok(float)) if float.is_finite() => Expr::Float(float),
            _ => return Err(format!("{digits} is no number that a column can hold")),
        },
        other => return Err(format!("{other} is not supported; {SUPPORTED}")),
    })
}

fn binary(op: BinaryOperator, sides: Box<[Expr; 2]>) -> Result<Expr, String> {
    let compare = match op {
        BinaryOperator::And => return Ok(Expr::And(sides)),
        BinaryOperator::Or => return Ok(Expr::Or(sides)),
        BinaryOperator::Eq => Compare::Equal,
        BinaryOperator::NotEq => Compare::Unequal,
        BinaryOperator::Lt => Compare::Less,
        BinaryOperator::LtEq => Compare::LessEqual,
        BinaryOperator::Gt => Compare::Greater,
        BinaryOperator::GtEq => Compare::GreaterEqual,
        other => return Ok(Expr::Arithmetic(arithmetic(&other)?, sides)),
    };
    Ok(Expr::Compare(compare, sides))
}

fn arithmetic(op: &BinaryOperator) -> Result<Arithmetic, String> {
    match op {
        BinaryOperator::Plus => Ok(Arithmetic::Add),
        BinaryOperator::Minus => Ok(Arithmetic::Subtract),
        BinaryOperator::Multiply => Ok(Arithmetic::Multiply),
        BinaryOperator::Divide => Ok(Arithmetic::Divide),
        BinaryOperator::Modulo => Ok(Arithmetic::Remainder),
        other => Err(format!("{other} is not supported; {SUPPORTED}")),
    }
}

fn like(pattern: &str, escape: Option<char>) -> Vec<Like> {
    let mut out = Vec::new();
    let mut chars = pattern.chars();
    while let Some(c) = chars.next() {
        out.push(match c {
            c if Some(c) == escape => chars.next().map_or(Like::This(c), Like::This),
            '%' => Like::Any,
            '_' => Like::One,
            c => Like::This(c),
        });
    }
    out
}
