//! What a value of `ksg1` costs, k = 4, without interval and p-value: the sizes that Python's peers are timed at. One
//! core, CPU time, best of several.
//!
//! `cargo bench --bench neighbours` prints CSV; `neighbours_beside_peers.sh` runs the peers in the same run.
#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints, and panics where it cannot start")]

use ccmarl::mi::ksg1_value;
use ccmarl::rng::{Seeds, normal};
use ccmarl::schema::Columns;

/// Measurements of which the best counts.
const REPEATS: usize = 5;
/// Seconds of CPU time of one measurement, at least: Linux counts it in hundredths.
const LONG: f64 = 0.3;

fn main() {
    println!("tool,n,dim,mi_nats,cpu_s");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for (n, width) in [(10_000, 1), (100_000, 1), (327_346, 1), (10_000, 5), (10_000, 25)] {
        let (x, y) = pairs(n, width, false);
        report("ccmarl_ksg1_k4", &x, &y, &pool);
    }
    let (x, y) = pairs(327_346, 1, true);
    report("ccmarl_ksg1_k4_rounded_to_0.02", &x, &y, &pool);
}

/// Columns with a common normal part of half their variance; `tied`: rounded to fiftieths.
fn pairs(n: usize, width: usize, tied: bool) -> (Columns, Columns) {
    let mut rng = Seeds::new(1).stream("bench");
    let names: Vec<String> = (0..width).map(|c| c.to_string()).collect();
    let (mut x, mut y) = (Vec::new(), Vec::new());
    let rounded = |v: f64| if tied { (50.0 * v).round() / 50.0 } else { v };
    for _ in 0..n * width {
        let shared = normal(&mut rng);
        x.push(rounded(shared + normal(&mut rng)));
        y.push(rounded(shared + normal(&mut rng)));
    }
    (Columns::new(x, names.clone()), Columns::new(y, names))
}

fn report(tool: &str, x: &Columns, y: &Columns, pool: &rayon::ThreadPool) {
    let mut value = 0.0;
    let mut measure = || {
        let (start, mut runs) = (cpu(), 0.0);
        while cpu() - start < LONG {
            value = pool.install(|| ksg1_value(x, y, 4));
            runs += 1.0;
        }
        (cpu() - start) / runs
    };
    let best = (0..REPEATS).map(|_| measure()).fold(f64::INFINITY, f64::min);
    println!("{tool},{},{},{value:.4},{best:.3}", x.rows(), x.width());
}

/// User and system CPU seconds of this process.
fn cpu() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    let ticks = |i: usize| fields[i].parse::<f64>().unwrap();
    (ticks(11) + ticks(12)) / 100.0
}
