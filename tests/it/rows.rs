//! Rows of a store, which a learner's memory is filled from: the same values as its episodes, refused in the same words.

use std::ops::ControlFlow;
use std::path::Path;

use ccmarl::schema::{Episode, Layout, Matrix};
use ccmarl::storage::{self, StorageError};
use ccmarl::train::replay::Replay;

use super::stores::{FORMS, data_file, episode, forge, layout, message, rows_of, small, some, write};

/// The episodes of a store put together from its rows: columns of these agents, without state and rewards per agent.
pub(crate) fn read(path: &Path, agents: &[usize]) -> Result<Vec<Episode>, StorageError> {
    let mut source = storage::open(path)?;
    let layout = source.manifest().layout();
    let (mut episodes, mut open, mut last) = (Vec::new(), empty(&layout, agents, 0), 0);
    source.read_rows(agents, &mut |rows| {
        let n = layout.communicators().len();
        for r in 0..rows.count {
            let done = rows.ends.contains(&r);
            let row = |data: &[f32], width: usize| data[r * width..(r + 1) * width].to_vec();
            for k in 0..agents.len() {
                let e = &mut open;
                let (o, m) = (&mut e.observations[k], &mut e.messages[k]);
                o.data.extend(row(rows.observations[k], o.width));
                m.data.extend(row(rows.messages[k], m.width));
                if !done {
                    let width = e.actions[k].width;
                    e.actions[k].data.extend(row(rows.actions[k], width));
                }
            }
            open.link.extend(&rows.link[r * n * n..(r + 1) * n * n]);
            if done {
                open.steps = open.reward.len();
                let next = empty(&layout, agents, open.index + 1);
                episodes.push(std::mem::replace(&mut open, next));
            } else {
                open.reward.push(rows.reward[r]);
            }
        }
        last = rows.episode + rows.ends.len() as u64;
        ControlFlow::Continue(())
    })?;
    // what rows say of their place must lead to the last episode
    episodes.truncate(last as usize);
    Ok(episodes)
}

fn empty(layout: &Layout, agents: &[usize], index: u64) -> Episode {
    let matrices = |width: fn(&ccmarl::schema::AgentSpec) -> usize| {
        agents.iter().map(|&a| Matrix { data: Vec::new(), width: width(&layout.agents[a]) }).collect()
    };
    let [observations, messages, actions] =
        [matrices(|a| a.observation), matrices(|a| a.message), matrices(|a| a.action)];
    Episode { index, observations, messages, actions, ..Episode::default() }
}

/// What rows say of an episode.
fn trimmed(episode: &Episode, agents: &[usize]) -> Episode {
    let pick = |columns: &[Matrix]| agents.iter().map(|&a| columns[a].clone()).collect();
    Episode {
        index: episode.index,
        steps: episode.steps,
        observations: pick(&episode.observations),
        messages: pick(&episode.messages),
        actions: pick(&episode.actions),
        link: episode.link.clone(),
        reward: episode.reward.clone(),
        ..Episode::default()
    }
}

#[test]
fn rows_of_each_form_are_those_of_its_episodes() {
    let layout = small();
    let episodes = some(&layout, 9);
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        write(&path, &layout, &episodes, false).unwrap();
        for agents in [&[0, 1, 2][..], &[1], &[2, 0]] {
            let expected: Vec<Episode> = episodes.iter().map(|e| trimmed(e, agents)).collect();
            assert_eq!(read(&path, agents).unwrap(), expected, "{form}");
        }
        // rows after some episodes are those of the others, and whoever wants no more gets no more
        let mut source = storage::open(&path).unwrap();
        source.next_episode().unwrap();
        let (mut first, mut blocks) = (None, 0);
        source
            .read_rows(&[0], &mut |rows| {
                (first, blocks) = (first.or(Some(rows.episode)), blocks + 1);
                ControlFlow::Break(())
            })
            .unwrap();
        assert_eq!((first, blocks), (Some(1), 1), "{form}");
    }
}

#[test]
fn a_memory_filled_from_rows_is_the_one_that_episodes_fill() {
    let layout = layout(&[(true, [2, 2, 1]), (true, [3, 3, 2])], 1);
    // more rows than a batch has, and rings smaller and larger than the store
    let episodes: Vec<Episode> = (0..700)
        .map(|i| {
            let mut e = episode(&layout, i, 25, false);
            e.messages.clone_from(&e.observations);
            e
        })
        .collect();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        write(&path, &layout, &episodes, false).unwrap();
        for capacity in [25 * 3, 25 * 641 + 7, 25 * 5000] {
            let [mut pushed, mut filled] = [(); 2].map(|()| Replay::new(&layout, 25, capacity, false).unwrap());
            for e in &episodes {
                pushed.push(e, &[]).unwrap();
            }
            assert_eq!(filled.fill(&mut *storage::open(&path).unwrap()).unwrap(), 700);
            assert_eq!(filled.len(), pushed.len());
            let parts = |r: &Replay| {
                (r.observations.clone(), r.link.clone(), r.actions.clone(), r.reward.clone(), r.bonus.clone(), r.pushed)
            };
            assert!(parts(&filled) == parts(&pushed), "{form}, capacity {capacity}");
            // once more, where the memory is not at its beginning
            for e in &episodes {
                pushed.push(e, &[]).unwrap();
            }
            filled.fill(&mut *storage::open(&path).unwrap()).unwrap();
            assert!(parts(&filled) == parts(&pushed), "{form}, capacity {capacity}, twice");
        }
    }
}

