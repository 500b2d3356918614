//! Dates and times as text: what of ISO 8601 tables hold.

/// Nanoseconds in a second.
pub(super) const SECOND: i128 = 1_000_000_000;

/// Nanoseconds since 1970-01-01T00:00:00Z of `2024-01-31`, `2024-01-31T12:00`, `2024-01-31 12:00:00.25`, each time with
/// `Z`, `+01:00`, `+0100`, `+01` or nothing (then UTC) behind it. Days and times that there are not are none.
pub(super) fn parse(text: &str) -> Option<i128> {
    let text = text.trim();
    if !text.is_ascii() || text.len() < 10 {
        return None;
    }
    let (date, rest) = text.split_at(10);
    let [year, month, day] = fields(date, '-', [4, 2, 2])?;
    let days = days(year, month, day)?;
    let midnight = i128::from(days) * 86_400 * SECOND;
    let Some(time) = rest.strip_prefix(['T', 't', ' ']) else { return rest.is_empty().then_some(midnight) };
    let at = time.find(['Z', 'z', '+', '-']).unwrap_or(time.len());
    let (clock, zone) = time.split_at(at);
    Some(midnight + self::clock(clock)? - offset(zone)?)
}

/// Numbers of fixed width with a mark between them.
fn fields<const N: usize>(text: &str, mark: char, widths: [usize; N]) -> Option<[i64; N]> {
    let mut out = [0; N];
    let mut parts = text.split(mark);
    for (number, width) in out.iter_mut().zip(widths) {
        let part = parts.next().filter(|part| part.len() == width && part.bytes().all(|b| b.is_ascii_digit()))?;
        *number = part.parse().ok()?;
    }
    parts.next().is_none().then_some(out)
}

/// Days since 1970-01-01 in the Gregorian calendar, extended backwards.
fn days(year: i64, month: i64, day: i64) -> Option<i64> {
    let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let lengths = [31, if leap { 29 } else { 28 }, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    let length = *lengths.get(usize::try_from(month - 1).ok()?)?;
    if !(1..=length).contains(&day) {
        return None;
    }
    let before = year - 1;
    let leaps = before.div_euclid(4) - before.div_euclid(100) + before.div_euclid(400);
    let of_year = lengths[..month as usize - 1].iter().sum::<i64>() + day - 1;
    Some(before * 365 + leaps + of_year - 719_162)
}

/// Nanoseconds since midnight.
fn clock(text: &str) -> Option<i128> {
    let (whole, fraction) = text.split_once(['.', ',']).map_or((text, None), |(whole, f)| (whole, Some(f)));
    let [hour, minute, second] = match whole.len() {
        5 if fraction.is_none() => fields(whole, ':', [2, 2]).map(|[h, m]| [h, m, 0])?,
        _ => fields(whole, ':', [2, 2, 2])?,
    };
    if hour > 23 || minute > 59 || second > 59 {
        return None;
    }
    let nanos = match fraction {
        None => 0,
        Some(digits) if (1..=9).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_digit()) => {
            digits.parse::<i128>().ok()? * 10_i128.pow(9 - digits.len() as u32)
        }
        Some(_) => return None,
    };
    Some(i128::from(hour * 3600 + minute * 60 + second) * SECOND + nanos)
}

/// Nanoseconds that a zone is ahead of UTC.
fn offset(text: &str) -> Option<i128> {
    if text.is_empty() || text.eq_ignore_ascii_case("Z") {
        return Some(0);
    }
    let (sign, digits) = text.split_at(1);
    let [hours, minutes] = match digits.len() {
        2 => fields(digits, ':', [2]).map(|[hours]| [hours, 0])?,
        4 => [digits[..2].parse().ok()?, fields(&digits[2..], ':', [2])?[0]],
        _ => fields(digits, ':', [2, 2])?,
    };
    let ahead = i128::from(hours * 3600 + minutes * 60) * SECOND;
    (hours < 24 && minutes < 60).then_some(if sign == "-" { -ahead } else { ahead })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_instants() {
        // seconds as `date -u -d … +%s` and Python's datetime say
        let cases = [
            ("1970-01-01", 0.0),
            ("2024-01-31", 1_706_659_200.0),
            ("2024-01-31T12:00:00Z", 1_706_702_400.0),
            ("2024-01-31 12:00", 1_706_702_400.0),
            ("2024-02-29T23:59:59.5+02:00", 1_709_243_999.5),
            ("2024-02-29T23:59:59.500-0130", 1_709_256_599.5),
            ("1969-12-31T23:59:59", -1.0),
            ("0001-01-01", -62_135_596_800.0),
            ("9999-12-31", 253_402_214_400.0),
        ];
        for (text, seconds) in cases {
            assert_eq!(parse(text).unwrap() as f64 / SECOND as f64, seconds, "{text}");
        }
        assert_eq!(parse("1970-01-01T00:00:00.000000001"), Some(1));
    }

    #[test]
    fn what_is_no_date_is_none() {
        for text in [
            "",
            "2024",
            "2024-13-01",
            "2023-02-29",
            "2024-01-31T",
            "2024-01-31T25:00",
            "2024-01-31T12",
            "2024-1-31",
            "2024-01-31T12:00:00.",
            "2024-01-31T12:00+1",
            "2024-01-31T12:00+1x00",
            "+024-01-31",
            "2024-01-31x",
            "2024-01-31T12:00:00.1234567890",
            "31.01.2024",
            "２024-01-31",
            "2024-01-31T12:00Zx",
            "2024-01-31T12:00:60",
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }
}
