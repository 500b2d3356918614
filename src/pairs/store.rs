//! Samples per ordered link of a store.

use std::path::Path;
use std::sync::Arc;

use super::predicate::{Kind, Value};
use super::{PairsError, Predicate};
use crate::registry::did_you_mean;
use crate::schema::{Columns, Exchange, Layout, NOTE, SampleLabels, Samples};
use crate::storage::EpisodeSource;

/// Columns of one agent over all episodes, in the making.
struct Track {
    columns: Columns,
    name: String,
}

impl Track {
    fn new(name: String, width: usize) -> Self {
        let names = (0..width).map(|i| if width == 1 { name.clone() } else { format!("{name}[{i}]") }).collect();
        Self { columns: Columns::new(Vec::new(), names), name }
    }

    fn extend(&mut self, values: &[f32], episode: u64) -> Result<(), PairsError> {
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let (column, width) = (self.columns.names[at % self.columns.width()].clone(), self.columns.width());
            return Err(PairsError::StoreValue { column, episode, step: at / width, value: values[at] });
        }
        self.columns.data.extend(values.iter().map(|&v| f64::from(v)));
        Ok(())
    }
}

/// The links of a store.
#[derive(Clone, Debug)]
pub struct Links {
    /// One set of samples per ordered link and class.
    pub sets: Vec<Samples>,
    /// The number in the store of each episode of the samples: those without a step are not among them.
    pub episodes: Vec<u64>,
}

impl Links {
    /// Leaves out the samples of which a predicate over `episode`, `step`, `sender`, `receiver` and `delivered` is not
    /// true, and sets without a sample.
    ///
    /// # Errors
    /// [`PairsError::UnknownColumn`], [`PairsError::Where`], [`PairsError::NothingKept`].
    pub fn keep(&mut self, predicate: &Predicate, path: &Path) -> Result<(), PairsError> {
        const COLUMNS: [(&str, Kind); 5] = [
            ("episode", Kind::Number),
            ("step", Kind::Number),
            ("sender", Kind::Text),
            ("receiver", Kind::Text),
            ("delivered", Kind::Truth),
        ];
        let place = |name: &String| {
            COLUMNS.iter().position(|(column, _)| column == name).ok_or_else(|| PairsError::UnknownColumn {
                name: name.clone(),
                hint: did_you_mean(name, COLUMNS.iter().map(|(column, _)| *column)),
                path: path.to_owned(),
            })
        };
        let places = predicate.columns().iter().map(place).collect::<Result<Vec<_>, _>>()?;
        let kinds: Vec<Kind> = places.iter().map(|&place| COLUMNS[place].1).collect();
        let bound = predicate.bind(&kinds)?;
        let before: usize = self.sets.iter().map(Samples::len).sum();
        for set in &mut self.sets {
            let (labels, starts) = (&set.labels, &set.starts);
            let text = |text: &'_ Option<String>| text.clone().unwrap_or_default();
            let (sender, receiver) = (text(&labels.sender), text(&labels.receiver));
            let wanted = |(&row, &episode): (&u32, &u32)| {
                let cell = |column: usize| match COLUMNS[places[column]].0 {
                    "episode" => Value::Integer(self.episodes[episode as usize].into()),
                    "step" => Value::Integer(i128::from(row) - starts[episode as usize] as i128),
                    "sender" => Value::Text(&sender),
                    "receiver" => Value::Text(&receiver),
                    _ => labels.delivered.map_or(Value::Null, Value::Truth),
                };
                bound.keeps(&cell)
            };
            let episodes = set.episodes();
            set.rows = set.rows.iter().zip(&episodes).filter(|&pair| wanted(pair)).map(|(&row, _)| row).collect();
        }
        self.sets.retain(|set| !set.is_empty());
        let left: usize = self.sets.iter().map(Samples::len).sum();
        if left == 0 {
            let predicate = predicate.text().to_owned();
            return Err(PairsError::NothingKept { predicate, rows: before, path: path.to_owned() });
        }
        let note = format!("{NOTE}{left} of {before} messages kept by --where {}", predicate.text());
        self.sets.iter_mut().for_each(|set| set.notes.push(note.clone()));
        Ok(())
    }
}