#[test]
fn episodes_that_cannot_train_are_refused_by_name_from_rows_too() {
    let layout = layout(&[(true, [2, 2, 1]), (true, [3, 3, 2])], 1);
    let echoing = |index: u64, steps: usize| {
        let mut e = episode(&layout, index, steps, false);
        e.messages.clone_from(&e.observations);
        e
    };
    let mut other = [0, 1, 2].map(|index| echoing(index, 4));
    other[1].messages[1].data[5] += 1.0;
    for (episodes, expected) in [
        ([echoing(0, 4), echoing(1, 3), echoing(2, 4)], "episode 1 has 3 steps, the trainer needs 4"),
        ([echoing(0, 4), echoing(1, 4), echoing(2, 6)], "episode 2 has 6 steps, the trainer needs 4"),
        (other, "episode 1: message.agent_1 is not observation.agent_1"),
    ] {
        for form in FORMS {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join(form);
            write(&path, &layout, &episodes, false).unwrap();
            let mut replay = Replay::new(&layout, 4, 100, false).unwrap();
            let error = replay.fill(&mut *storage::open(&path).unwrap()).unwrap_err().to_string();
            assert!(error.contains(expected), "{form}: {error}");
        }
    }
}

#[test]
fn no_flipped_bit_of_a_part_gets_into_rows() {
    use std::os::unix::fs::FileExt as _;
    let layout = layout(&[(true, [1, 1, 1])], 1);
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        write(&path, &layout, &some(&layout, 2), false).unwrap();
        let file = data_file(&path);
        let whole = std::fs::read(&file).unwrap();
        let changed = std::fs::File::options().write(true).open(&file).unwrap();
        for bit in (0..whole.len() * 8).step_by(7) {
            let byte = whole[bit / 8];
            changed.write_all_at(&[byte ^ 1 << (bit % 8)], bit as u64 / 8).unwrap();
            let error = message(read(&path, &[0]));
            assert!(!error.is_empty(), "{form}: bit {bit}");
            changed.write_all_at(&[byte], bit as u64 / 8).unwrap();
        }
        read(&path, &[0]).unwrap();
    }
}

/// What the writer never writes is refused although every digest is right.
#[test]
fn numbers_that_are_not_finite_and_open_diagonals_are_refused() {
    use arrow::array::{Array as _, ArrayRef, BooleanArray, FixedSizeListArray, Float32Array};
    use std::sync::Arc;
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let original = directory.path().join("store");
    write(&original, &layout, &(0..3).map(|i| episode(&layout, i, 2, false)).collect::<Vec<_>>(), false).unwrap();
    let rows = rows_of(&original);
    let list = |name: &str| rows.column_by_name(name).unwrap().as_any().downcast_ref::<FixedSizeListArray>().unwrap();
    let again = |name: &str, values: ArrayRef| -> ArrayRef {
        let arrow::datatypes::DataType::FixedSizeList(field, width) = list(name).data_type().clone() else { panic!() };
        Arc::new(FixedSizeListArray::new(field, width, values, list(name).nulls().cloned()))
    };
    let mut floats =
        list("observation.agent_1").values().as_any().downcast_ref::<Float32Array>().unwrap().values().to_vec();
    floats[4 * 4 + 2] = f32::NAN;
    let links = list("link").values().as_any().downcast_ref::<BooleanArray>().unwrap();
    let open: BooleanArray = links.values().iter().enumerate().map(|(i, bit)| Some(bit && i != 8 * 4 + 3)).collect();
    let mut rewards = vec![Some(0.5); 9];
    (rewards[2], rewards[5], rewards[8], rewards[6]) = (None, None, None, Some(f32::INFINITY));
    let cases: [(&str, ArrayRef, &str); 3] = [
        (
            "observation.agent_1",
            again("observation.agent_1", Arc::new(Float32Array::from(floats))),
            "column observation.agent_1: episode 1 step 1, element 2: found NaN, but a store holds finite numbers only",
        ),
        (
            "link",
            again("link", Arc::new(open)),
            "column link: episode 2 step 2: the diagonal must be true, communicator 1 has false",
        ),
        (
            "reward",
            Arc::new(Float32Array::from(rewards)),
            "column reward: episode 2 step 0, element 0: found inf, but a store holds finite numbers only",
        ),
    ];
    for (name, column, expected) in cases {
        let (at, mut columns) = (rows.schema().index_of(name).unwrap(), rows.columns().to_vec());
        columns[at] = column;
        let path = directory.path().join(name);
        forge(&original, &path, &arrow::array::RecordBatch::try_new(rows.schema(), columns).unwrap());
        let error = message(read(&path, &[0, 1]));
        assert!(error.contains(expected), "{error}");
        super::stores::read(&path).unwrap_err();
    }
}
