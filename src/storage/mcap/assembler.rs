//! From messages to episodes: every row is checked against the layout, every end against its rows.

use mcap::parse_record;
use mcap::records::{Record, op};
use prost::Message as _;

use super::{EPISODE_TOPIC, STEP_TOPIC, proto};
use crate::schema::{Episode, Layout};
use crate::storage::tally::check;

/// The channels of a file that matter here, by id.
#[derive(Default)]
pub(super) struct Channels {
    step: Vec<u16>,
    pub(super) episode: Vec<u16>,
}

impl Channels {
    pub(super) fn add(&mut self, body: &[u8]) -> Result<(), String> {
        if let Record::Channel(channel) = parse_record(op::CHANNEL, body).map_err(|e| e.to_string())? {
            let list = match channel.topic.as_str() {
                STEP_TOPIC => &mut self.step,
                EPISODE_TOPIC => &mut self.episode,
                _ => return Ok(()),
            };
            if channel.message_encoding != "protobuf" {
                return Err(format!("topic {}: expected protobuf, found {}", channel.topic, channel.message_encoding));
            }
            if !list.contains(&channel.id) {
                list.push(channel.id);
            }
        }
        Ok(())
    }
}

/// Puts messages together to episodes.
pub(super) struct Assembler {
    layout: Layout,
    channels: Channels,
    /// Bytes that an encoded row has at most.
    row_limit: usize,
    episode: Episode,
    rows: usize,
    /// Whether the rest of a bad episode is passed over.
    skipping: bool,
}

impl Assembler {
    pub(super) fn new(layout: Layout) -> Self {
        let n = layout.communicators().len();
        let agents: usize =
            layout.agents.iter().map(|a| 4 * (a.observation + a.message + a.action) + a.name.len() + 64).sum();
        let row_limit = 128 + 8 * layout.state_fields.len() + n * n + agents;
        let episode = Episode::with_capacity(&layout, 0, 0);
        Self { layout, channels: Channels::default(), row_limit, episode, rows: 0, skipping: false }
    }

    /// Rows of the episode in the making.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// Gives the episode in the making up, and what follows of it until the next episode begins.
    pub(super) fn skip(&mut self) {
        self.start(self.episode.index + 1);
        self.skipping = true;
    }

    fn start(&mut self, index: u64) -> Episode {
        self.rows = 0;
        std::mem::replace(&mut self.episode, Episode::with_capacity(&self.layout, index, 0))
    }

    /// Takes a record; the end message of an episode gives that episode, with its content hash checked.
    pub(super) fn take(&mut self, opcode: u8, body: &[u8]) -> Result<Option<(Episode, [u8; 32])>, String> {
        if opcode == op::CHANNEL {
            self.channels.add(body)?;
        }
        if opcode != op::MESSAGE {
            return Ok(None);
        }
        let record = parse_record(opcode, body).map_err(|e| e.to_string())?;
        let Record::Message { header, data } = record else { return Ok(None) };
        if self.channels.step.contains(&header.channel_id) {
            if data.len() > self.row_limit {
                return Err(format!("a row of {} bytes is over the manifest's {}", data.len(), self.row_limit));
            }
            let row = proto::Step::decode(&*data).map_err(|e| format!("{STEP_TOPIC}: {e}"))?;
            if self.skipping && row.is_first && row.step == 0 {
                self.skipping = false;
                self.start(row.episode);
            }
            if !self.skipping {
                add(&self.layout, &mut self.episode, &mut self.rows, row)?;
            }
        } else if self.channels.episode.contains(&header.channel_id) && !self.skipping {
            let end = proto::Episode::decode(&*data).map_err(|e| format!("{EPISODE_TOPIC}: {e}"))?;
            return self.close(&end).map(Some);
        }
        Ok(None)
    }