/// One set of samples per ordered link and class that occurs, links sender-major, delivered before lost.
///
/// x is the message that the sender **sent** at step t, `[rows, message]`, y the action of the receiver at t,
/// `[rows, action]`; a step is a sample of the class that its link bit says. Holds the whole store's messages and
/// actions in memory, reads it episode by episode.
///
/// # Errors
/// [`PairsError::NoLinks`], [`PairsError::NoSteps`], [`PairsError::StoreValue`], and those of the store.
pub fn links(source: &mut dyn EpisodeSource) -> Result<Links, PairsError> {
    let layout = source.manifest().layout();
    let communicators = layout.communicators();
    let links = usable_links(&layout);
    if links.is_empty() {
        return Err(PairsError::NoLinks { found: communicators.len() });
    }
    let mut sent: Vec<Track> = communicators
        .iter()
        .map(|&a| Track::new(format!("message.{}", layout.agents[a].name), layout.agents[a].message))
        .collect();
    let mut acted: Vec<Track> = communicators
        .iter()
        .map(|&a| Track::new(format!("action.{}", layout.agents[a].name), layout.agents[a].action))
        .collect();
    let (mut starts, mut classes) = (vec![0], vec![[Vec::new(), Vec::new()]; links.len()]);
    let (mut rows, mut episodes) = (0, Vec::new());
    while let Some(episode) = source.next_episode()? {
        let steps = episode.steps;
        if steps == 0 {
            continue;
        }
        if rows + steps > u32::MAX as usize {
            return Err(PairsError::TooManyRows);
        }
        for (c, &agent) in communicators.iter().enumerate() {
            let message = &episode.messages[agent];
            sent[c].extend(&message.data[..steps * message.width], episode.index)?;
            acted[c].extend(&episode.actions[agent].data, episode.index)?;
        }
        for (&(s, r), class) in links.iter().zip(&mut classes) {
            for step in 0..steps {
                let lost = !episode.delivered(communicators.len(), step, s, r);
                class[usize::from(lost)].push((rows + step) as u32);
            }
        }
        rows += steps;
        starts.push(rows);
        episodes.push(episode.index);
    }
    if rows == 0 {
        return Err(PairsError::NoSteps { episodes: source.manifest().episodes });
    }
    let starts: Arc<[usize]> = starts.into();
    let share = |tracks: Vec<Track>| -> Vec<(Arc<Columns>, String)> {
        tracks.into_iter().map(|t| (Arc::new(t.columns), t.name)).collect()
    };
    let (sent, acted) = (share(sent), share(acted));
    let mut out = Vec::new();
    for ((s, r), class) in links.into_iter().zip(classes) {
        for (rows, delivered) in class.into_iter().zip([true, false]) {
            if rows.is_empty() {
                continue;
            }
            let labels = SampleLabels {
                x: sent[s].1.clone(),
                y: acted[r].1.clone(),
                given: None,
                sender: Some(layout.agents[communicators[s]].name.clone()),
                receiver: Some(layout.agents[communicators[r]].name.clone()),
                delivered: Some(delivered),
                group: "episode".to_owned(),
                within: None,
            };
            out.push(Samples {
                x: Arc::clone(&sent[s].0),
                y: Arc::clone(&acted[r].0),
                z: None,
                starts: Arc::clone(&starts),
                rows,
                exchange: Exchange::Episodes,
                labels,
                notes: Vec::new(),
            });
        }
    }
    Ok(Links { sets: out, episodes })
}

