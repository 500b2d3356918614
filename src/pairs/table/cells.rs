//! What the cells of a text column are: numbers, truth values, dates or words. The whole column decides, and it is one of
//! these or an error: a stray cell never makes words of numbers in silence.

use std::path::Path;

use polars::prelude::{Column, DataType, NamedFrom as _, Series, StringChunked, TimeUnit};

use crate::pairs::{PairsError, dates};

/// What stands for no number and no date, in any case.
const MISSING: [&str; 13] = ["", "na", "n/a", "nan", "null", "none", "-", "#n/a", "<na>", "nat", "n.a.", ".", "?"];
/// What stands for no word, in this case: "none" may be a category.
const NO_WORD: [&str; 11] = ["", "NA", "N/A", "NaN", "null", "NULL", "#N/A", "<NA>", "NaT", "n.a.", "N.A."];

fn is_missing(cell: &str) -> bool {
    cell.len() <= 4 && MISSING.iter().any(|token| token.eq_ignore_ascii_case(cell))
}

/// What one cell is.
#[derive(Clone, Copy, PartialEq)]
enum Cell {
    Missing,
    Integer,
    Float,
    Truth,
    Date,
    Word,
}

impl Cell {
    fn of(cell: &str) -> Self {
        if is_missing(cell) {
            Self::Missing
        } else if cell.parse::<i64>().is_ok() || cell.parse::<u64>().is_ok() {
            Self::Integer
        } else if cell.parse::<f64>().is_ok() {
            Self::Float
        } else if truth(cell).is_some() {
            Self::Truth
        } else if dates::parse(cell).is_some() {
            Self::Date
        } else {
            Self::Word
        }
    }
}

fn truth(cell: &str) -> Option<bool> {
    [("true", true), ("false", false)].into_iter().find(|(word, _)| cell.eq_ignore_ascii_case(word)).map(|(_, t)| t)
}

/// A number or a date in a form that is not read, by what it looks like.
fn other_form(cell: &str) -> Option<&'static str> {
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let parts = |mark: char| cell.split(mark).map(digits).collect::<Vec<_>>();
    let all = |mark: char, counts: std::ops::RangeInclusive<usize>| {
        let parts = parts(mark);
        counts.contains(&parts.len()) && parts.iter().all(|&part| part)
    };
    let ends_in_year = cell.rsplit(['/', '.']).next().is_some_and(|year| year.len() == 4);
    if all('/', 3..=3) || (all('.', 3..=3) && ends_in_year) {
        return Some("a date, expected as 2024-01-31");
    }
    if all(':', 2..=3) {
        return Some("a time of day, expected with its date as 2024-01-31T08:30:00, or as seconds");
    }
    let number = cell.trim_start_matches(['-', '+']);
    let plain = number.chars().all(|c| c.is_ascii_digit() || c == '.' || c == ',');
    (plain && number.contains(',') && number.starts_with(|c: char| c.is_ascii_digit()))
        .then_some("a number with a comma, expected as 1234.5")
}

