//! Repetition and definition levels of a page: where its rows begin, and which of them are null.
//!
//! A column of ours is a value per row, or a list of fixed width per row, and a row may be null as a whole. All else that
//! levels can say (a list of another width, a null inside a list) is an error.

/// What the rows of a column look like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    /// Values per row.
    pub(super) width: usize,
    /// Whether a row is a list; then the column has repetition levels.
    pub(super) list: bool,
    /// Whether a row may be null.
    pub(super) nullable: bool,
    /// Definition level of a value that is there, at most 3.
    pub(super) present: u8,
}

/// Values in a row of a page, or the places of values that a null row leaves empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Run {
    /// How many.
    pub(super) slots: usize,
    /// Whether they are empty.
    pub(super) null: bool,
}

/// The rows of a page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Rows {
    /// Values and empty places, in order.
    pub(super) runs: Vec<Run>,
    /// Values.
    pub(super) values: usize,
    /// How many values of its last row the page holds, if the row goes on in the next page; else 0.
    pub(super) begun: usize,
}

/// Expands `count` levels of up to `most` from runs and bit-packed groups (the hybrid encoding).
pub(super) fn expand(input: &[u8], most: u8, count: usize, out: &mut Vec<u8>) -> Result<(), String> {
    out.clear();
    let (bits, mut input) = (u8::BITS - most.leading_zeros(), input);
    while out.len() < count {
        let header = varint(&mut input).ok_or("its levels end early")?;
        let left = count - out.len();
        if header & 1 == 0 {
            let length = usize::try_from(header >> 1).ok().filter(|&n| n > 0 && n <= left);
            let length = length.ok_or_else(|| format!("a run of {} levels where {left} are left", header >> 1))?;
            let (&value, rest) = input.split_first().ok_or("its levels end early")?;
            input = rest;
            out.resize(out.len() + length, value);
        } else {
            // groups of eight, the last one filled up
            let groups = usize::try_from(header >> 1).unwrap_or(usize::MAX).min(left.div_ceil(8));
            let packed = input.split_at_checked(groups * bits as usize).ok_or("its levels end early")?;
            input = packed.1;
            let wanted = out.len() + left.min(groups * 8);
            for group in packed.0.chunks_exact(bits as usize) {
                let word = group.iter().rev().fold(0_u32, |word, &byte| word << 8 | u32::from(byte));
                out.extend((0..8).map(|i| (word >> (i * bits)) as u8 & ((1 << bits) - 1)));
            }
            out.truncate(wanted);
        }
    }
    match out.iter().fold(0, |largest, &level| largest.max(level)) {
        largest if largest > most => Err(format!("a level {largest} where {most} is the highest")),
        _ => Ok(()),
    }
}

fn varint(input: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..35).step_by(7) {
        let (&byte, rest) = input.split_first()?;
        *input = rest;
        value |= u64::from(byte & 127) << shift;
        if byte < 128 {
            return Some(value);
        }
    }
    None
}

