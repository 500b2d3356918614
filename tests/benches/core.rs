//! Benchmarks of the core: rolling out episodes, one update of the learner. `worlds.rs` has the worlds alone.
#![expect(clippy::unwrap_used, reason = "a benchmark that cannot start may panic")]

use std::path::Path;

use ccmarl::record::{self, Recording};
use ccmarl::registry::Spec;
use ccmarl::scenario;
use ccmarl::train::{TrainConfig, Trainer};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};

fn episodes(c: &mut Criterion) {
    let mut group = c.benchmark_group("episode, steps");
    group.throughput(Throughput::Elements(25));
    for name in ["simple_spread", "simple_reference", "simple_adversary", "simple_tag"] {
        let scenario = scenario::build(&Spec::new(name)).unwrap();
        let link = record::build_link(&Spec::new("dropout").with("p", 0.2), scenario.as_ref()).unwrap();
        let policy = record::build_policy(&Spec::new("random"), scenario.as_ref()).unwrap();
        let recording = Recording {
            scenario: scenario.as_ref(),
            link: link.as_ref(),
            policy: policy.as_ref(),
            seed: 1,
            episodes: 1,
        };
        let mut index = 0;
        group.bench_function(name, |b| {
            b.iter(|| {
                index += 1;
                recording.episode(index)
            });
        });
    }
}

/// 100 environment steps and one update, as in training; the difference between rows is the algorithm's.
fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("100 steps and one update");
    for algorithm in ["maddpg", "fc-maddpg", "cc-maddpg"] {
        let config = TrainConfig::new(Spec::new("simple_spread"), algorithm).resolve().unwrap();
        let mut trainer = Trainer::new(config, Path::new("unused")).unwrap();
        while trainer.step() < 10_000 {
            trainer.advance(None).unwrap();
        }
        group.bench_function(algorithm, |b| {
            b.iter(|| {
                let end = trainer.step() + 100;
                while trainer.step() < end {
                    trainer.advance(None).unwrap();
                }
            });
        });
    }
}

criterion_group!(benches, episodes, updates);
criterion_main!(benches);
