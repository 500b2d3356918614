//! # What it is
//! N predators chase one scripted prey around obstacles. The predators learn and communicate; the prey follows a rule.
//!
//! # Definition
//! Agents start uniform in [-1, 1]², obstacles in [-0.9, 0.9]², all at rest. After each step every predator earns
//! `contact_reward · #{predators that touch the prey}`, shared; the team reward is that number once, not times N. The
//! prey samples `prey_candidates` points of the unit disc around it, drops those on whose straight way (at
//! `prey_waypoints` even points) it would touch a predator, and pushes towards the one of greatest summed distance from
//! all predators (`prey_score = "min"`: from the nearest); if none is free it does not push. Its push is not multiplied by
//! the usual gain of 4 (`prey_accel` 1), which makes it slow.
//!
//! # Shapes and units
//! Observation `10 + 2N` (16 at N = 3), world units: own velocity, own position, obstacles relative, other agents
//! relative (predators, then the prey), velocity of the prey; what is beyond `view_radius` is zeros. The prey's own
//! observation has the same width and hides nothing: its last pair is its own velocity. Action 2 (`force2`) or 5
//! (`mpe5`), the prey's too. State: `x y vx vy` per agent, `x y` per obstacle (`landmark_k`).
//!
//! # Parameters
//! See [`Params`]; `agents` is N, the number of predators. Null radius or speed means no limit.
//!
//! # When it fails
//! Reward is sparse: a random policy earns about 1 per episode. More predators make the world crowded: they collide.
//!
//! # Reference
//! FACMAC `continuous_pred_prey_3a` (Peng et al. 2021), as used by PMIC (`simple_tag_coop_partial_obs`) and arXiv
//! 2512.03528.
//!
//! # Differences from the reference implementation
//! Candidates are drawn by rejection from the square (there: radius and angle), at 24 bits per coordinate, and scored in
//! `f32`: the same distribution without trigonometry. One prey and two obstacles at every N, as PMIC has it. The prey's
//! reward, which is never computed there, is 0.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Decoder, Integration, Laws, Physics, Scenario, World, Writer};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;
use crate::schema::{AgentSpec, Controller};

mod prey;

/// The scenario's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "simple_tag",
    summary: "N predators catch one scripted prey among obstacles",
    reference: "Lowe et al. 2017 (MPE); FACMAC and PMIC's partially observed variant",
    value: Some("agents"),
    build,
};

/// Every constant of the task. Lengths in world units, speeds per second.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Params {
    /// Only `paper` for now.
    profile: String,
    /// N, the number of predators: 1 to 1000.
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
    /// Radius of a predator: [0, 1].
    predator_size: f64,
    /// Gain of a predator from control to force: [0, 100].
    predator_accel: f64,
    /// Top speed of a predator: (0, 100], or none.
    predator_max_speed: Option<f64>,
    /// Radius of the prey: [0, 1].
    prey_size: f64,
    /// Gain of the prey: [0, 100]. 1 is the code behind the paper, 4 what its agents are declared with.
    prey_accel: f64,
    /// Top speed of the prey: (0, 100], or none.
    prey_max_speed: Option<f64>,
    /// Points the prey considers per step: 1 to 10000.
    prey_candidates: usize,
    /// Points checked on the way to each: 1 to 100.
    prey_waypoints: usize,
    /// Distance from whom the prey maximises.
    prey_score: PreyScore,
    /// Number of obstacles: 0 to 100.
    obstacles: usize,
    /// Radius of an obstacle: [0, 1].
    obstacle_size: f64,
    /// Half width of the square in which agents start: [0, 100].
    arena: f64,
    /// Half width of the square in which obstacles stand: [0, 100].
    obstacle_arena: f64,
    /// How far a predator sees: [0, 1000], or everywhere.
    view_radius: Option<f64>,
    /// Earned by all predators per contact and step: [-1000, 1000].
    contact_reward: f64,
}

/// What the prey maximises.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum PreyScore {
    /// The sum of the distances from all predators (PMIC).
    Sum,
    /// The distance from the nearest (FACMAC's default).
    Min,
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
            predator_size: 0.075,
            predator_accel: 3.0,
            predator_max_speed: Some(1.0),
            prey_size: 0.05,
            prey_accel: 1.0,
            prey_max_speed: Some(1.3),
            prey_candidates: 100,
            prey_waypoints: 5,
            prey_score: PreyScore::Sum,
            obstacles: 2,
            obstacle_size: 0.2,
            arena: 1.0,
            obstacle_arena: 0.9,
            view_radius: Some(0.25),
            contact_reward: 10.0,
        }
    }
}

