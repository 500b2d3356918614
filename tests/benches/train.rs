//! What one update costs, on one core in CPU time, best of several: `simple_spread` of three agents with five outputs
//! each (decoder `mpe5`), batch 1024, hidden layers 64-64, as the fastest peers are measured.
//!
//! `cargo bench --bench train` prints CSV; `cargo bench --bench train -- DIR` also writes DIR/train.csv. An update is
//! what training does per 100 steps: the minibatch drawn, the Du-MIE trained and evaluated, critic, actors, targets.
#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints, and panics where it cannot start")]

mod cpu;

use std::fmt::Write as _;
use std::time::Instant;

use ccmarl::algo::{ActorStep, Batch, Maddpg, MaddpgConfig, Messages};
use ccmarl::io::write_atomic;
use ccmarl::nn::{Activation, Level, Mlp, Tape};
use ccmarl::record::{self, ActionNoise, Recording, Trained};
use ccmarl::registry::Spec;
use ccmarl::rng::Seeds;
use ccmarl::schema::{AgentSpec, Episode};
use ccmarl::train::config::{DumieConfig, Negatives};
use ccmarl::train::dumie::Dumie;
use ccmarl::train::replay::Replay;

/// Measurements of which the best counts.
const REPEATS: usize = 8;

/// Seconds of CPU time of one measurement, at least: many times what Linux counts it in.
const LONG: f64 = 0.25;

const BATCH: usize = 1024;

/// Everything that an update needs.
struct Bench {
    learner: Maddpg,
    dumie: Option<Dumie>,
    replay: Replay,
    batch: Batch,
    /// What encoders make of the minibatch.
    sent: Vec<f32>,
    bonus: Vec<f32>,
    update: u64,
}

/// Seconds per update: in all, then by part (minibatch, Du-MIE trained, Du-MIE evaluated, networks).
#[derive(Clone, Copy)]
struct Cost {
    all: f64,
    parts: [f64; 4],
}

impl Bench {
    fn new(config: MaddpgConfig, dumie: Option<DumieConfig>) -> Self {
        let spec = Spec::new("simple_spread").with("decoder", "mpe5");
        let scenario = ccmarl::scenario::build(&spec).unwrap();
        let link = record::build_link(&Spec::new("dropout").with("p", 0.2), &*scenario).unwrap();
        let learners: Vec<&AgentSpec> = scenario.agents().iter().filter(|a| a.learner).collect();
        let seeds = Seeds::new(1);
        let learner = Maddpg::new(&learners, Activation::Tanh, config, &seeds).unwrap();
        let mut policy = record::build_policy(&Spec::new("random"), &*scenario).unwrap();
        if learner.actors.encodes() {
            let params = learner.params.actors.read();
            let noise = ActionNoise::Gaussian(1.0);
            policy = Box::new(Trained::new(learner.actors.clone(), &params, noise, serde_json::Map::new()));
        }
        let recording = Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: 1, episodes: 400 };
        let episodes: Vec<Episode> = (0..400).map(|index| recording.episode(index)).collect();
        let layout = recording.layout();
        let mut replay = Replay::new(&layout, scenario.steps(), 100_000, learner.actors.encodes()).unwrap();
        let mut dumie = dumie.map(|config| Dumie::new(&layout, config, [0.01, 0.01], &seeds).unwrap());
        for episode in &episodes {
            replay.push(episode, &[]).unwrap();
            if let Some(dumie) = &mut dumie {
                dumie.observe(episode);
            }
        }
        let [sent, bonus] = [Vec::new(), Vec::new()];
        Self { learner, dumie, replay, batch: Batch::default(), sent, bonus, update: 0 }
    }

    /// One update; adds what each part took.
    fn update(&mut self, parts: &mut [f64; 4]) {
        let mut last = Instant::now();
        let mut lap = |part: &mut f64| {
            let now = Instant::now();
            *part += (now - std::mem::replace(&mut last, now)).as_secs_f64();
        };
        let mut rng = Seeds::new(1).indexed_stream("update", self.update);
        self.replay.sample(&mut rng, BATCH, &mut self.batch);
        lap(&mut parts[0]);
        self.bonus.clear();
        if let Some(dumie) = &mut self.dumie {
            let mut senders = self.learner.senders();
            dumie.train(&self.replay, senders.as_mut(), &mut rng, None).unwrap();
            lap(&mut parts[1]);
            let messages = senders.map_or(&self.batch.observations, |mut senders| {
                senders.encode(&self.batch.observations, BATCH, &mut self.sent);
                &self.sent
            });
            dumie.bonus(&self.batch, messages, &mut rng, &mut self.bonus);
            lap(&mut parts[2]);
        }
        assert!(self.learner.update(&self.batch, &self.bonus).unwrap().is_finite());
        lap(&mut parts[3]);
        self.update += 1;
    }

    /// The cheapest of several measurements; parts by the clock, scaled to CPU time.
    fn measure(&mut self) -> Cost {
        let mut best = Cost { all: f64::INFINITY, parts: [0.0; 4] };
        for _ in 0..REPEATS {
            let mut parts = [0.0; 4];
            let all = per_call(|| self.update(&mut parts));
            if all < best.all {
                let sum: f64 = parts.iter().sum();
                best = Cost { all, parts: parts.map(|part| part * all / sum) };
            }
        }
        best
    }

    /// Multiplications and additions of the networks' products in one update, as written: nothing that only the
    /// implementation skips or pads counts.
    fn flop(&self) -> f64 {
        let products = |mlp: &Mlp, from: usize| {
            (from..mlp.layers()).map(|l| mlp.weight(l).0.into_iter().product::<usize>()).sum::<usize>()
        };
        let critic = &self.learner.critic;
        let actions: usize = self.learner.actors.networks.iter().map(Mlp::outputs).sum();
        let first = critic.weight(0).0[0];
        // target, value, gradient of the weights, of the hidden layers; value again, gradient of the actions
        let mut mac = 4 * products(critic, 0) + 2 * products(critic, 1) + first * actions;
        let actors = &self.learner.actors;
        for network in actors.networks.iter().chain(&actors.encoders) {
            mac += 3 * products(network, 0) + products(network, 1);
        }
        if actors.encodes() {
            // gradients of the messages, through the first layer of each receiver
            let heard = |i: usize| actors.networks[i].inputs() - actors.observation[i];
            mac += (0..actors.len()).map(|i| heard(i) * actors.networks[i].weight(0).0[0]).sum::<usize>();
        }
        2.0 * (mac * BATCH) as f64
    }
}

