//! Predicates against `SQLite`'s answers, against a naive reading, and what they refuse.

use proptest::prelude::*;
use serde_json::Value as Json;

use super::*;
use crate::pairs::dates;

/// Columns a (number), s (text), t (truth), d (date).
const KINDS: [(&str, Kind); 4] = [("a", Kind::Number), ("s", Kind::Text), ("t", Kind::Truth), ("d", Kind::Instant)];

fn bound(text: &str) -> Result<(Bound, Vec<String>), String> {
    let predicate = Predicate::parse(text).map_err(|e| e.to_string())?;
    let kind = |name: &String| KINDS.iter().find(|(known, _)| known == name).map_or(Kind::Null, |(_, kind)| *kind);
    let kinds: Vec<Kind> = predicate.columns().iter().map(kind).collect();
    let bound = predicate.bind(&kinds).map_err(|e| e.to_string())?;
    Ok((bound, predicate.columns().to_vec()))
}

/// Whether a condition keeps the row a = 5, s = 'it''s', t = true, d = 2024-01-31T12:00Z.
fn keeps(text: &str) -> bool {
    let (bound, columns) = bound(text).unwrap();
    bound.keeps(&|c| match columns[c].as_str() {
        "a" => Value::Integer(5),
        "s" => Value::Text("it's"),
        "t" => Value::Truth(true),
        "d" => Value::Instant(dates::parse("2024-01-31T12:00:00Z").unwrap()),
        _ => Value::Null,
    })
}

#[test]
fn sqlite_keeps_the_same_rows() {
    // datasets/tables/forms/make.py asked it
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/datasets/tables/forms/where.json");
    let json: Json = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let rows = json["rows"].as_array().unwrap();
    let cases = json["cases"].as_array().unwrap();
    assert_eq!((rows.len(), cases.len()), (60, 300));
    for case in cases {
        let (text, expected) = (case[0].as_str().unwrap(), &case[1]);
        let predicate = Predicate::parse(text).unwrap();
        let kind = |name: &String| if name == "s" { Kind::Text } else { Kind::Number };
        let bound = predicate.bind(&predicate.columns().iter().map(kind).collect::<Vec<_>>()).unwrap();
        let keeps = |row: &&Json| {
            bound.keeps(&|c| {
                let cell = &row[["id", "a", "b", "s"].iter().position(|name| predicate.columns()[c] == *name).unwrap()];
                match cell {
                    Json::Number(number) if number.is_i64() => Value::Integer(number.as_i64().unwrap().into()),
                    Json::Number(number) => Value::Float(number.as_f64().unwrap()),
                    Json::String(text) => Value::Text(text),
                    _ => Value::Null,
                }
            })
        };
        let found: Vec<Json> = rows.iter().filter(keeps).map(|row| row[0].clone()).collect();
        assert_eq!(Json::from(found), *expected, "{text}");
    }
}

#[test]
fn what_sql_says_of_one_row() {
    for text in [
        "a = 5",
        "a == 5 AND (s = 'it''s')",
        "t",
        "t = TRUE AND NOT t = FALSE",
        "none IS NULL AND (none > 3) IS NOT TRUE",
        "none IN (1, 2) IS NULL AND a NOT IN (1, 2)",
        "a / 2 = 2.5 AND a % 2 = 1 AND -a + 1 = -4 AND a - -1 = 6",
        "(a / 0) IS NULL AND (a % 0) IS NULL",
        "d > '2024-01-31' AND d < '2024-01-31T12:00:01' AND d = '2024-01-31 13:00+01:00'",
        "d BETWEEN '2024-01-01' AND DATE '2024-02-01'",
        "d IN ('2024-01-31T12:00')",
        "s LIKE 'it_s' AND s LIKE '%''%' AND s NOT LIKE 'it' AND s LIKE 'i%t%s'",
        "'50%' LIKE '50!%' ESCAPE '!' AND NOT '505' LIKE '50!%' ESCAPE '!'",
        "9007199254740993 > 9007199254740992.0",
        "\"a\" > 4.999 AND 9223372036854775807 + 1 > 9223372036854775807",
        "none OR t",
    ] {
        assert!(keeps(text), "{text}");
    }
    for text in
        ["NOT t", "none", "none = none", "NOT none", "none AND t", "a <> 5", "none NOT IN (1)", "a NOT IN (1, none)"]
    {
        assert!(!keeps(text), "{text}");
    }
}