impl Params {
    fn check(&self, spec: &Spec, laws: &Laws) -> Result<(), RegistryError> {
        super::check_common(spec, &self.profile, self.agents, self.steps, laws)?;
        for (key, value, high) in [
            ("predator_size", self.predator_size, 1.0),
            ("predator_accel", self.predator_accel, 100.0),
            ("prey_size", self.prey_size, 1.0),
            ("prey_accel", self.prey_accel, 100.0),
            ("obstacle_size", self.obstacle_size, 1.0),
            ("arena", self.arena, 100.0),
            ("obstacle_arena", self.obstacle_arena, 100.0),
            ("view_radius", self.view_radius.unwrap_or(0.0), 1000.0),
        ] {
            spec.in_range(key, value, 0.0, high)?;
        }
        spec.in_range("predator_max_speed", self.predator_max_speed.unwrap_or(1.0), f64::MIN_POSITIVE, 100.0)?;
        spec.in_range("prey_max_speed", self.prey_max_speed.unwrap_or(1.0), f64::MIN_POSITIVE, 100.0)?;
        spec.in_range("prey_candidates", self.prey_candidates as f64, 1.0, 10_000.0)?;
        spec.in_range("prey_waypoints", self.prey_waypoints as f64, 1.0, 100.0)?;
        spec.in_range("obstacles", self.obstacles as f64, 0.0, 100.0)?;
        spec.in_range("contact_reward", self.contact_reward, -1000.0, 1000.0)
    }

    fn agent_specs(&self) -> Vec<AgentSpec> {
        let observation = 6 + 2 * self.obstacles + 2 * self.agents;
        let predator = |i: usize| AgentSpec {
            name: format!("adversary_{i}"),
            team: "predators".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation,
            message: observation,
            action: self.decoder.width(),
        };
        let prey = AgentSpec {
            name: "agent_0".to_owned(),
            team: "prey".to_owned(),
            controller: Controller::Scripted,
            learner: false,
            communicator: false,
            message: 0,
            ..predator(0)
        };
        (0..self.agents).map(predator).chain([prey]).collect()
    }
}

struct SimpleTag {
    params: Params,
    agents: Vec<AgentSpec>,
    physics: Physics,
    /// Squared view radius of a predator.
    sees: f64,
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
    p.check(spec, &laws)?;
    let body = |size, accel, max_speed: Option<f64>| Body {
        size,
        accel,
        max_speed: max_speed.unwrap_or(f64::INFINITY),
        collide: true,
    };
    let mut bodies = vec![body(p.predator_size, p.predator_accel, p.predator_max_speed); p.agents];
    bodies.push(body(p.prey_size, p.prey_accel, p.prey_max_speed));
    let physics = Physics::new(laws, &bodies, &vec![body(p.obstacle_size, 0.0, None); p.obstacles]);
    let radius = p.view_radius.unwrap_or(f64::INFINITY);
    Ok(Box::new(SimpleTag { agents: p.agent_specs(), physics, sees: radius * radius, params: p }))
}

impl Scenario for SimpleTag {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn agents(&self) -> &[AgentSpec] {
        &self.agents
    }

    fn state_fields(&self) -> Vec<String> {
        super::body_fields(&self.agents, self.params.obstacles)
    }

    fn steps(&self) -> usize {
        self.params.steps
    }

