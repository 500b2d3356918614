//! The prey's rule: of many points around it, go to the best that can be reached.

use rand::Rng as _;

use super::{Params, PreyScore};
use crate::rng::Stream;
use crate::scenario::World;

/// Candidates scored at once: small arrays on the stack, in a form the compiler vectorises.
const BLOCK: usize = 64;

/// The prey's push: a point of the unit disc, or zero when every way is blocked.
pub(super) fn choose(params: &Params, world: &World, rng: &mut Stream) -> [f64; 2] {
    let (mut best, mut push) = (f64::NEG_INFINITY, [0.0; 2]);
    let mut left = params.prey_candidates;
    while left > 0 {
        let count = left.min(BLOCK);
        left -= count;
        let (mut x, mut y) = ([0.0; BLOCK], [0.0; BLOCK]);
        for (x, y) in x.iter_mut().zip(&mut y).take(count) {
            [*x, *y] = in_disc(rng);
        }
        let scores = scores(params, world, &x, &y);
        for c in 0..count {
            if scores[c] > best {
                (best, push) = (scores[c], [x[c], y[c]]);
            }
        }
    }
    push
}

/// A uniform point of the unit disc, by rejection; both coordinates from one draw.
fn in_disc(rng: &mut Stream) -> [f64; 2] {
    const UNIT: f64 = 1.0 / 2_147_483_648.0;
    loop {
        let bits = rng.next_u64();
        let point = [f64::from(bits as u32) * UNIT - 1.0, f64::from((bits >> 32) as u32) * UNIT - 1.0];
        if point[0] * point[0] + point[1] * point[1] <= 1.0 {
            return point;
        }
    }
}

fn scores(params: &Params, world: &World, x: &[f64; BLOCK], y: &[f64; BLOCK]) -> [f64; BLOCK] {
    let prey = params.agents;
    let touch = params.predator_size + params.prey_size;
    let mut score = [if params.prey_score == PreyScore::Sum { 0.0 } else { f64::INFINITY }; BLOCK];
    let mut blocked = [false; BLOCK];
    for predator in 0..prey {
        let d = world.offset(prey, predator);
        // No way is longer than 1: who is farther than that and a touch blocks nothing.
        if d[0] * d[0] + d[1] * d[1] < (1.0 + touch) * (1.0 + touch) {
            for k in 1..=params.prey_waypoints {
                let part = k as f64 / params.prey_waypoints as f64;
                for c in 0..BLOCK {
                    let (dx, dy) = (d[0] - part * x[c], d[1] - part * y[c]);
                    blocked[c] |= dx * dx + dy * dy < touch * touch;
                }
            }
        }
        for c in 0..BLOCK {
            let (dx, dy) = (d[0] - x[c], d[1] - y[c]);
            let distance = (dx * dx + dy * dy).sqrt();
            score[c] = match params.prey_score {
                PreyScore::Sum => score[c] + distance,
                PreyScore::Min => score[c].min(distance),
            };
        }
    }
    for c in 0..BLOCK {
        if blocked[c] {
            score[c] = f64::NEG_INFINITY;
        }
    }
    score
}