/// The rows that `count` levels describe. `begun` is how many values of the row at hand the pages before have held. The
/// repetition and the definition levels are empty where the column has none.
pub(super) fn rows(shape: Shape, [reps, defs]: [&[u8]; 2], count: usize, begun: usize) -> Result<Rows, String> {
    let width = shape.width;
    let other = || format!("a list that does not have {width} elements");
    if !shape.nullable {
        if defs.iter().fold(0, |other, def| other | (def ^ shape.present)) != 0 {
            return Err("a null where none may be".to_owned());
        }
        // the end of the row at hand, then row by row
        let (head, whole) = reps.split_at(reps.len().min((width - begun) % width));
        let fits = |row: &[u8]| row[0] == 0 && row[1..].iter().fold(1, |all, rep| all & rep) == 1;
        if head.contains(&0) || !whole.chunks(width).all(fits) {
            return Err(other());
        }
        let runs = vec![Run { slots: count, null: false }];
        return Ok(Rows { runs, values: count, begun: (begun + count) % width });
    }
    let mut page = Rows { runs: Vec::new(), values: 0, begun };
    for i in 0..count {
        let goes_on = shape.list && reps[i] != 0;
        if goes_on != (page.begun > 0) {
            return Err(other());
        }
        let null = defs[i] != shape.present;
        if null && (defs[i] != 0 || goes_on) {
            return Err("a null or empty list where only a null row may be".to_owned());
        }
        if !null {
            (page.values, page.begun) = (page.values + 1, (page.begun + 1) % width);
        }
        let slots = if null { width } else { 1 };
        match page.runs.last_mut() {
            Some(run) if run.null == null => run.slots += slots,
            _ => page.runs.push(Run { slots, null }),
        }
    }
    Ok(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expanded(input: &[u8], most: u8, count: usize) -> Result<Vec<u8>, String> {
        let mut out = Vec::new();
        expand(input, most, count, &mut out).map(|()| out)
    }

    #[test]
    fn runs_and_packed_groups_are_expanded() {
        // a run of three ones; then a group of eight, of which six are wanted: 0b_1010_0110
        assert_eq!(expanded(&[6, 1, 3, 0b_1010_0110], 1, 9).unwrap(), [1, 1, 1, 0, 1, 1, 0, 0, 1]);
        // two bits each: 0, 1, 2, 3, 3, 2, 1, 0, lowest bits first
        assert_eq!(expanded(&[3, 0b_1110_0100, 0b_0001_1011], 3, 8).unwrap(), [0, 1, 2, 3, 3, 2, 1, 0]);
        assert!(expanded(&[], 1, 0).unwrap().is_empty());
    }

    #[test]
    fn hostile_levels_are_errors_and_take_no_memory() {
        assert_eq!(expanded(&[6, 1], 1, 4).unwrap_err(), "its levels end early");
        assert_eq!(expanded(&[6], 1, 3).unwrap_err(), "its levels end early");
        assert_eq!(expanded(&[5, 255], 1, 16).unwrap_err(), "its levels end early");
        assert_eq!(expanded(&[0, 1], 1, 4).unwrap_err(), "a run of 0 levels where 4 are left");
        assert_eq!(expanded(&[12, 1], 1, 4).unwrap_err(), "a run of 6 levels where 4 are left");
        let endless = [0xfe, 0xff, 0xff, 0xff, 0x0f, 1];
        assert_eq!(expanded(&endless, 1, 4).unwrap_err(), "a run of 2147483647 levels where 4 are left");
        assert_eq!(expanded(&[0xff; 8], 1, 4).unwrap_err(), "its levels end early");
        assert_eq!(expanded(&[8, 2], 1, 4).unwrap_err(), "a level 2 where 1 is the highest");
        assert_eq!(expanded(&[3, 0xff, 0xff], 2, 8).unwrap_err(), "a level 3 where 2 is the highest");
    }

    const LIST: Shape = Shape { width: 3, list: true, nullable: false, present: 1 };
    const ACTION: Shape = Shape { nullable: true, present: 2, ..LIST };

    #[test]
    fn rows_may_go_on_in_the_next_page() {
        let run = |slots, null| Run { slots, null };
        let page = rows(LIST, [&[0, 1, 1, 0], &[1; 4]], 4, 0).unwrap();
        assert_eq!(page, Rows { runs: vec![run(4, false)], values: 4, begun: 1 });
        let page = rows(LIST, [&[1, 1], &[1; 2]], 2, 1).unwrap();
        assert_eq!(page, Rows { runs: vec![run(2, false)], values: 2, begun: 0 });
        let page = rows(ACTION, [&[0, 1], &[2, 2]], 2, 0).unwrap();
        assert_eq!(page, Rows { runs: vec![run(2, false)], values: 2, begun: 2 });
        let page = rows(ACTION, [&[1, 0, 0, 0], &[2, 0, 0, 2]], 4, 2).unwrap();
        assert_eq!(page, Rows { runs: vec![run(1, false), run(6, true), run(1, false)], values: 2, begun: 1 });
        let scalar = Shape { width: 1, list: false, nullable: true, present: 1 };
        let page = rows(scalar, [&[], &[1, 0, 1]], 3, 0).unwrap();
        assert_eq!(page, Rows { runs: vec![run(1, false), run(1, true), run(1, false)], values: 2, begun: 0 });
    }

    #[test]
    fn what_is_no_list_of_this_width_is_an_error() {
        let fault = |shape, reps: &[u8], defs: &[u8]| rows(shape, [reps, defs], defs.len(), 0).unwrap_err();
        let width = "a list that does not have 3 elements";
        for reps in [&[0, 1, 0, 0, 1, 1][..], &[0, 1, 1, 1], &[1, 1, 1], &[0, 1, 1, 1, 1, 1], &[0, 0]] {
            assert_eq!(fault(LIST, reps, &vec![1; reps.len()]), width, "{reps:?}");
            assert_eq!(fault(ACTION, reps, &vec![2; reps.len()]), width, "{reps:?}");
        }
        assert_eq!(rows(LIST, [&[1, 0], &[1, 1]], 2, 1).unwrap_err(), width, "it began in the page before");
        assert_eq!(fault(LIST, &[0, 1, 1], &[1, 0, 1]), "a null where none may be");
        for (reps, defs) in [(&[0][..], &[1][..]), (&[0, 1, 1], &[2, 1, 2]), (&[0, 1, 1], &[2, 0, 2])] {
            assert_eq!(fault(ACTION, reps, defs), "a null or empty list where only a null row may be", "{defs:?}");
        }
        assert_eq!(fault(ACTION, &[0, 0], &[2, 0]), width, "a null row inside a list");
    }
}