    fn reward_convention(&self) -> &'static str {
        "10 per predator-prey contact and step, summed over predators, counted once for the team"
    }

    fn team_reward(&self, rewards: &[f32]) -> Option<f32> {
        rewards.first().copied()
    }

    fn world(&self) -> World {
        self.physics.world()
    }

    fn reset(&self, world: &mut World, rng: &mut Stream) {
        let (agents, obstacles) = world.positions.split_at_mut(self.params.agents + 1);
        super::scatter(agents, self.params.arena, rng);
        super::scatter(obstacles, self.params.obstacle_arena, rng);
        world.velocities.fill([0.0; 2]);
    }

    fn observe(&self, world: &World, observations: &mut [f32]) {
        let prey = self.params.agents;
        for (i, row) in observations.chunks_exact_mut(self.agents[0].observation).enumerate() {
            let sees = if i == prey { f64::INFINITY } else { self.sees };
            let mut out = Writer { rest: row };
            out.pair(world.velocities[i]);
            out.pair(world.positions[i]);
            (prey + 1..world.positions.len()).for_each(|o| _ = out.seen(world, i, o, sees));
            let mut prey_seen = i == prey;
            for other in (0..=prey).filter(|&a| a != i) {
                let seen = out.seen(world, i, other, sees);
                prey_seen |= seen && other == prey;
            }
            out.pair(if prey_seen { world.velocities[prey] } else { [0.0; 2] });
        }
    }

    fn scripted(&self, world: &World, rng: &mut Stream, actions: &mut [f32]) {
        let width = self.params.decoder.width();
        let push = prey::choose(&self.params, world, rng);
        self.params.decoder.encode(push, &mut actions[self.params.agents * width..]);
    }

    /// Every predator pushes with all its might straight at where the prey will be in one step.
    fn oracle(&self, world: &World, actions: &mut [f32]) {
        let prey = self.params.agents;
        let bound = self.params.decoder.bound();
        for (a, action) in actions.chunks_exact_mut(self.params.decoder.width()).take(prey).enumerate() {
            let d = world.offset(a, prey);
            let largest = d[0].abs().max(d[1].abs()).max(1e-12);
            self.params.decoder.encode(d.map(|c| c / largest * bound), action);
        }
    }

    fn step(&self, world: &mut World, actions: &[f32], rewards: &mut [f32]) -> f32 {
        let (p, prey) = (&self.params, self.params.agents);
        self.physics.step(world, p.decoder, actions);
        let reach = p.predator_size + p.prey_size;
        let contacts = (0..prey).filter(|&a| world.squared_distance(a, prey) < reach * reach).count();
        let team = (p.contact_reward * contacts as f64) as f32;
        rewards[..prey].fill(team);
        rewards[prey] = 0.0;
        team
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;

    #[test]
    fn contacts_are_summed_and_shared_once() {
        let s = build(&Spec::new("simple_tag")).unwrap();
        let mut world = s.world();
        world.positions = vec![[0.1, 0.0], [-0.1, 0.0], [2.0, 2.0], [0.0, 0.0], [5.0, 5.0], [-5.0, 5.0]];
        let mut rewards = [9.0; 4];
        // 0.025 deep on both sides: each predator leaves at 0.25 per second, 0.025 in the step, and still just touches.
        world.velocities[0] = [-0.2, 0.0];
        world.velocities[1] = [0.2, 0.0];
        assert_eq!(s.step(&mut world, &[0.0; 8], &mut rewards), 20.0);
        assert_eq!(rewards, [20.0, 20.0, 20.0, 0.0]);
    }

    #[test]
    fn a_predator_sees_only_near_things_and_the_prey_sees_all() {
        let s = build(&Spec::new("simple_tag").with("agents", 2)).unwrap();
        assert_eq!(s.agents()[2].observation, 14);
        let mut world = s.world();
        world.positions = vec![[0.0, 0.0], [1.0, 0.0], [0.0, 0.25], [0.125, 0.0], [0.5, 0.5]];
        world.velocities[2] = [0.5, -0.5];
        let mut seen = [9.0; 42];
        s.observe(&world, &mut seen);
        let expected = [0.0, 0.0, 0.0, 0.0, 0.125, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.5, -0.5];
        assert_eq!(seen[..14], expected);
        assert_eq!(seen[14..28], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(seen[32..42], [0.125, -0.25, 0.5, 0.25, 0.0, -0.25, 1.0, -0.25, 0.5, -0.5]);
    }

    #[test]
    fn the_prey_flees_and_stays_put_when_surrounded() {
        let s = build(&Spec::new("simple_tag").with("agents", 1)).unwrap();
        let mut world = s.world();
        let mut rng = Seeds::new(1).stream("prey");
        world.positions = vec![[0.5, 0.0], [0.0, 0.0], [9.0, 9.0], [9.0, 9.0]];
        let mut actions = [7.0; 4];
        s.scripted(&world, &mut rng, &mut actions);
        assert_eq!(actions[..2], [7.0, 7.0], "the predators' actions are left alone");
        assert!(actions[2] < -0.7 && actions[3].abs() < 0.7 && actions[2].hypot(actions[3]) <= 1.0, "{actions:?}");
        world.positions[0] = [0.0, 0.0];
        s.scripted(&world, &mut rng, &mut actions);
        assert!(actions[2].hypot(actions[3]) > 0.6, "only long ways lead out of a predator: {actions:?}");
        let ring = build(&Spec::new("simple_tag").with("agents", 1).with("predator_size", 1.0)).unwrap();
        ring.scripted(&world, &mut rng, &mut actions);
        assert_eq!(actions[2..], [0.0, 0.0], "nowhere to go");
    }

    #[test]
    fn the_preys_push_is_not_scaled() {
        let s = build(&Spec::new("simple_tag").with("agents", 1)).unwrap();
        let mut world = s.world();
        world.positions = vec![[-3.0, 0.0], [3.0, 0.0], [9.0, 9.0], [9.0, 9.0]];
        s.step(&mut world, &[1.0, 0.0, 1.0, 0.0], &mut [0.0; 2]);
        assert!((world.velocities[0][0] - 0.3).abs() < 1e-12 && (world.velocities[1][0] - 0.1).abs() < 1e-12);
    }
}