/// The column with the type of its cells; `as_words`: whatever they are, they are words. Only the rows `kept` decide, if
/// some are: in the others a cell that does not fit is missing.
pub(super) fn typed(column: &Column, as_words: bool, kept: Option<&[bool]>, path: &Path) -> Result<Column, PairsError> {
    let Ok(cells) = column.str() else { return Ok(column.clone()) };
    let name = column.name().clone();
    if as_words {
        return Ok(words(cells, str::is_empty).into());
    }
    let trimmed = || cells.iter().map(|cell| cell.unwrap_or("").trim());
    let mut counts = [0; 6];
    let decides = |row: usize| kept.is_none_or(|kept| kept[row]);
    let deciding = || trimmed().enumerate().filter(|(row, _)| decides(*row));
    deciding().for_each(|(_, cell)| counts[Cell::of(cell) as usize] += 1);
    let [_, integers, floats, truths, days, _] = counts;
    let present = counts.iter().sum::<usize>() - counts[Cell::Missing as usize];
    let numbers = integers + floats;
    let number = |cell: &str| if is_missing(cell) { None } else { cell.parse::<f64>().ok() };
    let series = if present == 0 {
        Series::full_null(name, cells.len(), &DataType::Float64)
    } else if integers == present && deciding().any(|(_, cell)| !is_missing(cell) && cell.parse::<i64>().is_err()) {
        if deciding().all(|(_, cell)| is_missing(cell) || cell.parse::<u64>().is_ok()) {
            Series::new(name, trimmed().map(|cell| cell.parse::<u64>().ok()).collect::<Vec<_>>())
        } else {
            Series::new(name, trimmed().map(number).collect::<Vec<_>>())
        }
    } else if integers == present {
        Series::new(name, trimmed().map(|cell| cell.parse::<i64>().ok()).collect::<Vec<_>>())
    } else if numbers == present {
        Series::new(name, trimmed().map(number).collect::<Vec<_>>())
    } else if truths == present {
        Series::new(name, trimmed().map(truth).collect::<Vec<_>>())
    } else if days == present {
        instants(column, &trimmed().map(dates::parse).collect::<Vec<_>>(), path)?
    } else if 2 * numbers > present || 2 * days > present {
        let (expected, count) = if 2 * numbers > present { ("a number", numbers) } else { ("a date", days) };
        let fits = |cell: &Cell| match cell {
            Cell::Missing => true,
            Cell::Date => 2 * days > present,
            Cell::Integer | Cell::Float => 2 * numbers > present,
            _ => false,
        };
        let stray = deciding().find(|(_, cell)| !fits(&Cell::of(cell)));
        let (row, found) = stray.map_or((0, String::new()), |(row, cell)| (row + 1, cell.to_owned()));
        let (name, path) = (name.to_string(), path.to_owned());
        let expected = format!("{expected}, as in {count} of {present} rows");
        return Err(PairsError::Stray { name, row, found, expected, path });
    } else {
        let other = || deciding().filter_map(|(row, cell)| Some((row, cell, other_form(cell)?)));
        if let Some((row, cell, looks)) = other().next().filter(|_| 2 * other().count() > present) {
            let (name, path) = (name.to_string(), path.to_owned());
            return Err(PairsError::OtherForm { name, row: row + 1, found: cell.to_owned(), looks, path });
        }
        words(cells, |cell| NO_WORD.contains(&cell))
    };
    Ok(series.into())
}

fn words(cells: &StringChunked, is_missing: impl Fn(&str) -> bool) -> Series {
    let word = |cell: Option<&str>| cell.filter(|cell| !is_missing(cell.trim())).map(ToOwned::to_owned);
    Series::new(cells.name().clone(), cells.iter().map(word).collect::<Vec<_>>())
}

