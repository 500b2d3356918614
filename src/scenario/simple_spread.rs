//! # What it is
//! N agents, N landmarks: cover all landmarks without bumping into each other. Everyone learns and communicates.
//!
//! # Definition
//! Agents and landmarks start uniform in [-1, 1]², at rest. After each step agent i earns
//! `r_i = −Σ_l min_a |p_a − p_l| − #{a : |p_a − p_i| < 2 size} + cover_bonus · [every landmark has an agent within
//! cover_radius]`; the count includes i itself (`self_collision`). With a `local_ratio` λ (profile `mpe2`: 0.5, neither
//! bonus nor self-collision) it is `(1 − λ)` times the shared and λ times the own part. The team reward is the SUM of all
//! `r_i`.
//!
//! # Shapes and units
//! Observation `4 + 2N + 4(N − 1)` (18 at N = 3), world units: own velocity, own position, landmarks relative, others
//! relative (zeros beyond `view_radius`), and 2(N − 1) zeros where silent others' utterances would stand.
//! Action 2 (`force2`) or 5 (`mpe5`, `mpe2`). State: `x y vx vy` per agent, `x y` per landmark.
//!
//! # Parameters
//! See [`Params`]; `agents` is N. `view_radius` `none` sees everything.
//!
//! # When it fails
//! Observations take N² memory: at N = 1000 one episode is over a gigabyte. Two landmarks closer than `2 size` cannot
//! both be covered without a collision.
//!
//! # Reference
//! Lowe et al. 2017 (MPE `simple_spread`); PMIC's file for the bonus and the summed reward; arXiv 2512.03528. Profile
//! `mpe2`: `simple_spread_v3` of mpe2 1.1.1, to whose trajectories it is held.
//!
//! # Differences from the reference implementation
//! PMIC has no view radius; the paper adds one without giving it: others are masked at 0.25 here, landmarks are not.
//! Two agents in exactly the same place do not push (there: NaN). Of mpe2's options, `curriculum`, `terminate_on_success`
//! and neighbour filters are not here.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::params::{AgentBodies, Common, MAX_AGENTS, Maybe, Profile, read};
use super::{Base, Body, Build, Physics, Scenario, Scratch, Team};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;

/// The scenario's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "simple_spread",
    summary: "N agents cover N landmarks and avoid collisions",
    reference: "Lowe et al. 2017 (MPE); reward scale of PMIC",
    value: Some("agents"),
    build,
};

/// Every constant of the task. Lengths in world units, speeds per second.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Params {
    /// Profile, N (also the number of landmarks: 1 to 1000), laws of motion.
    #[serde(flatten)]
    common: Common,
    /// Gain, top speed and radius of the agents, and whether they push each other.
    #[serde(flatten)]
    bodies: AgentBodies,
    /// How far others are seen: [0, 1000], or everywhere.
    view_radius: Maybe,
    /// Whether `view_radius` hides landmarks too.
    mask_landmarks: bool,
    /// Reward lost per collision: [0, 1000].
    collision_penalty: f64,
    /// Whether each agent counts as colliding with itself, a constant −1 (as the original code does).
    self_collision: bool,
    /// Distance at which a landmark counts as covered: [0, 10].
    cover_radius: f64,
    /// Earned by each agent while all are covered: [-1000, 1000].
    cover_bonus: f64,
    /// Weight of the agent's own part against the shared one: [0, 1], or none for their plain sum.
    local_ratio: Maybe,
}

impl Params {
    fn of(profile: Profile) -> Self {
        let paper = profile == Profile::Paper;
        Self {
            common: Common::of(profile, 3),
            bodies: AgentBodies::of(0.15, true),
            view_radius: Maybe(paper.then_some(0.25)),
            mask_landmarks: false,
            collision_penalty: 1.0,
            self_collision: paper,
            cover_radius: 0.1,
            cover_bonus: if paper { 1.0 } else { 0.0 },
            local_ratio: Maybe((!paper).then_some(0.5)),
        }
    }

    fn check(&self, spec: &Spec) -> Result<(), RegistryError> {
        self.common.check(spec, 1, MAX_AGENTS)?;
        self.bodies.check(spec)?;
        self.view_radius.check(spec, "view_radius", 0.0, 1000.0)?;
        spec.in_range("collision_penalty", self.collision_penalty, 0.0, 1000.0)?;
        spec.in_range("cover_radius", self.cover_radius, 0.0, 10.0)?;
        spec.in_range("cover_bonus", self.cover_bonus, -1000.0, 1000.0)?;
        self.local_ratio.check(spec, "local_ratio", 0.0, 1.0)
    }
}

struct SimpleSpread {
    params: Params,
    base: Base,
    /// Squared radii within which others and landmarks are seen.
    sees: [f64; 2],
}

fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    let p: Params = read(spec, Params::of)?;
    p.check(spec)?;
    let (n, space) = (p.common.agents, p.common.space(0));
    let observation = 4 + 2 * n + 4 * (n - 1);
    let agent = p.bodies.body();
    let landmark = Body { collide: false, ..agent };
    let radius = p.view_radius.or_infinite();
    let base = Base {
        agents: (0..n).map(|i| super::learner(format!("agent_{i}"), "agents", observation, space.width())).collect(),
        space,
        physics: Physics::new(p.common.laws(), &vec![agent; n], &vec![landmark; n], 0, false),
        steps: p.common.steps,
        team: Team::Sum,
    };
    let sees = [radius * radius, if p.mask_landmarks { radius * radius } else { f64::INFINITY }];
    Ok(Box::new(SimpleSpread { params: p, base, sees }))
}

impl Scenario for SimpleSpread {
    fn base(&self) -> &Base {
        &self.base
    }

    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn reward_convention(&self) -> &'static str {
        if self.params.local_ratio.0.is_some() {
            "sum over agents of the mix (local_ratio) of −distances, shared, and −collisions, own"
        } else {
            "sum over agents of (−distances − collisions, self included, + bonus when all are covered)"
        }
    }

    fn reset(&self, state: &mut [f64], rng: &mut Stream) {
        state.fill(0.0);
        super::scatter(self.shape(), state, 0..2 * self.params.common.agents, self.params.common.arena, rng);
    }

    fn observe(&self, state: &[f64], observations: &mut [f32]) {
        let (world, n) = (self.base.physics.world(state), self.params.common.agents);
        for (i, mut out) in super::writers(&self.base.agents, observations) {
            out.pair(world.velocity(i));
            out.pair(world.position(i));
            (n..2 * n).for_each(|l| _ = out.seen(world, i, l, self.sees[1]));
            (0..n).filter(|&a| a != i).for_each(|a| _ = out.seen(world, i, a, self.sees[0]));
            out.rest.fill(0.0);
        }
    }

    /// Each agent heads for the landmark that a shortest matching gives it, and brakes in time.
    fn oracle(&self, state: &[f64], actions: &mut [f32]) {
        let (world, n) = (self.base.physics.world(state), self.params.common.agents);
        let targets = match_landmarks(n, &|a, l| world.distance(a, n + l));
        self.base.head_for(state, actions, |agent| n + targets[agent]);
    }

    fn step(&self, state: &mut [f64], actions: &[f32], rewards: &mut [f32], scratch: &mut Scratch) {
        let (p, n) = (&self.params, self.params.common.agents);
        self.base.physics.step(state, self.base.space, actions, scratch);
        let world = self.base.physics.world(state);
        let (mut shared, mut covered) = (0.0, true);
        for l in n..2 * n {
            let nearest = (0..n).map(|a| world.squared_distance(a, l)).fold(f64::INFINITY, f64::min).sqrt();
            shared -= nearest;
            covered &= nearest < p.cover_radius;
        }
        if covered {
            shared += p.cover_bonus;
        }
        let size = p.bodies.agent_size;
        let reach = 4.0 * size * size;
        let itself = usize::from(p.self_collision && size > 0.0);
        let weights = p.local_ratio.0.map_or([1.0, 1.0], |own| [1.0 - own, own]);
        for (i, reward) in rewards.iter_mut().enumerate() {
            let hits = (0..n).filter(|&a| a != i && world.squared_distance(a, i) < reach).count() + itself;
            *reward = (weights[0] * shared - weights[1] * p.collision_penalty * hits as f64) as f32;
        }
    }
}

