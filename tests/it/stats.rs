//! Statistics on simulated trainings: do intervals hold what they promise?

use ccmarl::rng::{Seeds, normal};
use ccmarl::stats::{bootstrap_interval, iqm, mean, probability_of_improvement, t_interval};

#[test]
fn students_interval_over_five_seeds_covers_the_mean_as_often_as_it_says() {
    let mut stream = Seeds::new(11).stream("coverage");
    let covered = (0..2000)
        .filter(|_| {
            let seeds: Vec<f64> = (0..5).map(|_| 3.0 + 2.0 * normal(&mut stream)).collect();
            let interval = t_interval(&seeds, 0.95).unwrap();
            (interval.low..=interval.high).contains(&3.0)
        })
        .count();
    // 1900 expected, standard deviation 9.7
    assert!((1860..=1940).contains(&covered), "{covered} of 2000");
}

#[test]
fn the_bootstrap_of_an_interquartile_mean_covers_it_with_thirty_runs() {
    let mut stream = Seeds::new(12).stream("coverage");
    let covered = (0..200)
        .filter(|&k| {
            let runs: Vec<f64> = (0..30).map(|_| normal(&mut stream)).collect();
            let interval = bootstrap_interval(&runs, iqm, 0.95, 300, &Seeds::new(k)).unwrap();
            (interval.low..=interval.high).contains(&0.0)
        })
        .count();
    assert!((178..=199).contains(&covered), "{covered} of 200");
}

#[test]
fn a_better_algorithm_has_a_probability_of_improvement_above_a_half() {
    let mut stream = Seeds::new(13).stream("poi");
    let worse: Vec<f64> = (0..400).map(|_| normal(&mut stream)).collect();
    let better: Vec<f64> = (0..400).map(|_| 1.0 + normal(&mut stream)).collect();
    let p = probability_of_improvement(&better, &worse);
    // Φ(1/√2) = 0.7602
    assert!((p - 0.7602).abs() < 0.03, "{p}");
    assert!((p + probability_of_improvement(&worse, &better) - 1.0).abs() < 1e-12);
    assert!(mean(&better) > mean(&worse));
}

#[test]
fn the_slope_of_a_line_is_its_slope_and_of_one_point_nothing() {
    let line = [(0.0, 1.0), (1.0, 3.5), (4.0, 11.0)];
    assert!((ccmarl::stats::slope(&line) - 2.5).abs() < 1e-12);
    assert!(ccmarl::stats::slope(&line[..1]).is_nan());
}