#[test]
fn what_is_no_condition_says_why() {
    for (text, message) in [
        ("", "not an SQL condition: "),
        ("a >", "not an SQL condition: "),
        ("a > 3 b", "not an SQL condition: expected its end, found b"),
        ("'a", "not an SQL condition: Unterminated string literal"),
        ("a + 1", "expected a condition, found an expression (a number)"),
        ("a", "expected a condition, found column \"a\" (a number)"),
        ("s > 3", "column \"s\" (text) cannot be compared with 3 (a number)"),
        ("t = 1", "column \"t\" (true or false) cannot be compared with 1 (a number)"),
        ("a IN (1, 'b')", "column \"a\" (a number) cannot be compared with 'b' (text)"),
        ("s + 1 > 3", "expected a number, found column \"s\" (text)"),
        ("-t > 3", "expected a number, found column \"t\" (true or false)"),
        ("a LIKE 'x'", "LIKE needs text, found column \"a\" (a number)"),
        ("s LIKE s", "LIKE needs a 'pattern' of text"),
        ("d > 'soon'", "'soon' stands beside column \"d\" (a date), expected a date such as '2024-01-31'"),
        ("d > s", "column \"d\" (a date) cannot be compared with column \"s\" (text)"),
        ("upper(s) = 'A'", "upper(s) is not supported; supported are = <> <"),
        ("a IN (SELECT 1)", "is not supported; supported are"),
        ("s || 'x' = 'y'", "|| is not supported; supported are"),
        ("a > 1e999", "1e999 is no number that a column can hold"),
        ("CASE WHEN t THEN t END", "is not supported"),
    ] {
        let error = bound(text).map(|_| ()).unwrap_err();
        assert!(error.starts_with(&format!("--where {text:?}: ")) && error.contains(message), "{text}: {error}");
    }
}

#[test]
fn hostile_text_is_an_error_and_overflows_nothing() {
    let deep = |open: &str, close: &str, n: usize| format!("{}t{}", open.repeat(n), close.repeat(n));
    for text in
        [deep("(", ")", 4000), deep("NOT ", "", 2400), deep("- ", "", 4000), format!("t{}", " OR t".repeat(1900))]
    {
        let error = bound(&text).map(|_| ()).unwrap_err();
        // where the parser tries two readings it tells of the second
        let told = ["nested deeper than 100", "expected its end, found NOT"].iter().any(|text| error.contains(text));
        assert!(told, "{}", &error[error.len() - 200..]);
    }
    let long = bound(&format!("a IN ({})", "1, ".repeat(4000))).map(|_| ()).unwrap_err();
    assert!(long.ends_with("expected at most 10000 bytes, found 12007"), "{}", &long[long.len() - 100..]);
    assert!(keeps(&format!("t{}", " AND t".repeat(90))));
    // a pattern of many wildcards takes no longer than text times pattern
    let pattern = "%a".repeat(2000);
    assert!(!keeps(&format!("'{}' LIKE '{pattern}b'", "a".repeat(3000))));
}

/// The value of a condition for (a, b).
type Meaning = fn(Option<i64>, Option<i64>) -> Option<bool>;

/// A condition as text, and a reading of its own.
fn condition() -> impl Strategy<Value = (String, Meaning)> {
    type Case = (&'static str, Meaning);
    let cases: [Case; 8] = [
        ("a < b", |a, b| Some(a? < b?)),
        ("a = b", |a, b| Some(a? == b?)),
        ("a BETWEEN -1 AND b", |a, b| match (a.map(|a| a >= -1), a.zip(b).map(|(a, b)| a <= b)) {
            (Some(false), _) | (_, Some(false)) => Some(false),
            (low, high) => low.zip(high).map(|_| true),
        }),
        ("a IN (0, b)", |a, b| if a? == 0 { Some(true) } else { Some(a? == b?) }),
        ("a IS NULL", |a, _| Some(a.is_none())),
        ("a + b > 2", |a, b| Some(a? + b? > 2)),
        ("a * 2 - b <= 1", |a, b| Some(a? * 2 - b? <= 1)),
        ("b % 3 = 0", |_, b| Some(b? % 3 == 0)),
    ];
    (0..cases.len()).prop_map(move |i| (cases[i].0.to_owned(), cases[i].1))
}

proptest! {
    #[test]
    fn a_predicate_keeps_what_a_naive_filter_keeps(
        parts in prop::collection::vec((condition(), any::<bool>(), any::<bool>()), 1..6),
        rows in prop::collection::vec((prop::option::of(-4_i64..5), prop::option::of(-4_i64..5)), 1..30),
    ) {
        let mut text = String::new();
        for (i, ((condition, _), negated, and)) in parts.iter().enumerate() {
            let link = if i == 0 { "" } else if *and { " AND " } else { " OR " };
            let not = if *negated { "NOT " } else { "" };
            text = if i == 0 { format!("{not}({condition})") } else { format!("({text}){link}{not}({condition})") };
        }
        let naive = |a: Option<i64>, b: Option<i64>| {
            let mut value = None;
            for (i, ((_, meaning), negated, and)) in parts.iter().enumerate() {
                let part = meaning(a, b).map(|truth| truth != *negated);
                value = match (i, and, value, part) {
                    (0, ..) => part,
                    (_, true, Some(false), _) | (_, true, _, Some(false)) => Some(false),
                    (_, false, Some(true), _) | (_, false, _, Some(true)) => Some(true),
                    (_, _, Some(_), part) => part,
                    (_, _, None, _) => None,
                };
            }
            value == Some(true)
        };
        let predicate = Predicate::parse(&text).unwrap();
        let bound = predicate.bind(&vec![Kind::Number; predicate.columns().len()]).unwrap();
        for &(a, b) in &rows {
            let cell = |c: usize| {
                let value = if predicate.columns()[c] == "a" { a } else { b };
                value.map_or(Value::Null, |value: i64| Value::Integer(value.into()))
            };
            prop_assert_eq!(bound.keeps(&cell), naive(a, b), "{}: {:?} {:?}", text, a, b);
        }
    }
}