/// The landmark of each agent, of least total cost: the Hungarian method with potentials, O(N³), up to N = 64; beyond
/// that, agents choose in order, O(N²).
fn match_landmarks(n: usize, cost: &dyn Fn(usize, usize) -> f64) -> Vec<usize> {
    if n > 64 {
        let mut free: Vec<usize> = (0..n).collect();
        return (0..n)
            .map(|a| {
                let best = (0..free.len()).min_by(|&x, &y| cost(a, free[x]).total_cmp(&cost(a, free[y])));
                free.swap_remove(best.unwrap_or(0))
            })
            .collect();
    }
    // Row and column 0 are sentinels; `owner[l]` is the agent (1-based) that holds landmark l.
    let (mut rows, mut columns) = (vec![0.0; n + 1], vec![0.0; n + 1]);
    let mut owner = vec![0; n + 1];
    for agent in 1..=n {
        owner[0] = agent;
        let (mut slack, mut from) = (vec![f64::INFINITY; n + 1], vec![0; n + 1]);
        let mut done = vec![false; n + 1];
        let mut at = 0;
        while owner[at] != 0 {
            done[at] = true;
            let (row, mut least, mut next) = (owner[at], f64::INFINITY, 0);
            for l in (1..=n).filter(|&l| !done[l]) {
                let reduced = cost(row - 1, l - 1) - rows[row] - columns[l];
                if reduced < slack[l] {
                    (slack[l], from[l]) = (reduced, at);
                }
                if slack[l] < least {
                    (least, next) = (slack[l], l);
                }
            }
            for l in 0..=n {
                if done[l] {
                    rows[owner[l]] += least;
                    columns[l] -= least;
                } else {
                    slack[l] -= least;
                }
            }
            at = next;
        }
        while at != 0 {
            owner[at] = owner[from[at]];
            at = from[at];
        }
    }
    let mut targets = vec![0; n];
    (1..=n).for_each(|l| targets[owner[l] - 1] = l - 1);
    targets
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Seeds, uniform};

    fn scenario(spec: &Spec) -> Box<dyn Scenario> {
        build(spec).unwrap()
    }

    fn row(s: &dyn Scenario, places: &[[f64; 2]]) -> Vec<f64> {
        let mut state = vec![0.0; s.shape().width()];
        places.iter().enumerate().for_each(|(body, &place)| s.shape().place(&mut state, body, place));
        state
    }

    #[test]
    fn rewards_of_a_hand_made_world() {
        let s = scenario(&Spec::new("simple_spread"));
        let mut state = row(&*s, &[[0.0, 0.0], [0.29, 0.0], [5.0, 0.0], [0.0, 1.0], [0.29, 0.0], [5.0, 0.5]]);
        let mut rewards = [0.0; 3];
        // The contact of agents 0 and 1 moves them apart by about 0.01 · 100 · 0.1² each within the step.
        s.step(&mut state, &[0.0; 6], &mut rewards, &mut Scratch::default());
        let world = s.shape().world(&state);
        let nearest = |l: usize| (0..3).map(|a| world.distance(a, l)).fold(9.0, f64::min);
        let distances = nearest(3) + nearest(4) + nearest(5);
        let hit = f64::from(u8::from(world.squared_distance(0, 1) < 0.09));
        assert!((f64::from(rewards[0]) + distances + 1.0 + hit).abs() < 1e-6);
        assert!((f64::from(rewards[2]) + distances + 1.0).abs() < 1e-6, "it collides with itself only");
        assert!((s.team_reward(&rewards) - rewards.iter().sum::<f32>()).abs() < 1e-5);
    }

    #[test]
    fn all_landmarks_covered_earns_the_bonus_and_self_collision_can_be_off() {
        let places = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];
        for (own, expected) in [(true, 0.0), (false, 3.0)] {
            let s = scenario(&Spec::new("simple_spread").with("self_collision", own));
            let mut state = row(&*s, &[places, places].concat());
            let mut rewards = [9.0; 3];
            s.step(&mut state, &[0.0; 6], &mut rewards, &mut Scratch::default());
            assert_eq!(s.team_reward(&rewards), expected);
        }
    }

    #[test]
    fn the_observation_masks_far_agents_but_not_landmarks() {
        let s = scenario(&Spec::new("simple_spread").with("agents", 2));
        let mut state = row(&*s, &[[0.5, 0.25], [0.5, 0.5], [3.0, 0.25], [0.5, -1.0]]);
        s.shape().push(&mut state, 0, [1.0, 2.0]);
        let mut seen = [9.0; 24];
        s.observe(&state, &mut seen);
        assert_eq!(seen[..12], [1.0, 2.0, 0.5, 0.25, 2.5, 0.0, 0.0, -1.25, 0.0, 0.25, 0.0, 0.0]);
        s.shape().place(&mut state, 1, [0.5, 0.51]);
        s.observe(&state, &mut seen);
        assert_eq!(seen[8..12], [0.0; 4], "beyond the view radius");
        assert_eq!(scenario(&Spec::new("simple_spread")).agents()[0].observation, 18);
    }

    #[test]
    fn the_matching_is_the_best_of_all_permutations() {
        let mut rng = Seeds::new(1).stream("costs");
        for _ in 0..200 {
            let costs: Vec<f64> = (0..16).map(|_| uniform(&mut rng, 0.0, 1.0)).collect();
            let total = |order: &[usize]| order.iter().enumerate().map(|(a, &l)| costs[a * 4 + l]).sum::<f64>();
            let found = match_landmarks(4, &|a, l| costs[a * 4 + l]);
            let mut best = f64::INFINITY;
            for code in 0..256_usize {
                let order = [code % 4, code / 4 % 4, code / 16 % 4, code / 64];
                if (0..4).all(|l| order.contains(&l)) {
                    best = best.min(total(&order));
                }
            }
            assert!((total(&found) - best).abs() < 1e-12);
        }
    }
}