fn main() {
    let out = std::env::args().skip(1).find(|a| !a.starts_with("--")).map(std::path::PathBuf::from);
    let mut csv = String::new();
    let mut line = |text: String| {
        println!("{text}");
        writeln!(csv, "{text}").unwrap();
    };
    let kernel = products();
    line(format!("# instructions {:?}; the product alone {kernel:.0} GFLOP/s", Level::best()));
    let parts = "ms_minibatch,ms_dumie_train,ms_dumie_evaluate,ms_networks";
    line(format!("case,ms_per_update,{parts},mflop_networks,gflop_per_s,of_kernel"));
    let off = MaddpgConfig { messages: Messages::Off, ..MaddpgConfig::default() };
    let encoder = MaddpgConfig { messages: Messages::Encoder, ..MaddpgConfig::default() };
    let per_agent = |config: MaddpgConfig| MaddpgConfig { actor_step: ActorStep::PerAgent, ..config };
    let with = |negatives| Some(DumieConfig { negatives, ..DumieConfig::default() });
    for (name, config, dumie) in [
        ("no messages", off.clone(), None),
        ("messages", MaddpgConfig::default(), None),
        ("encoded messages", encoder.clone(), None),
        ("cc-maddpg 16 negatives", MaddpgConfig::default(), with(Negatives::Count(16))),
        ("cc-maddpg encoded messages", encoder.clone(), with(Negatives::Count(16))),
        ("cc-maddpg all negatives", MaddpgConfig::default(), with(Negatives::All)),
        ("no messages per-agent", per_agent(off), None),
        ("messages per-agent", per_agent(MaddpgConfig::default()), None),
        ("encoded messages per-agent", per_agent(encoder), None),
    ] {
        let joint = config.actor_step == ActorStep::Joint;
        let mut bench = Bench::new(config, dumie);
        let cost = bench.measure();
        let ms = |seconds: f64| 1e3 * seconds;
        let parts = cost.parts.map(|part| format!("{:.3}", ms(part))).join(",");
        let rate = bench.flop() / cost.parts[3] * 1e-9;
        let rates =
            if joint { format!("{:.0},{rate:.0},{:.2}", bench.flop() * 1e-6, rate / kernel) } else { ",,".to_owned() };
        line(format!("{name},{:.3},{parts},{rates}", ms(cost.all)));
    }
    if let Some(dir) = out {
        write_atomic(&dir.join("train.csv"), csv.as_bytes()).unwrap();
    }
}

/// GFLOP/s of our product with bias and activation: eight layers of 64 × 64 over 1024 rows.
fn products() -> f64 {
    let mlp = Mlp::new(&[64; 9], Activation::Relu, Activation::Relu);
    let (mut params, mut tape) = (Vec::new(), Tape::default());
    mlp.init(&mut Seeds::new(1).stream("kernel"), &mut params);
    let x = vec![0.5; BATCH * 64];
    let seconds = best(|| assert!(mlp.forward(&params, &x, BATCH, &mut tape)[0] >= 0.0));
    2.0 * (8 * 64 * 64 * BATCH) as f64 / seconds * 1e-9
}

/// Seconds of CPU time per call, the best of several measurements.
fn best(mut work: impl FnMut()) -> f64 {
    (0..REPEATS).map(|_| per_call(&mut work)).fold(f64::INFINITY, f64::min)
}

/// Seconds of CPU time per call, over a measurement.
fn per_call(mut work: impl FnMut()) -> f64 {
    let (start, mut calls) = (cpu::seconds(), 0);
    while cpu::seconds() - start < LONG {
        for _ in 0..20 {
            work();
        }
        calls += 20;
    }
    (cpu::seconds() - start) / f64::from(calls)
}
