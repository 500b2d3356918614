//! The prey's rule: of many points around it, go to the best that can be reached.
//!
//! Candidates are scored in `f32`, the precision of the action they become: twice as fast, and this rule is most of the
//! cost of a step.

use rand::Rng as _;

use super::{Params, PreyScore};
use crate::rng::Stream;
use crate::scenario::World;

/// Candidates scored at once, the default number of them: small arrays on the stack, in a form that vectorises.
const BLOCK: usize = 100;

/// The prey's push: a point of the unit disc, or zero when every way is blocked.
pub(super) fn choose(params: &Params, world: World<'_>, rng: &mut Stream) -> [f64; 2] {
    let (mut best, mut push) = (f32::NEG_INFINITY, [0.0; 2]);
    let mut left = params.prey_candidates;
    while left > 0 {
        let count = left.min(BLOCK);
        left -= count;
        let (mut x, mut y) = ([0.0; BLOCK], [0.0; BLOCK]);
        fill_disc(&mut x[..count], &mut y[..count], rng);
        let scores = scores(params, world, &x, &y);
        for c in 0..count {
            if scores[c] > best {
                (best, push) = (scores[c], [f64::from(x[c]), f64::from(y[c])]);
            }
        }
    }
    push
}

/// Uniform points of the unit disc, by rejection from the square; both coordinates (24 bits each) from one draw. Every
/// draw is written and counts only if inside: without a branch to mispredict this is twice as fast.
fn fill_disc(x: &mut [f32], y: &mut [f32], rng: &mut Stream) {
    let coordinate = |bits: u32| (bits >> 8) as f32 * (1.0 / 8_388_608.0) - 1.0;
    let mut filled = 0;
    while filled < x.len() {
        let bits = rng.next_u64();
        let point = [coordinate(bits as u32), coordinate((bits >> 32) as u32)];
        (x[filled], y[filled]) = (point[0], point[1]);
        filled += usize::from(point[0] * point[0] + point[1] * point[1] <= 1.0);
    }
}

fn scores(params: &Params, world: World<'_>, x: &[f32; BLOCK], y: &[f32; BLOCK]) -> [f32; BLOCK] {
    let prey = params.common.agents;
    let touch = (params.predator_size + params.prey_size) as f32;
    let mut score = [if params.prey_score == PreyScore::Sum { 0.0 } else { f32::INFINITY }; BLOCK];
    // Squared distance from the nearest predator on the way; a minimum vectorises, a flag does not.
    let mut nearest = [f32::INFINITY; BLOCK];
    for predator in 0..prey {
        let d = world.offset(prey, predator).map(|c| c as f32);
        for k in 1..=params.prey_waypoints {
            let part = k as f32 / params.prey_waypoints as f32;
            // Waypoint k is at most `part` away from the prey: it cannot touch who is farther.
            if d[0] * d[0] + d[1] * d[1] < (part + touch) * (part + touch) {
                for c in 0..BLOCK {
                    let (dx, dy) = (d[0] - part * x[c], d[1] - part * y[c]);
                    nearest[c] = less(dx * dx + dy * dy, nearest[c]);
                }
            }
        }
        for c in 0..BLOCK {
            let (dx, dy) = (d[0] - x[c], d[1] - y[c]);
            let distance = (dx * dx + dy * dy).sqrt();
            score[c] = match params.prey_score {
                PreyScore::Sum => score[c] + distance,
                PreyScore::Min => less(score[c], distance),
            };
        }
    }
    for c in 0..BLOCK {
        if nearest[c] < touch * touch {
            score[c] = f32::NEG_INFINITY;
        }
    }
    score
}

/// The minimum in the form of one machine instruction (`f32::min` also orders NaN, which cannot occur here).
fn less(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;
    use crate::scenario::Shape;
    use crate::scenario::params::Profile;

    #[test]
    fn candidates_are_uniform_in_the_disc() {
        let mut rng = Seeds::new(1).stream("disc");
        let (mut x, mut y) = (vec![9.0; 20_000], vec![9.0; 20_000]);
        fill_disc(&mut x, &mut y, &mut rng);
        let points: Vec<[f32; 2]> = x.into_iter().zip(y).map(|(x, y)| [x, y]).collect();
        let share = |inside: &dyn Fn(&[f32; 2]) -> bool| points.iter().filter(|p| inside(p)).count() as f64 / 20_000.0;
        assert_eq!(share(&|p| p[0].hypot(p[1]) <= 1.0), 1.0);
        assert!((share(&|p| p[0].hypot(p[1]) <= 0.5) - 0.25).abs() < 0.016);
        assert!((share(&|p| p[0] > 0.0 && p[1] > 0.0) - 0.25).abs() < 0.016);
    }

    #[test]
    fn the_choice_is_the_best_of_its_own_candidates() {
        let params = Params { prey_candidates: 250, ..Params::of(Profile::Paper) };
        let shape = Shape { agents: 4, words: 0, landmarks: 0, goals: false };
        let mut state = vec![0.0; shape.width()];
        let predators = [[0.5, 0.2], [-0.3, 0.4], [0.1, -0.6]];
        predators.into_iter().enumerate().for_each(|(a, place)| shape.place(&mut state, a, place));
        let push = choose(&params, shape.world(&state), &mut Seeds::new(2).stream("prey"));
        let (mut x, mut y) = ([0.0; 250], [0.0; 250]);
        fill_disc(&mut x, &mut y, &mut Seeds::new(2).stream("prey"));
        let score = |p: [f32; 2]| -> f64 {
            let from = |a: usize, k: f64| {
                let [x, y] = predators[a];
                libm::hypot(x - k * f64::from(p[0]), y - k * f64::from(p[1]))
            };
            let free = (0..3).all(|a| (1..=5).all(|k| from(a, f64::from(k) / 5.0) >= 0.125));
            if free { (0..3).map(|a| from(a, 1.0)).sum() } else { f64::NEG_INFINITY }
        };
        let best = (0..250).map(|c| score([x[c], y[c]])).fold(f64::NEG_INFINITY, f64::max);
        assert!((score(push.map(|c| c as f32)) - best).abs() < 1e-6);
    }
}
