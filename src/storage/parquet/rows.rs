//! Rows of one file for a learner's memory, column by column; no episode is made of them, and none is hashed.

use std::ops::ControlFlow;
use std::path::Path;

use arrow::array::{Array as _, ArrayRef, BooleanArray, Float32Array};

use super::batch::{Batch, elements};
use super::columns::{KEYS, schema_of_agents};
use super::decoder::{Decoder, damaged};
use crate::schema::Layout;
use crate::storage::{Rows, StorageError, Take, Tally};

/// Hands over the rows of a file, whose episodes follow those that `total` counts, until `take` wants no more. The next
/// batch is decoded meanwhile.
pub(super) fn read(
    path: &Path,
    layout: &Layout,
    agents: &[usize],
    total: &mut Tally,
    take: &mut Take<'_>,
) -> Result<ControlFlow<()>, StorageError> {
    let columns = Columns::new(layout, agents);
    let mut decoder = Decoder::open_columns(path, layout, &schema_of_agents(layout, agents))?;
    let mut step = 0;
    let mut batch = decoder.next_batch()?;
    while let Some(now) = batch {
        let hand = || -> Result<ControlFlow<()>, String> {
            let (rows, steps) = columns.rows(&now, total.episodes, step)?;
            total.count(rows.ends.len() as u64, steps);
            step = rows.ends.last().map_or(step + rows.count, |&last| rows.count - 1 - last);
            Ok(take(&rows))
        };
        let (flow, next) = rayon::join(hand, || decoder.next_batch());
        if flow.map_err(|message| damaged(path, message))?.is_break() {
            return Ok(ControlFlow::Break(()));
        }
        batch = next?;
    }
    if step > 0 { Err(decoder.cut(total.episodes, step)) } else { Ok(ControlFlow::Continue(())) }
}

/// Where the columns stand in a batch, and their names.
struct Columns<'a> {
    layout: &'a Layout,
    agents: &'a [usize],
    names: Vec<String>,
}

impl<'a> Columns<'a> {
    fn new(layout: &'a Layout, agents: &'a [usize]) -> Self {
        let schema = schema_of_agents(layout, agents);
        let names = schema.fields()[KEYS.len()..].iter().map(|f| f.name().clone()).collect();
        Self { layout, agents, names }
    }

    fn find<'b>(&self, batch: &'b Batch, name: &str) -> Option<&'b ArrayRef> {
        self.names.iter().position(|n| n == name).and_then(|at| batch.rest.get(at))
    }

    /// The rows of a batch that begins with row `step` of `episode`, checked, and how many steps end in them.
    fn rows<'b>(&self, batch: &'b Batch, episode: u64, step: usize) -> Result<(Rows<'b>, u64), String> {
        let (mut ends, mut steps, mut row) = (Vec::new(), 0, step);
        for r in 0..batch.rows {
            if batch.check_row(r, episode + ends.len() as u64, row)? {
                ends.push(r);
                (steps, row) = (steps + row as u64, 0);
            } else {
                row += 1;
            }
        }
        let place = |r: usize| {
            let before = ends.partition_point(|&end| end < r);
            let first = before.checked_sub(1).map_or(0, |last| ends[last] + 1);
            (episode + before as u64, r - first + if before == 0 { step } else { 0 })
        };
        let floats = |kind: &str, width: fn(&crate::schema::AgentSpec) -> usize| -> Result<Vec<&'b [f32]>, String> {
            let column = |&agent: &usize| {
                let (agent, name) = (&self.layout.agents[agent], format!("{kind}.{}", self.layout.agents[agent].name));
                let Some(array) = self.find(batch, &name).filter(|_| width(agent) > 0) else { return Ok(&[][..]) };
                let (values, width) = elements::<Float32Array>(array)?;
                let (values, from) = (values.values(), array.offset() * width);
                let values =
                    values.get(from..from + batch.rows * width).ok_or("a list column is shorter than its rows")?;
                finite(&name, values, width, place)?;
                Ok(values)
            };
            self.agents.iter().map(column).collect()
        };
        let n = self.layout.communicators().len();
        let mut link = Vec::new();
        if let Some(array) = self.find(batch, "link") {
            let (values, width) = elements::<BooleanArray>(array)?;
            if values.len() < batch.rows * width {
                return Err("a list column is shorter than its rows".to_owned());
            }
            link.extend(values.values().iter().take(batch.rows * width));
        }
        for (r, matrix) in link.chunks_exact((n * n).max(1)).enumerate() {
            if let Some(c) = (0..n).find(|&c| !matrix[c * n + c]) {
                let (episode, step) = place(r);
                return Err(format!(
                    "column link: episode {episode} step {step}: the diagonal must be true, communicator {c} has false"
                ));
            }
        }
        let reward = self.find(batch, "reward").and_then(|a| a.as_any().downcast_ref::<Float32Array>());
        let reward = reward.ok_or("no reward column")?.values();
        finite("reward", reward, 1, place)?;
        let rows = Rows {
            count: batch.rows,
            episode,
            step,
            observations: floats("observation", |a| a.observation)?,
            messages: floats("message", |a| a.message)?,
            link,
            actions: floats("action", |a| a.action)?,
            reward,
            ends,
        };
        Ok((rows, steps))
    }
}

/// Refuses NaN and infinities, as the reader of episodes does.
fn finite(name: &str, values: &[f32], width: usize, place: impl Fn(usize) -> (u64, usize)) -> Result<(), String> {
    if values.iter().fold(true, |all, v| all & v.is_finite()) {
        return Ok(());
    }
    let at = values.iter().position(|v| !v.is_finite()).unwrap_or(0);
    let ((episode, step), element) = (place(at / width), at % width);
    let value = values[at];
    Err(format!(
        "column {name}: episode {episode} step {step}, element {element}: found {value}, but a store holds finite numbers only"
    ))
}
