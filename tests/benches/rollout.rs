//! What an environment step costs in training beside the updates: the world, the links, acting with exploration noise,
//! and storing into replay (and rings). One core, CPU time, best of several.
//!
//! `cargo bench --bench rollout` prints CSV.
#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints, and panics where it cannot start")]

use std::path::Path;

use ccmarl::registry::Spec;
use ccmarl::train::{TrainConfig, Trainer};

/// Seconds of CPU time of one measurement, at least.
const LONG: f64 = 0.3;

/// Measurements of which the best counts.
const REPEATS: usize = 5;

fn main() {
    println!("scenario,algorithm,noise,envs,us_per_step,steps_per_cpu_s");
    for scenario in ["simple_spread", "simple_reference", "simple_adversary", "simple_tag"] {
        for (algorithm, noise) in [("fc-maddpg", 0), ("fc-maddpg", u64::MAX), ("cc-maddpg", u64::MAX)] {
            for envs in [1, 2, 4, 8, 16, 64, 256] {
                if envs != 1 && envs != 4 && scenario != "simple_spread" {
                    continue;
                }
                let us = 1e6 * measure(scenario, algorithm, noise, envs);
                println!("{scenario},{algorithm},{},{envs},{us:.3},{:.0}", noise > 0, 1e6 / us);
            }
        }
    }
}

/// Seconds of CPU time per environment step.
fn measure(scenario: &str, algorithm: &str, noise: u64, envs: usize) -> f64 {
    let mut config = TrainConfig::new(Spec::new(scenario), algorithm);
    config.envs = Some(envs);
    config.warmup = u64::MAX; // no update ever
    config.steps = u64::MAX;
    config.noise.episodes = noise;
    let mut trainer = Trainer::new(config.resolve().unwrap(), Path::new("unused")).unwrap();
    let mut advance = |steps: u64| {
        let end = trainer.step() + steps;
        while trainer.step() < end {
            trainer.advance(None).unwrap();
        }
        trainer.step()
    };
    // replay is full from here on
    let mut at = advance(110_000);
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        let (start, from) = (cpu::seconds(), at);
        while cpu::seconds() - start < LONG {
            at = advance(10_000);
        }
        best = best.min((cpu::seconds() - start) / (at - from) as f64);
    }
    best
}

#[path = "cpu.rs"]
mod cpu;