    fn close(&mut self, end: &proto::Episode) -> Result<(Episode, [u8; 32]), String> {
        let rows = self.rows;
        let index = self.episode.index;
        if end.index != index || end.steps.checked_add(1) != Some(rows as u64) || end.terminal != self.episode.terminal
        {
            let (other, steps) = (end.index, end.steps);
            return Err(format!("episode {index} of {rows} rows: its end says episode {other} of {steps} steps"));
        }
        if self.episode.reward.len() + 1 != rows {
            return Err(format!("episode {index} of {rows} rows: its last row has no is_last"));
        }
        let mut episode = self.start(index + 1);
        episode.steps = rows - 1;
        let hash = check(&self.layout, &episode, index).map_err(|e| format!("episode {index}: {e}"))?;
        if end.content_hash != hash {
            return Err(format!("episode {index} does not have the content hash at its end"));
        }
        if end.episode_return != episode.episode_return() {
            let (said, sum) = (end.episode_return, episode.episode_return());
            return Err(format!("episode {index}: its end says return {said}, its rewards sum to {sum}"));
        }
        Ok((episode, hash))
    }
}

/// Appends a row to an episode, after checking it against the layout.
fn add(layout: &Layout, e: &mut Episode, rows: &mut usize, row: proto::Step) -> Result<(), String> {
    let r = *rows;
    if row.episode != e.index || u64::from(row.step) != r as u64 {
        let (episode, step) = (row.episode, row.step);
        return Err(format!("expected episode {} step {r}, found episode {episode} step {step}", e.index));
    }
    let place = || format!("episode {} step {r}", e.index);
    if e.reward.len() != r {
        return Err(format!("{}: a row follows the one with is_last", place()));
    }
    if row.is_first != (r == 0) || (row.is_terminal && !row.is_last) {
        return Err(format!("{}: is_first, is_last, is_terminal do not fit", place()));
    }
    if row.reward.is_some() == row.is_last || row.agents.len() != layout.agents.len() {
        return Err(format!("{}: rewards or agents do not fit", place()));
    }
    for (spec, agent) in layout.agents.iter().zip(&row.agents) {
        let acts = if row.is_last { 0 } else { spec.action };
        let widths = [
            (agent.observation.len(), spec.observation),
            (agent.message.len(), spec.message),
            (agent.action.len(), acts),
        ];
        if agent.name != spec.name || widths.iter().any(|(a, b)| a != b) || agent.reward.is_some() == row.is_last {
            return Err(format!("{}: agent {:?} does not fit the manifest's {:?}", place(), agent.name, spec.name));
        }
    }
    let n = layout.communicators().len();
    if row.state.len() != layout.state_fields.len() || row.link.len() != n * n {
        return Err(format!("{}: state or link has the wrong length", place()));
    }
    e.state.extend(row.state);
    e.link.extend(row.link);
    e.reward.extend(row.reward);
    for (i, agent) in row.agents.into_iter().enumerate() {
        e.observations[i].data.extend(agent.observation);
        e.messages[i].data.extend(agent.message);
        e.actions[i].data.extend(agent.action);
        e.rewards[i].extend(agent.reward);
    }
    e.terminal = row.is_terminal;
    *rows += 1;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_follows_the_last_row() {
        let layout = Layout { agents: Vec::new(), state_fields: Vec::new() };
        let (mut e, mut rows) = (Episode::with_capacity(&layout, 0, 2), 0);
        let row = |step: u32, last: bool| proto::Step {
            step,
            is_first: step == 0,
            is_last: last,
            reward: (!last).then_some(1.0),
            ..proto::Step::default()
        };
        add(&layout, &mut e, &mut rows, row(0, false)).unwrap();
        add(&layout, &mut e, &mut rows, row(1, true)).unwrap();
        let error = add(&layout, &mut e, &mut rows, row(2, false)).unwrap_err();
        assert_eq!(error, "episode 0 step 2: a row follows the one with is_last");
    }

    #[test]
    fn every_fault_of_a_row_and_of_an_end_is_named() {
        use crate::schema::{AgentSpec, Controller};
        type ChangeRow = fn(&mut proto::Step);
        type ChangeEnd = fn(&mut proto::Episode);
        let agent = AgentSpec {
            name: "a".to_owned(),
            team: "t".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 1,
            message: 1,
            action: 1,
        };
        let layout = Layout { agents: vec![agent], state_fields: vec!["x".to_owned()] };
        let row = |step: u32, last: bool| {
            let reward = (!last).then_some(1.0);
            let action = if last { vec![] } else { vec![0.5] };
            let agent =
                proto::Agent { name: "a".to_owned(), observation: vec![1.0], message: vec![1.0], action, reward };
            let (is_first, is_last, agents) = (step == 0, last, vec![agent]);
            proto::Step {
                step,
                is_first,
                is_last,
                reward,
                state: vec![1.0],
                link: vec![true],
                agents,
                ..proto::Step::default()
            }
        };
        // what happens to the second of three rows
        let rows: [(ChangeRow, &str); 8] = [
            (|r| r.episode = 1, "expected episode 0 step 1, found episode 1 step 1"),
            (|r| r.step = 5, "expected episode 0 step 1, found episode 0 step 5"),
            (|r| r.is_first = true, "episode 0 step 1: is_first, is_last, is_terminal do not fit"),
            (|r| r.is_terminal = true, "episode 0 step 1: is_first, is_last, is_terminal do not fit"),
            (|r| r.reward = None, "episode 0 step 1: rewards or agents do not fit"),
            (|r| r.agents.clear(), "episode 0 step 1: rewards or agents do not fit"),
            (|r| r.agents[0].name.push('b'), "episode 0 step 1: agent \"ab\" does not fit the manifest's \"a\""),
            (|r| r.link.clear(), "episode 0 step 1: state or link has the wrong length"),
        ];
        for (change, expected) in rows {
            let (mut e, mut count) = (Episode::with_capacity(&layout, 0, 2), 0);
            add(&layout, &mut e, &mut count, row(0, false)).unwrap();
            let mut second = row(1, false);
            change(&mut second);
            assert_eq!(add(&layout, &mut e, &mut count, second).unwrap_err(), expected);
        }
        let ends: [(ChangeEnd, &str); 5] = [
            (|e| e.index = 3, "episode 0 of 2 rows: its end says episode 3 of 1 steps"),
            (|e| e.steps = 9, "episode 0 of 2 rows: its end says episode 0 of 9 steps"),
            (|e| e.terminal = true, "episode 0 of 2 rows: its end says episode 0 of 1 steps"),
            (|e| e.content_hash[0] ^= 1, "episode 0 does not have the content hash at its end"),
            (|e| e.episode_return = 2.0, "episode 0: its end says return 2, its rewards sum to 1"),
        ];
        let filled = || {
            let mut assembler = Assembler::new(layout.clone());
            for row in [row(0, false), row(1, true)] {
                add(&layout, &mut assembler.episode, &mut assembler.rows, row).unwrap();
            }
            assembler
        };
        let whole = Episode { steps: 1, ..filled().episode };
        let good = || proto::Episode {
            steps: 1,
            episode_return: 1.0,
            content_hash: whole.content_hash().to_vec(),
            ..proto::Episode::default()
        };
        assert_eq!(filled().close(&good()).unwrap().0, whole);
        for (change, expected) in ends {
            let mut end = good();
            change(&mut end);
            assert_eq!(filled().close(&end).unwrap_err(), expected);
        }
        let mut open = Assembler::new(layout.clone());
        add(&layout, &mut open.episode, &mut open.rows, row(0, false)).unwrap();
        add(&layout, &mut open.episode, &mut open.rows, row(1, false)).unwrap();
        assert_eq!(open.close(&good()).unwrap_err(), "episode 0 of 2 rows: its last row has no is_last");
    }
}
