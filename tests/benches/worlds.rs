//! What a step of every world costs, alone: actions given, the world moved, rewards and observations written, a new
//! episode every 25 steps; the prey's rule included. One core, CPU time, best of several.
//!
//! `cargo bench --bench worlds` prints CSV; `cargo bench --bench worlds -- DIR` also writes DIR/worlds.csv and the figure
//! of cost against number of agents.
#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints, and panics where it cannot start")]

mod cpu;

use std::fmt::Write as _;

use ccmarl::figure::{Curve, Data, FIGURES, Point, svg};
use ccmarl::io::write_atomic;
use ccmarl::registry::{Spec, find};
use ccmarl::rng::{Seeds, Stream};
use ccmarl::scenario::{Worlds, build};

/// Seconds of CPU time of one measurement, at least: a hundred times what Linux counts it in.
const LONG: f64 = 0.4;

/// Steps between two looks at the clock, at least.
const STEPS: usize = 5000;

/// Measurements of which the best counts.
const REPEATS: usize = 5;

fn main() {
    let out = std::env::args().skip(1).find(|a| !a.starts_with("--")).map(std::path::PathBuf::from);
    let mut csv = "scenario,profile,agents,worlds,steps_per_cpu_s,us_per_step\n".to_owned();
    print!("{csv}");
    let mut line = |spec: &Spec, agents: usize, worlds: usize| {
        let rate = measure(spec, worlds);
        let (name, profile) = (&spec.name, spec.params["profile"].as_str().unwrap());
        let line = format!("{name},{profile},{agents},{worlds},{rate:.0},{:.4}\n", 1e6 / rate);
        print!("{line}");
        csv.write_str(&line).unwrap();
        1e6 / rate
    };
    for name in ["simple_spread", "simple_reference", "simple_adversary", "simple_tag"] {
        for profile in ["paper", "mpe2"] {
            for worlds in [1, 256] {
                line(&Spec::new(name).with("profile", profile), if name == "simple_reference" { 2 } else { 3 }, worlds);
            }
        }
    }
    let mut data = Data {
        title: "A step of the world against the number of agents".to_owned(),
        subtitle: "profile paper, one core, CPU time, best of 5; observations and rewards of all agents included"
            .to_owned(),
        unit: "µs per step".to_owned(),
        ..Data::default()
    };
    for name in ["simple_spread", "simple_adversary", "simple_tag"] {
        let mut points = Vec::new();
        for agents in [3, 6, 12, 25, 50, 100] {
            let spec = Spec::new(name).with("profile", "paper").with("agents", agents);
            points.push(Point { step: agents as f64, value: line(&spec, agents, 16), band: None });
        }
        data.series.push(name.to_owned());
        data.costs.push(Curve { series: name.to_owned(), points });
    }
    if let Some(dir) = out {
        let figure = svg(find("figure", FIGURES, "scaling").unwrap(), &data).unwrap();
        write_atomic(&dir.join("worlds.csv"), csv.as_bytes()).unwrap();
        write_atomic(&dir.join("cost.svg"), figure.as_bytes()).unwrap();
    }
}

/// Steps per second of CPU time, over `count` worlds together.
fn measure(spec: &Spec, count: usize) -> f64 {
    let scenario = build(spec).unwrap();
    let total = |width: fn(&ccmarl::schema::AgentSpec) -> usize| scenario.agents().iter().map(width).sum::<usize>();
    let mut worlds = Worlds::new(&*scenario, count);
    let mut rngs: Vec<Stream> = (0..count as u64).map(|w| Seeds::new(w).stream("bench")).collect();
    let mut observations = vec![0.0; count * total(|a| a.observation)];
    let (mut rewards, mut team) = (vec![0.0; count * scenario.agents().len()], vec![0.0; count]);
    // drawn before: the world is measured, not the generator
    let mut drawn = vec![0.0; 25 * count * total(|a| a.action)];
    drawn.chunks_exact_mut(scenario.space().width()).for_each(|a| scenario.space().sample(&mut rngs[0], a));
    let mut actions: Vec<Vec<f32>> = drawn.chunks_exact(count * total(|a| a.action)).map(<[f32]>::to_vec).collect();
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        let start = cpu::seconds();
        let mut taken = 0;
        while cpu::seconds() - start < LONG {
            let next = taken + STEPS;
            while taken < next {
                for (world, rng) in rngs.iter_mut().enumerate() {
                    worlds.reset(world, rng);
                }
                for actions in &mut actions {
                    worlds.scripted(&mut rngs, actions);
                    worlds.step(actions, &mut rewards, &mut team);
                    worlds.observe(&mut observations);
                }
                taken += 25 * count;
            }
        }
        best = best.min((cpu::seconds() - start) / taken as f64);
    }
    assert!(observations.iter().chain(&rewards).all(|v| v.is_finite()));
    1.0 / best
}