/// Instants in microseconds, or in nanoseconds when some have those.
fn instants(column: &Column, values: &[Option<i128>], path: &Path) -> Result<Series, PairsError> {
    let fine = values.iter().flatten().any(|v| v % 1000 != 0);
    let (unit, divisor) = if fine { (TimeUnit::Nanoseconds, 1) } else { (TimeUnit::Microseconds, 1000) };
    let mut out = Vec::with_capacity(values.len());
    for (row, value) in values.iter().enumerate() {
        match value.map(|v| i64::try_from(v / divisor)) {
            None => out.push(None),
            Some(Ok(value)) => out.push(Some(value)),
            // beyond the years 1677 to 2262
            Some(Err(_)) => {
                let (name, path) = (column.name().to_string(), path.to_owned());
                return Err(PairsError::Far { name, row: row + 1, path });
            }
        }
    }
    let series = Series::new(column.name().clone(), out).cast(&DataType::Datetime(unit, None));
    series.map_err(super::form::unreadable("text", path))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(cells: &[&str]) -> Result<(String, Vec<String>), String> {
        let column = Column::new("a".into(), cells);
        let typed = typed(&column, false, None, Path::new("t.csv")).map_err(|e| e.to_string())?;
        let values = (0..typed.len()).map(|i| typed.get(i).unwrap().to_string()).collect();
        Ok((typed.dtype().to_string(), values))
    }

    #[test]
    fn the_whole_column_decides() {
        let cases: [(&[&str], &str, &[&str]); 8] = [
            (&["1", " 2", "", "NA"], "i64", &["1", "2", "null", "null"]),
            (&["1", "-", "2.5e1", "N/A"], "f64", &["1.0", "null", "25.0", "null"]),
            (&["True", "FALSE", "None"], "bool", &["true", "false", "null"]),
            (&["9223372036854775807", "9223372036854775806"], "i64", &["9223372036854775807", "9223372036854775806"]),
            (&["a", "NA", "none", ""], "str", &["\"a\"", "null", "\"none\"", "null"]),
            (&["2024-01-31", "null"], "datetime[μs]", &["2024-01-31 00:00:00", "null"]),
            (&["2024-01-31T00:00:00.000000001Z"], "datetime[ns]", &["2024-01-31 00:00:00.000000001"]),
            (&["", "nan"], "f64", &["null", "null"]),
        ];
        for (cells, kind, values) in cases {
            let values = values.iter().map(ToString::to_string).collect();
            assert_eq!(of(cells).unwrap(), (kind.to_owned(), values), "{cells:?}");
        }
    }

    #[test]
    fn numbers_and_dates_in_other_forms_are_named_and_missing_ones_known() {
        for (cell, looks) in [
            ("0,5", "a number with a comma, expected as 1234.5"),
            ("1.234,5", "a number with a comma, expected as 1234.5"),
            ("-1,000", "a number with a comma, expected as 1234.5"),
            ("31/01/2024", "a date, expected as 2024-01-31"),
            ("31.12.2024", "a date, expected as 2024-01-31"),
            ("08:30", "a time of day, expected with its date as 2024-01-31T08:30:00, or as seconds"),
        ] {
            let expected = format!(
                "column \"a\", row 2: {cell:?} looks like {looks}; rewrite the column so, or give --words a to take it as words: t.csv"
            );
            assert_eq!(of(&["", cell, "x", cell]).unwrap_err(), expected);
        }
        assert_eq!(of(&["a,b", "1.2.30", "v1.2"]).unwrap().0, "str");
        let missing = ["1", "#N/A", "<NA>", "NaT", "n.a.", ".", "?"];
        assert_eq!(
            of(&missing).unwrap(),
            ("i64".to_owned(), ["1"].iter().chain(&["null"; 6]).map(ToString::to_string).collect())
        );
        assert_eq!(of(&["a", "#N/A", "?"]).unwrap().1, ["\"a\"", "null", "\"?\""]);
    }

    #[test]
    fn only_the_kept_rows_decide() {
        let column = Column::new("a".into(), ["1", "broken", "2", "x", "y"]);
        let typed = typed(&column, false, Some(&[true, false, true, false, false]), Path::new("t.csv")).unwrap();
        assert_eq!((typed.dtype().to_string().as_str(), typed.null_count()), ("i64", 3));
    }

    #[test]
    fn a_stray_cell_is_an_error_that_says_what_to_do() {
        assert_eq!(
            of(&["1", "2", "", "abc", "3"]).unwrap_err(),
            "column \"a\", row 4: expected a number, as in 3 of 4 rows, found \"abc\"; leave the cell empty or write NA where a value is missing, leave rows out with --where, or give --words a to take all of them as words: t.csv"
        );
        let dates = of(&["2024-01-31", "2024-01-32", "2024-02-01"]).unwrap_err();
        assert!(
            dates.starts_with("column \"a\", row 2: expected a date, as in 2 of 3 rows, found \"2024-01-32\""),
            "{dates}"
        );
        // half and half are words
        assert_eq!(of(&["1", "b"]).unwrap().0, "str");
        let far = of(&["2024-01-31T00:00:00.000000001", "1000-01-01"]).unwrap_err();
        assert!(far.starts_with("column \"a\", row 2: a date that nanoseconds do not reach"), "{far}");
    }
}
