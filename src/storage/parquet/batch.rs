//! A batch of rows as it comes from a file or a journal: its keys checked, its episodes taken out of it.

use arrow::array::{
    Array, ArrayRef, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int32Array, Int64Array, RecordBatch,
};
use arrow::buffer::NullBuffer;

use crate::schema::{Episode, Layout};

/// The columns of a batch, and the row at which the next episode begins.
pub(super) struct Batch {
    pub(super) rows: usize,
    pub(super) at: usize,
    pub(super) episode: Int64Array,
    pub(super) step: Int32Array,
    pub(super) first: BooleanArray,
    last: BooleanArray,
    terminal: BooleanArray,
    /// The other columns, in schema order.
    pub(super) rest: Vec<ArrayRef>,
    /// Rows before this one were passed over.
    pub(super) passed: usize,
}

impl Batch {
    /// Takes a batch that has these columns; the first five are the keys.
    pub(super) fn new(batch: &RecordBatch, columns: &[String]) -> Result<Self, String> {
        fn typed<A: Array + Clone + 'static>(array: &ArrayRef) -> Result<A, String> {
            array.as_any().downcast_ref::<A>().cloned().ok_or_else(|| format!("unexpected type {}", array.data_type()))
        }
        let mut sorted = Vec::with_capacity(columns.len());
        for name in columns {
            let array = batch.column_by_name(name).ok_or_else(|| format!("column {name} is missing"))?;
            let nullable = name.starts_with("action.") || name == "reward" || name.starts_with("reward.");
            if !nullable && array.null_count() > 0 {
                return Err(format!("column {name}: expected no null, found {}", array.null_count()));
            }
            sorted.push(ArrayRef::clone(array));
        }
        let rest = sorted.split_off(5);
        let last: BooleanArray = typed(&sorted[3])?;
        let acted = NullBuffer::new(!last.values());
        for (name, array) in columns[5..].iter().zip(&rest) {
            let nullable = name.starts_with("action.") || name.starts_with("reward");
            if nullable
                && array.nulls() != Some(&acted)
                && let Some(row) = (0..batch.num_rows()).find(|&r| array.is_null(r) != last.value(r))
            {
                let step = typed::<Int32Array>(&sorted[1])?.value(row);
                return Err(format!(
                    "column {name}: step {step}: null is for the last row of an episode, and only there"
                ));
            }
            if let Some(list) = array.as_any().downcast_ref::<FixedSizeListArray>()
                && list.values().null_count() > 0
                && !nullable
            {
                return Err(format!("column {name}: expected no null element, found {}", list.values().null_count()));
            }
        }
        let (episode, step) = (typed(&sorted[0])?, typed(&sorted[1])?);
        let (first, terminal) = (typed(&sorted[2])?, typed(&sorted[4])?);
        Ok(Self { rows: batch.num_rows(), at: 0, episode, step, first, last, terminal, rest, passed: 0 })
    }

    /// Checks that row `r` is this one; whether it is the last of its episode.
    pub(super) fn check_row(&self, r: usize, episode: u64, row: usize) -> Result<bool, String> {
        let (number, step) = (self.episode.value(r), self.step.value(r));
        if number != episode as i64 || i64::from(step) != row as i64 {
            let expected = format!("expected episode {episode} step {row}");
            return Err(format!(
                "{expected}, found episode {number} step {step}: rows are missing, doubled or unsorted"
            ));
        }
        if self.first.value(r) != (step == 0) {
            return Err(format!("column is_first: episode {number} step {step} has {}", self.first.value(r)));
        }
        let last = self.last.value(r);
        if self.terminal.value(r) && !last {
            return Err(format!("column is_terminal: episode {number} step {step} is not the last"));
        }
        Ok(last)
    }

    /// Moves the rows of the episode that begins or goes on at `at` over; whether its last row is among them.
    pub(super) fn take(&mut self, layout: &Layout, e: &mut Episode, rows: &mut usize) -> Result<bool, String> {
        let from = self.at;
        let mut done = false;
        while self.at < self.rows && !done {
            let r = self.at;
            done = self.check_row(r, e.index, *rows)?;
            e.terminal = self.terminal.value(r);
            *rows += 1;
            self.at += 1;
        }
        let (n, acted) = (self.at - from, self.at - from - usize::from(done));
        let mut rest = self.rest.iter();
        let mut next = |width: usize| if width > 0 { rest.next() } else { None };
        if let Some(array) = next(layout.state_fields.len()) {
            let (values, width) = elements::<Float64Array>(array)?;
            let part = values.values().get(from * width..(from + n) * width);
            e.state.extend_from_slice(part.ok_or("a list column is shorter than its rows")?);
        }
        let floats = |array: Option<&ArrayRef>, n: usize, out: &mut Vec<f32>| -> Result<(), String> {
            if let Some(array) = array {
                let (values, width) = elements::<Float32Array>(array)?;
                let part = values.values().get(from * width..(from + n) * width);
                out.extend_from_slice(part.ok_or("a list column is shorter than its rows")?);
            }
            Ok(())
        };
        for (a, m) in layout.agents.iter().zip(&mut e.observations) {
            floats(next(a.observation), n, &mut m.data)?;
        }
        for (a, m) in layout.agents.iter().zip(&mut e.messages) {
            floats(next(a.message), n, &mut m.data)?;
        }
        if let Some(array) = next(layout.communicators().len()) {
            let (values, width) = elements::<BooleanArray>(array)?;
            if values.len() < (from + n) * width {
                return Err("a list column is shorter than its rows".to_owned());
            }
            e.link.extend(values.values().slice(from * width, n * width).iter());
        }
        for (a, m) in layout.agents.iter().zip(&mut e.actions) {
            floats(next(a.action), acted, &mut m.data)?;
        }
        for out in std::iter::once(&mut e.reward).chain(&mut e.rewards) {
            let array = next(1).and_then(|a| a.as_any().downcast_ref::<Float32Array>()).ok_or("no reward column")?;
            out.extend_from_slice(&array.values()[from..from + acted]);
        }
        Ok(done)
    }
}

/// The elements of a list column, and its width.
pub(super) fn elements<A: Array + 'static>(array: &ArrayRef) -> Result<(&A, usize), String> {
    let list = array.as_any().downcast_ref::<FixedSizeListArray>();
    let values = list.and_then(|l| l.values().as_any().downcast_ref::<A>());
    list.zip(values)
        .map(|(l, v)| (v, l.value_length() as usize))
        .ok_or_else(|| format!("unexpected type {}", array.data_type()))
}
