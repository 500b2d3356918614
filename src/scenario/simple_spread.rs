//! # What it is
//! N agents, N landmarks: cover all landmarks without bumping into each other. Everyone learns and communicates.
//!
//! # Definition
//! Agents and landmarks start uniform in [-1, 1]², at rest. After each step agent i earns
//! `r_i = −Σ_l min_a |p_a − p_l| − #{a : |p_a − p_i| < 2 size} + cover_bonus · [every landmark has an agent within
//! cover_radius]`; the count includes i itself (`self_collision`). The team reward is the SUM of all `r_i`.
//!
//! # Shapes and units
//! Observation `4 + 2N + 4(N − 1)` (18 at N = 3), world units: own velocity, own position, landmarks relative, others
//! relative (zeros beyond `view_radius`), and 2(N − 1) zeros where silent others' utterances would stand.
//! Action 2 (`force2`) or 5 (`mpe5`). State: `x y vx vy` per agent, `x y` per landmark.
//!
//! # Parameters
//! See [`Params`]; `agents` is N. `view_radius` null sees everything; `max_speed` null is none.
//!
//! # When it fails
//! Observations take N² memory: at N = 1000 one episode is over a gigabyte. Two landmarks closer than `2 size` cannot
//! both be covered without a collision.
//!
//! # Reference
//! Lowe et al. 2017 (MPE `simple_spread`); PMIC's file for the bonus and the summed reward; arXiv 2512.03528.
//!
//! # Differences from the reference implementation
//! PMIC has no view radius; the paper adds one without giving it: others are masked at 0.25 here, landmarks are not.
//! Two agents in exactly the same place do not push (there: NaN).

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Decoder, Integration, Laws, Physics, Scenario, World, Writer};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;
use crate::schema::{AgentSpec, Controller};

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
#[serde(deny_unknown_fields, default)]
struct Params {
    /// Only `paper` for now.
    profile: String,
    /// N, also the number of landmarks: 1 to 1000.
    agents: usize,
    /// T: 1 to 10000.
    steps: usize,
    /// From action to force.
    decoder: Decoder,
    /// Seconds in a step: [1e-4, 1].
    dt: f64,
    /// Share of velocity lost per step: [0, 1].
    damping: f64,
    /// Force per unit of overlap: [0, 1e4].
    contact_force: f64,
    /// Softness of contacts: [1e-9, 1].
    contact_margin: f64,
    /// Order of integration.
    integration: Integration,
    /// Gain from control to force: [0, 100].
    accel: f64,
    /// Top speed: (0, 100], or none.
    max_speed: Option<f64>,
    /// Radius of an agent: [0, 1].
    agent_size: f64,
    /// Whether agents push each other.
    collide: bool,
    /// Half width of the square in which bodies start: [0, 100].
    arena: f64,
    /// How far others are seen: [0, 1000], or everywhere.
    view_radius: Option<f64>,
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
}

impl Default for Params {
    fn default() -> Self {
        Self {
            profile: "paper".to_owned(),
            agents: 3,
            steps: 25,
            decoder: Decoder::Force2,
            dt: 0.1,
            damping: 0.25,
            contact_force: 100.0,
            contact_margin: 1e-3,
            integration: Integration::VelocityFirst,
            accel: 5.0,
            max_speed: None,
            agent_size: 0.15,
            collide: true,
            arena: 1.0,
            view_radius: Some(0.25),
            mask_landmarks: false,
            collision_penalty: 1.0,
            self_collision: true,
            cover_radius: 0.1,
            cover_bonus: 1.0,
        }
    }
}

struct SimpleSpread {
    params: Params,
    agents: Vec<AgentSpec>,
    physics: Physics,
    /// Squared radii within which others and landmarks are seen.
    sees: [f64; 2],
}

fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    let p: Params = spec.params()?;
    let laws = Laws {
        dt: p.dt,
        damping: p.damping,
        contact_force: p.contact_force,
        contact_margin: p.contact_margin,
        integration: p.integration,
    };
    super::check_common(spec, &p.profile, p.agents, p.steps, &laws)?;
    spec.in_range("accel", p.accel, 0.0, 100.0)?;
    spec.in_range("max_speed", p.max_speed.unwrap_or(1.0), f64::MIN_POSITIVE, 100.0)?;
    spec.in_range("agent_size", p.agent_size, 0.0, 1.0)?;
    spec.in_range("arena", p.arena, 0.0, 100.0)?;
    spec.in_range("view_radius", p.view_radius.unwrap_or(0.0), 0.0, 1000.0)?;
    spec.in_range("collision_penalty", p.collision_penalty, 0.0, 1000.0)?;
    spec.in_range("cover_radius", p.cover_radius, 0.0, 10.0)?;
    spec.in_range("cover_bonus", p.cover_bonus, -1000.0, 1000.0)?;
    let n = p.agents;
    let observation = 4 + 2 * n + 4 * (n - 1);
    let agents = (0..n).map(|i| AgentSpec {
        name: format!("agent_{i}"),
        team: "agents".to_owned(),
        controller: Controller::Policy,
        learner: true,
        communicator: true,
        observation,
        message: observation,
        action: p.decoder.width(),
    });
    let max_speed = p.max_speed.unwrap_or(f64::INFINITY);
    let agent = Body { size: p.agent_size, accel: p.accel, max_speed, collide: p.collide };
    let landmark = Body { collide: false, ..agent };
    let radius = p.view_radius.unwrap_or(f64::INFINITY);
    let sees = [radius * radius, if p.mask_landmarks { radius * radius } else { f64::INFINITY }];
    let physics = Physics::new(laws, &vec![agent; n], &vec![landmark; n]);
    Ok(Box::new(SimpleSpread { agents: agents.collect(), physics, sees, params: p }))
}

impl Scenario for SimpleSpread {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn agents(&self) -> &[AgentSpec] {
        &self.agents
    }

    fn state_fields(&self) -> Vec<String> {
        super::body_fields(&self.agents, self.params.agents)
    }

    fn steps(&self) -> usize {
        self.params.steps
    }