/// Ordered pairs of communicators, by their places among the communicators, whose sender sends and receiver acts.
fn usable_links(layout: &Layout) -> Vec<(usize, usize)> {
    let c = layout.communicators();
    let pairs = (0..c.len()).flat_map(|s| (0..c.len()).map(move |r| (s, r)));
    pairs.filter(|&(s, r)| s != r && layout.agents[c[s]].message > 0 && layout.agents[c[r]].action > 0).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use serde_json::Value;

    use super::*;
    use crate::schema::{AgentSpec, Controller, Episode, Manifest, Matrix};
    use crate::storage::StorageError;

    pub(in crate::pairs) struct Memory {
        manifest: Manifest,
        episodes: std::vec::IntoIter<Episode>,
    }

    impl EpisodeSource for Memory {
        fn manifest(&self) -> &Manifest {
            &self.manifest
        }

        fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
            Ok(self.episodes.next())
        }
    }

    /// `agents` communicators; agent a sends 100 e + 10 t + a and acts [that, −that]; odd steps are lost from 0 to 1.
    pub(in crate::pairs) fn store(agents: usize, lengths: &[usize]) -> Memory {
        let spec = |a: usize| AgentSpec {
            name: format!("agent_{a}"),
            team: "team".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 1,
            message: 1,
            action: 2,
        };
        let layout = Layout { agents: (0..agents).map(spec).collect(), state_fields: Vec::new() };
        let episode = |(e, &steps): (usize, &usize)| {
            let value = |t: usize, a: usize| (100 * e + 10 * t + a) as f32;
            let message = |a: usize| Matrix { data: (0..=steps).map(|t| value(t, a)).collect(), width: 1 };
            let action =
                |a: usize| Matrix { data: (0..steps).flat_map(|t| [value(t, a), -value(t, a)]).collect(), width: 2 };
            let bit = |t: usize, s: usize, r: usize| s == r || !(t % 2 == 1 && s == 0 && r == 1);
            let cells = (0..=steps).flat_map(|t| (0..agents * agents).map(move |c| bit(t, c / agents, c % agents)));
            Episode {
                index: e as u64,
                steps,
                messages: (0..agents).map(message).collect(),
                actions: (0..agents).map(action).collect(),
                link: cells.collect(),
                ..Episode::default()
            }
        };
        let episodes: Vec<Episode> = lengths.iter().enumerate().map(episode).collect();
        let manifest = Manifest::new(1, Value::Null, Value::Null, Value::Null, &layout);
        Memory { manifest, episodes: episodes.into_iter() }
    }

    #[test]
    fn every_link_and_class_has_its_rows_and_the_last_row_is_left_out() {
        let sets = links(&mut store(2, &[3, 2])).unwrap().sets;
        let named: Vec<_> = sets
            .iter()
            .map(|s| (s.labels.sender.as_deref().unwrap(), s.labels.delivered.unwrap(), s.rows.clone()))
            .collect();
        let expected =
            [("agent_0", true, vec![0, 2, 3]), ("agent_0", false, vec![1, 4]), ("agent_1", true, vec![0, 1, 2, 3, 4])];
        assert_eq!(named, expected);
        let lost = &sets[1];
        assert_eq!((lost.labels.x.as_str(), lost.labels.y.as_str()), ("message.agent_0", "action.agent_1"));
        assert_eq!((lost.x.row(4), lost.y.row(4)), (&[110.0][..], &[111.0, -111.0][..]));
        assert_eq!((lost.episodes(), &*lost.starts), (vec![0, 1], &[0, 3, 5][..]));
        assert_eq!(lost.y.names, ["action.agent_1[0]", "action.agent_1[1]"]);
    }

    #[test]
    fn stores_without_links_or_steps_or_with_impossible_values_are_errors() {
        let one = links(&mut store(1, &[3])).unwrap_err().to_string();
        assert!(one.contains("expected two or more communicators") && one.contains("found 1"), "{one}");
        let none = links(&mut store(2, &[])).unwrap_err().to_string();
        assert!(none.contains("no step"), "{none}");
        let mut bad = store(2, &[3, 3]);
        bad.episodes.as_mut_slice()[1].actions[1].data[3] = f32::NAN;
        let nan = links(&mut bad).unwrap_err().to_string();
        assert_eq!(nan, "column action.agent_1[1], episode 1, step 1: expected a finite number, found NaN");
    }
}
