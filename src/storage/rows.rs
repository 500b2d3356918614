//! Rows of a store, column by column: what a learner's memory is filled from, without an episode in between.

use std::ops::ControlFlow;

use super::{EpisodeSource, StorageError};
use crate::schema::Episode;

/// Consecutive rows of a store, of some of its agents. An episode may begin or end anywhere in them.
#[derive(Clone, Debug)]
pub struct Rows<'a> {
    /// Number of rows.
    pub count: usize,
    /// Episode of the first row.
    pub episode: u64,
    /// Step of the first row.
    pub step: usize,
    /// The rows that are the last of their episodes, ascending.
    pub ends: Vec<usize>,
    /// Per agent `[count, observation]`.
    pub observations: Vec<&'a [f32]>,
    /// Per agent what it sent `[count, message]`; empty for who does not send. The same slice as its observation where the
    /// store holds the two once.
    pub messages: Vec<&'a [f32]>,
    /// Link bits `[count, N, N]`, sender by receiver over the communicators.
    pub link: Vec<bool>,
    /// Per agent `[count, action]`; empty for who does not act. What stands in the last row of an episode means nothing.
    pub actions: Vec<&'a [f32]>,
    /// Team reward `[count]`; what stands in the last row of an episode means nothing.
    pub reward: &'a [f32],
}

/// Takes rows, and says whether it wants more.
pub type Take<'a> = dyn FnMut(&Rows<'_>) -> ControlFlow<()> + Send + 'a;

/// All episodes that are left, one after the other, as rows of these agents.
pub(super) fn by_episode<S: EpisodeSource + ?Sized>(
    source: &mut S,
    agents: &[usize],
    take: &mut Take<'_>,
) -> Result<(), StorageError> {
    while let Some(episode) = source.next_episode()? {
        if of(&episode, agents, take).is_break() {
            break;
        }
    }
    Ok(())
}

/// The rows of an episode.
fn of(episode: &Episode, agents: &[usize], take: &mut Take<'_>) -> ControlFlow<()> {
    let padded = |data: &[f32], width: usize| [data, &vec![0.0; width]].concat();
    let actions: Vec<Vec<f32>> =
        agents.iter().map(|&a| &episode.actions[a]).map(|m| padded(&m.data, m.width)).collect();
    take(&Rows {
        count: episode.rows(),
        episode: episode.index,
        step: 0,
        ends: vec![episode.steps],
        observations: agents.iter().map(|&a| &episode.observations[a].data[..]).collect(),
        messages: agents.iter().map(|&a| &episode.messages[a].data[..]).collect(),
        link: episode.link.clone(),
        actions: actions.iter().map(Vec::as_slice).collect(),
        reward: &padded(&episode.reward, 1),
    })
}