    fn reward_convention(&self) -> &'static str {
        "sum over agents of (−distances − collisions, self included, + bonus when all are covered)"
    }

    fn team_reward(&self, rewards: &[f32]) -> Option<f32> {
        Some(rewards.iter().map(|&r| f64::from(r)).sum::<f64>() as f32)
    }

    fn world(&self) -> World {
        self.physics.world()
    }

    fn reset(&self, world: &mut World, rng: &mut Stream) {
        super::scatter(&mut world.positions, self.params.arena, rng);
        world.velocities.fill([0.0; 2]);
    }

    fn observe(&self, world: &World, observations: &mut [f32]) {
        let n = self.params.agents;
        for (i, row) in observations.chunks_exact_mut(4 + 2 * n + 4 * (n - 1)).enumerate() {
            let mut out = Writer { rest: row };
            out.pair(world.velocities[i]);
            out.pair(world.positions[i]);
            (n..2 * n).for_each(|l| _ = out.seen(world, i, l, self.sees[1]));
            (0..n).filter(|&a| a != i).for_each(|a| _ = out.seen(world, i, a, self.sees[0]));
            out.rest.fill(0.0);
        }
    }

    fn scripted(&self, _world: &World, _rng: &mut Stream, _actions: &mut [f32]) {}

    /// Each agent heads for the landmark that a shortest matching gives it, and brakes in time.
    fn oracle(&self, world: &World, actions: &mut [f32]) {
        let n = self.params.agents;
        let targets = match_landmarks(n, &|a, l| world.squared_distance(a, n + l).sqrt());
        let (kept, gain) = (1.0 - self.params.damping, (self.params.accel * self.params.dt).max(1e-9));
        let bound = self.params.decoder.bound();
        for (a, action) in actions.chunks_exact_mut(self.params.decoder.width()).enumerate() {
            let d = world.offset(a, n + targets[a]);
            let v = world.velocities[a];
            // The wished velocity is proportional to the way left; the control is what gets there in one step.
            let u = [0, 1].map(|c| ((5.0 * d[c] - kept * v[c]) / gain).clamp(-bound, bound));
            self.params.decoder.encode(u, action);
        }
    }

    fn step(&self, world: &mut World, actions: &[f32], rewards: &mut [f32]) -> f32 {
        let (p, n) = (&self.params, self.params.agents);
        self.physics.step(world, p.decoder, actions);
        let (mut shared, mut covered) = (0.0, true);
        for l in n..2 * n {
            let nearest = (0..n).map(|a| world.squared_distance(a, l)).fold(f64::INFINITY, f64::min).sqrt();
            shared -= nearest;
            covered &= nearest < p.cover_radius;
        }
        if covered {
            shared += p.cover_bonus;
        }
        let reach = 4.0 * p.agent_size * p.agent_size;
        let own = usize::from(p.self_collision && p.agent_size > 0.0);
        let mut team = 0.0;
        for (i, reward) in rewards.iter_mut().enumerate() {
            let hits = (0..n).filter(|&a| a != i && world.squared_distance(a, i) < reach).count() + own;
            let r = shared - p.collision_penalty * hits as f64;
            *reward = r as f32;
            team += r;
        }
        team as f32
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

    #[test]
    fn rewards_of_a_hand_made_world() {
        let s = scenario(&Spec::new("simple_spread"));
        let mut world = s.world();
        world.positions = vec![[0.0, 0.0], [0.29, 0.0], [5.0, 0.0], [0.0, 1.0], [0.29, 0.0], [5.0, 0.5]];
        let mut rewards = [0.0; 3];
        // The contact of agents 0 and 1 moves them apart by about 0.01 · 100 · 0.1² each within the step.
        let team = s.step(&mut world, &[0.0; 6], &mut rewards);
        let nearest = |l: usize| (0..3).map(|a| world.squared_distance(a, l).sqrt()).fold(9.0, f64::min);
        let distances = nearest(3) + nearest(4) + nearest(5);
        let hit = f64::from(u8::from(world.squared_distance(0, 1) < 0.09));
        assert!((f64::from(rewards[0]) + distances + 1.0 + hit).abs() < 1e-6);
        assert!((f64::from(rewards[2]) + distances + 1.0).abs() < 1e-6, "it collides with itself only");
        assert!((team - rewards.iter().sum::<f32>()).abs() < 1e-5);
    }

    #[test]
    fn all_landmarks_covered_earns_the_bonus_and_self_collision_can_be_off() {
        let mut world = scenario(&Spec::new("simple_spread")).world();
        let places = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];
        world.positions = [places, places].concat();
        for (own, expected) in [(true, 0.0), (false, 3.0)] {
            let s = scenario(&Spec::new("simple_spread").with("self_collision", own));
            assert_eq!(s.step(&mut world.clone(), &[0.0; 6], &mut [0.0; 3]), expected);
        }
    }

    #[test]
    fn the_observation_masks_far_agents_but_not_landmarks() {
        let s = scenario(&Spec::new("simple_spread").with("agents", 2));
        let mut world = s.world();
        world.positions = vec![[0.5, 0.25], [0.5, 0.5], [3.0, 0.25], [0.5, -1.0]];
        world.velocities[0] = [1.0, 2.0];
        let mut seen = [9.0; 24];
        s.observe(&world, &mut seen);
        assert_eq!(seen[..12], [1.0, 2.0, 0.5, 0.25, 2.5, 0.0, 0.0, -1.25, 0.0, 0.25, 0.0, 0.0]);
        world.positions[1] = [0.5, 0.51];
        s.observe(&world, &mut seen);
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
