//! What a store costs: recording it, reading it into replay memory, reading its episodes; in all forms. Wall and processor
//! time, best of several, and bytes beside what the same rollouts take as raw f32.
//!
//! `cargo bench --bench stores` prints CSV. `-- --policy run:DIR` records a trained policy, `--episodes N` another number,
//! `--repeats N` more of it; `--only WORD` leaves out what does not begin so, `--form store.mcap` the other forms.
#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints, and panics where it cannot start")]

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use ccmarl::record::{self, Options, POLICIES, Recording};
use ccmarl::registry::Spec;
use ccmarl::schema::Layout;
use ccmarl::train::replay::Replay;
use ccmarl::{scenario, storage};

/// The forms of a store.
const FORMS: [&str; 3] = ["store", "store.parquet", "store.mcap"];

fn main() {
    let option = |name: &str, default: &str| {
        let mut words = std::env::args().skip_while(|word| word != name);
        words.nth(1).unwrap_or_else(|| default.to_owned())
    };
    let episodes: u64 = option("--episodes", "16000").parse().unwrap();
    let repeats: u64 = option("--repeats", "5").parse().unwrap();
    let (only, form) = (option("--only", ""), option("--form", ""));
    let scenario = scenario::build(&Spec::new("simple_spread").with("agents", 3)).unwrap();
    let link = record::build_link(&Spec::new("perfect"), &*scenario).unwrap();
    let policy = Spec::parse("policy", POLICIES, &option("--policy", "random")).unwrap();
    let policy = record::build_policy(&policy, &*scenario).unwrap();
    let recording = Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: 1, episodes };
    let (layout, manifest) = (recording.layout(), recording.manifest());
    let directory = tempfile::tempdir().unwrap();
    let steps = episodes * scenario.steps() as u64;
    println!("what,form,steps_per_wall_s,steps_per_cpu_s,wall_s,cpu_s,gb_per_wall_s,bytes,of_raw_f32");
    for form in FORMS.into_iter().filter(|&f| form.is_empty() || f == form) {
        let path = directory.path().join(form);
        let record = || {
            let mut sink = storage::create(&path, &manifest, true).unwrap();
            recording.record(&mut *sink, Options::default(), &mut |_| {}, &AtomicBool::new(false)).unwrap();
            sink.finish().unwrap();
        };
        record();
        let rows = steps + episodes;
        let raw = rows * floats(&layout, true) * 4;
        let line = |what: &str, gigabytes: Option<u64>, work: &dyn Fn()| {
            if !what.starts_with(&only) {
                return;
            }
            let (wall, cpu) = best(repeats, work);
            let rate = gigabytes.map(|bytes| format!("{:.3}", bytes as f64 / wall / 1e9)).unwrap_or_default();
            let (steps, bytes) = (steps as f64, bytes(&path));
            let share = bytes as f64 / raw as f64;
            println!(
                "{what},{form},{:.0},{:.0},{wall:.3},{cpu:.3},{rate},{bytes},{share:.3}",
                steps / wall,
                steps / cpu
            );
        };
        line("record", None, &record);
        // decoded: observations, messages, actions and the team reward as f32, a byte per link
        let decoded = rows * (4 * floats(&layout, false) + layout.communicators().len().pow(2) as u64);
        line("read into replay", Some(decoded), &|| {
            let mut replay = Replay::new(&layout, scenario.steps(), steps as usize, false).unwrap();
            assert_eq!(replay.fill(&mut *storage::open(&path).unwrap()).unwrap(), episodes);
        });
        line("read episodes", Some(raw), &|| {
            let mut source = storage::open(&path).unwrap();
            while source.next_episode().unwrap().is_some() {}
        });
    }
}

/// Floats of a row; `all` counts the state (as f32, as a tool without double precision would keep it) and the rewards of
/// the agents too.
fn floats(layout: &Layout, all: bool) -> u64 {
    let agents: usize = layout.agents.iter().map(|a| a.observation + a.message + a.action + usize::from(all)).sum();
    (agents + 1 + if all { layout.state_fields.len() } else { 0 }) as u64
}

/// The least wall and the least processor time of `work`, seconds.
fn best(repeats: u64, work: &dyn Fn()) -> (f64, f64) {
    let once = |_| {
        let (start, before) = (Instant::now(), cpu_seconds());
        work();
        (start.elapsed().as_secs_f64(), cpu_seconds() - before)
    };
    (0..repeats).map(once).fold((f64::INFINITY, f64::INFINITY), |a, b| (a.0.min(b.0), a.1.min(b.1)))
}

/// Bytes of a file, or of the files of a directory.
fn bytes(path: &Path) -> u64 {
    let files: Vec<PathBuf> = match std::fs::read_dir(path) {
        Ok(entries) => entries.map(|entry| entry.unwrap().path()).collect(),
        Err(_) => vec![path.to_owned()],
    };
    files.iter().map(|file| file.metadata().unwrap().len()).sum()
}

/// Processor seconds of this process so far, all threads, user and system; Linux counts them in hundredths, elsewhere 0.
fn cpu_seconds() -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else { return 0.0 };
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    fields[11..13].iter().map(|ticks| ticks.parse::<f64>().unwrap() / 100.0).sum()
}
