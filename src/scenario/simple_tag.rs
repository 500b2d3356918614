//! # What it is
//! N predators chase one prey around obstacles. The predators learn and communicate; the prey follows a rule.
//!
//! # Definition
//! Agents start uniform in [-1, 1]², obstacles in [-0.9, 0.9]², all at rest. After each step every predator earns
//! `contact_reward · #{predators that touch the prey}`, shared; the team reward is that number once, not times N. The
//! prey samples `prey_candidates` points of the unit disc around it, drops those on whose straight way (at
//! `prey_waypoints` even points) it would touch a predator, and pushes towards the one of greatest summed distance from
//! all predators (`prey_score = "min"`: from the nearest); if none is free it does not push. Its push is not multiplied by
//! the usual gain of 4 (`prey_accel` 1), which makes it slow. In profile `mpe2` the prey is an agent like the others
//! (`prey_controller = "policy"`, gain 4), earns `−contact_reward` per contact and `−bound(|x|) − bound(|y|)` for leaving
//! the arena, nothing is hidden, and the team reward is the sum over all agents.
//!
//! # Shapes and units
//! Observation of a predator `10 + 2N` (16 at N = 3), world units: own velocity, own position, obstacles relative, other
//! agents relative (predators, then the prey), velocity of the prey; what is beyond `view_radius` is zeros. The prey
//! observes the same without the last pair and nothing is hidden from it. Action 2 (`force2`) or 5 (`mpe5`, `mpe2`), the
//! prey's too; when actions are discrete, its rule takes the nearest move. State: `x y vx vy` per agent, `x y` per obstacle (`landmark_k`).
//!
//! # Parameters
//! See [`Params`]; `agents` is N, the number of predators.
//!
//! # When it fails
//! Reward is sparse: a random policy earns about 1 per episode. More predators make the world crowded: they collide.
//!
//! # Reference
//! FACMAC `continuous_pred_prey_3a` (Peng et al. 2021), as used by PMIC (`simple_tag_coop_partial_obs`) and arXiv
//! 2512.03528. Profile `mpe2`: `simple_tag_v3` of mpe2 1.1.1, to whose trajectories it is held.
//!
//! # Differences from the reference implementation
//! Candidates are drawn by rejection from the square (there: radius and angle), at 24 bits per coordinate, and scored in
//! `f32`: the same distribution without trigonometry. One prey at every N, two obstacles unless set. In profile `paper` the
//! prey's reward, which is never computed there, is 0. Of mpe2's options, `num_good`, `curriculum`,
//! `terminate_on_success` and neighbour filters are not here.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::params::{Common, MAX_AGENTS, Maybe, Profile, read};
use super::{Base, Body, Build, Physics, Scenario, Scratch, Team, World};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;
use crate::schema::{AgentSpec, Controller};

mod prey;

/// The scenario's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "simple_tag",
    summary: "N predators catch one prey among obstacles",
    reference: "Lowe et al. 2017 (MPE); FACMAC and PMIC's partially observed variant",
    value: Some("agents"),
    build,
};

/// Every constant of the task. Lengths in world units, speeds per second.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Params {
    /// Profile, N (the number of predators: 1 to 1000), laws of motion.
    #[serde(flatten)]
    common: Common,
    /// Radius of a predator: [0, 1].
    predator_size: f64,
    /// Gain of a predator from control to force: [0, 100].
    predator_accel: f64,
    /// Top speed of a predator: (0, 100], or none.
    predator_max_speed: Maybe,
    /// Who moves the prey.
    prey_controller: Controller,
    /// Radius of the prey: [0, 1].
    prey_size: f64,
    /// Gain of the prey: [0, 100]. 1 is the code behind the paper, 4 what its agents are declared with.
    prey_accel: f64,
    /// Top speed of the prey: (0, 100], or none.
    prey_max_speed: Maybe,
    /// Points the prey's rule considers per step: 1 to 10000.
    prey_candidates: usize,
    /// Points checked on the way to each: 1 to 100.
    prey_waypoints: usize,
    /// Distance from whom the prey's rule maximises.
    prey_score: PreyScore,
    /// Number of obstacles: 0 to 100.
    obstacles: usize,
    /// Radius of an obstacle: [0, 1].
    obstacle_size: f64,
    /// Half width of the square in which obstacles stand: [0, 100].
    obstacle_arena: f64,
    /// How far a predator sees: [0, 1000], or everywhere.
    view_radius: Maybe,
    /// Earned by all predators per contact and step: [-1000, 1000].
    contact_reward: f64,
    /// Whether the prey loses by contacts and by leaving the arena, and its reward counts for the team.
    prey_reward: bool,
    /// What the team earns of the predators' rewards.
    team_reward: TeamReward,
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

/// What the team earns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum TeamReward {
    /// The predators' shared reward, once.
    Once,
    /// The sum over all agents.
    Sum,
}

impl Params {
    fn of(profile: Profile) -> Self {
        let paper = profile == Profile::Paper;
        Self {
            common: Common::of(profile, 3),
            predator_size: 0.075,
            predator_accel: 3.0,
            predator_max_speed: Maybe(Some(1.0)),
            prey_controller: if paper { Controller::Scripted } else { Controller::Policy },
            prey_size: 0.05,
            prey_accel: if paper { 1.0 } else { 4.0 },
            prey_max_speed: Maybe(Some(1.3)),
            prey_candidates: 100,
            prey_waypoints: 5,
            prey_score: PreyScore::Sum,
            obstacles: 2,
            obstacle_size: 0.2,
            obstacle_arena: 0.9,
            view_radius: Maybe(paper.then_some(0.25)),
            contact_reward: 10.0,
            prey_reward: !paper,
            team_reward: if paper { TeamReward::Once } else { TeamReward::Sum },
        }
    }

    fn check(&self, spec: &Spec) -> Result<(), RegistryError> {
        self.common.check(spec, 1, MAX_AGENTS)?;
        for (key, value, high) in [
            ("predator_size", self.predator_size, 1.0),
            ("predator_accel", self.predator_accel, 100.0),
            ("prey_size", self.prey_size, 1.0),
            ("prey_accel", self.prey_accel, 100.0),
            ("obstacle_size", self.obstacle_size, 1.0),
            ("obstacle_arena", self.obstacle_arena, 100.0),
        ] {
            spec.in_range(key, value, 0.0, high)?;
        }
        self.predator_max_speed.check(spec, "predator_max_speed", f64::MIN_POSITIVE, 100.0)?;
        self.prey_max_speed.check(spec, "prey_max_speed", f64::MIN_POSITIVE, 100.0)?;
        spec.in_range("prey_candidates", self.prey_candidates as f64, 1.0, 10_000.0)?;
        spec.in_range("prey_waypoints", self.prey_waypoints as f64, 1.0, 100.0)?;
        spec.in_range("obstacles", self.obstacles as f64, 0.0, 100.0)?;
        self.view_radius.check(spec, "view_radius", 0.0, 1000.0)?;
        spec.in_range("contact_reward", self.contact_reward, -1000.0, 1000.0)
    }

    fn agents(&self) -> Vec<AgentSpec> {
        let (n, action) = (self.common.agents, self.common.space(0).width());
        let observation = 6 + 2 * self.obstacles + 2 * n;
        let mut prey = super::learner("agent_0".to_owned(), "prey", observation - 2, action);
        if self.prey_controller == Controller::Scripted {
            prey =
                AgentSpec { controller: Controller::Scripted, learner: false, communicator: false, message: 0, ..prey };
        }
        let predator = |i| super::learner(format!("adversary_{i}"), "predators", observation, action);
        (0..n).map(predator).chain([prey]).collect()
    }
}

struct SimpleTag {
    params: Params,
    base: Base,
    /// Squared view radius of a predator.
    sees: f64,
}

fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    let p: Params = read(spec, Params::of)?;
    p.check(spec)?;
    let body = |size, accel, max_speed: Maybe| Body { size, accel, max_speed: max_speed.or_infinite(), collide: true };
    let mut bodies = vec![body(p.predator_size, p.predator_accel, p.predator_max_speed); p.common.agents];
    bodies.push(body(p.prey_size, p.prey_accel, p.prey_max_speed));
    let obstacles = vec![body(p.obstacle_size, 0.0, Maybe(None)); p.obstacles];
    let base = Base {
        agents: p.agents(),
        space: p.common.space(0),
        physics: Physics::new(p.common.laws(), &bodies, &obstacles, 0, false),
        steps: p.common.steps,
        team: if p.team_reward == TeamReward::Sum { Team::Sum } else { Team::First },
    };
    let radius = p.view_radius.or_infinite();
    Ok(Box::new(SimpleTag { params: p, base, sees: radius * radius }))
}

impl SimpleTag {
    /// The prey's number.
    fn prey(&self) -> usize {
        self.params.common.agents
    }

    /// Where a prey under policy control should flee: from the nearest predator, and back into the arena.
    fn flight(&self, world: World<'_>) -> [f64; 2] {
        let prey = self.prey();
        let distance =
            |a: &usize, b: &usize| world.squared_distance(*a, prey).total_cmp(&world.squared_distance(*b, prey));
        let away = (0..prey).min_by(distance).map_or([0.0; 2], |nearest| world.offset(nearest, prey));
        let norm = away[0].hypot(away[1]).max(1e-12);
        let place = world.position(prey);
        [0, 1].map(|c| away[c] / norm - 2.0 * (place[c] - place[c].clamp(-0.6, 0.6)))
    }
}

impl Scenario for SimpleTag {
    fn base(&self) -> &Base {
        &self.base
    }

    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn reward_convention(&self) -> &'static str {
        match self.params.team_reward {
            TeamReward::Once => {
                "contact_reward (10 unless set) per predator-prey contact and step, summed over predators, counted once"
            }
            TeamReward::Sum => "sum over agents: the contacts once per predator, and the prey's own reward",
        }
    }

    fn reset(&self, state: &mut [f64], rng: &mut Stream) {
        let (shape, agents) = (self.shape(), self.prey() + 1);
        state.fill(0.0);
        super::scatter(shape, state, 0..agents, self.params.common.arena, rng);
        super::scatter(shape, state, agents..agents + shape.landmarks, self.params.obstacle_arena, rng);
    }

    fn observe(&self, state: &[f64], observations: &mut [f32]) {
        let (world, prey) = (self.base.physics.world(state), self.prey());
        for (i, mut out) in super::writers(&self.base.agents, observations) {
            let sees = if i == prey { f64::INFINITY } else { self.sees };
            out.pair(world.velocity(i));
            out.pair(world.position(i));
            (prey + 1..=prey + self.params.obstacles).for_each(|o| _ = out.seen(world, i, o, sees));
            let mut prey_seen = false;
            for other in (0..=prey).filter(|&a| a != i) {
                let seen = out.seen(world, i, other, sees);
                prey_seen |= seen && other == prey;
            }
            if i != prey {
                out.pair(if prey_seen { world.velocity(prey) } else { [0.0; 2] });
            }
        }
    }

    fn scripted(&self, state: &[f64], rng: &mut Stream, actions: &mut [f32]) {
        if self.params.prey_controller == Controller::Scripted {
            let space = self.base.space;
            let push = prey::choose(&self.params, self.base.physics.world(state), rng);
            space.encode(push, &mut actions[self.prey() * space.width()..]);
        }
    }

    /// Every predator pushes with all its might straight at the prey; a prey under policy control flees from the nearest.
    fn oracle(&self, state: &[f64], actions: &mut [f32]) {
        let (space, prey) = (self.base.space, self.prey());
        let world = self.base.physics.world(state);
        for (a, action) in actions.chunks_exact_mut(space.width()).enumerate() {
            if a == prey && self.params.prey_controller == Controller::Scripted {
                continue;
            }
            let way = if a == prey { self.flight(world) } else { world.offset(a, prey) };
            let largest = way[0].abs().max(way[1].abs()).max(1e-12);
            space.encode(way.map(|c| c / largest * space.decoder.bound()), action);
        }
    }

    fn step(&self, state: &mut [f64], actions: &[f32], rewards: &mut [f32], scratch: &mut Scratch) {
        let (p, prey) = (&self.params, self.prey());
        self.base.physics.step(state, self.base.space, actions, scratch);
        let world = self.base.physics.world(state);
        let reach = p.predator_size + p.prey_size;
        let contacts = (0..prey).filter(|&a| world.squared_distance(a, prey) < reach * reach).count();
        let shared = p.contact_reward * contacts as f64;
        let own = if p.prey_reward {
            -shared - world.position(prey).map(|c| bound(c.abs())).iter().sum::<f64>()
        } else {
            0.0
        };
        rewards[..prey].fill(shared as f32);
        rewards[prey] = own as f32;
    }
}

/// What the prey loses on an axis at distance `x` from the centre: nothing inside 0.9, steeply more beyond.
fn bound(x: f64) -> f64 {
    if x < 0.9 {
        0.0
    } else if x < 1.0 {
        10.0 * (x - 0.9)
    } else {
        libm::exp(2.0 * x - 2.0).min(10.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;

    fn scenario(agents: usize) -> Box<dyn Scenario> {
        build(&Spec::new("simple_tag").with("agents", agents)).unwrap()
    }

    fn row(s: &dyn Scenario, places: &[[f64; 2]]) -> Vec<f64> {
        let mut state = vec![0.0; s.shape().width()];
        places.iter().enumerate().for_each(|(body, &place)| s.shape().place(&mut state, body, place));
        state
    }

    #[test]
    fn contacts_are_summed_and_shared_once() {
        let s = scenario(3);
        let mut state = row(&*s, &[[0.1, 0.0], [-0.1, 0.0], [2.0, 2.0], [0.0, 0.0], [5.0, 5.0], [-5.0, 5.0]]);
        let mut rewards = [9.0; 4];
        // 0.025 deep on both sides: each predator leaves at 0.25 per second, 0.025 in the step, and still just touches.
        s.shape().push(&mut state, 0, [-0.2, 0.0]);
        s.shape().push(&mut state, 1, [0.2, 0.0]);
        s.step(&mut state, &[0.0; 8], &mut rewards, &mut Scratch::default());
        assert_eq!(s.team_reward(&rewards), 20.0);
        assert_eq!(rewards, [20.0, 20.0, 20.0, 0.0]);
    }

    #[test]
    fn a_free_prey_loses_by_contacts_and_by_leaving() {
        let s = build(&Spec::new("simple_tag").with("profile", "mpe2").with("agents", 2)).unwrap();
        let mut state = row(&*s, &[[0.95, -0.5], [0.95, 0.5], [0.95, 0.5], [9.0, 9.0], [-9.0, 9.0]]);
        let mut rewards = [9.0; 3];
        // old velocities (none) move first, and two bodies in one place do not push
        s.step(&mut state, &[0.0; 15], &mut rewards, &mut Scratch::default());
        assert_eq!(rewards, [10.0, 10.0, -10.5]);
        assert_eq!(s.team_reward(&rewards), 9.5);
        assert_eq!([0.5, 0.95, 1.0, 1.5, 3.0].map(bound), [0.0, 10.0 * (0.95 - 0.9), 1.0, libm::exp(1.0), 10.0]);
    }

    #[test]
    fn a_predator_sees_only_near_things_and_the_prey_sees_all() {
        let s = scenario(2);
        assert_eq!(s.agents().iter().map(|a| a.observation).collect::<Vec<_>>(), [14, 14, 12]);
        let mut state = row(&*s, &[[0.0, 0.0], [1.0, 0.0], [0.0, 0.25], [0.125, 0.0], [0.5, 0.5]]);
        s.shape().push(&mut state, 2, [0.5, -0.5]);
        let mut seen = [9.0; 40];
        s.observe(&state, &mut seen);
        let expected = [0.0, 0.0, 0.0, 0.0, 0.125, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.5, -0.5];
        assert_eq!(seen[..14], expected);
        assert_eq!(seen[14..28], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(seen[28..], [0.5, -0.5, 0.0, 0.25, 0.125, -0.25, 0.5, 0.25, 0.0, -0.25, 1.0, -0.25]);
    }

    #[test]
    fn the_prey_flees_and_stays_put_when_surrounded() {
        let s = scenario(1);
        let mut rng = Seeds::new(1).stream("prey");
        let mut actions = [7.0; 4];
        s.scripted(&row(&*s, &[[0.5, 0.0], [0.0, 0.0], [9.0, 9.0], [9.0, 9.0]]), &mut rng, &mut actions);
        assert_eq!(actions[..2], [7.0, 7.0], "the predators' actions are left alone");
        assert!(actions[2] < -0.7 && actions[3].abs() < 0.7 && actions[2].hypot(actions[3]) <= 1.0, "{actions:?}");
        let caught = row(&*s, &[[0.0, 0.0], [0.0, 0.0], [9.0, 9.0], [9.0, 9.0]]);
        s.scripted(&caught, &mut rng, &mut actions);
        assert!(actions[2].hypot(actions[3]) > 0.6, "only long ways lead out of a predator: {actions:?}");
        let ring = build(&Spec::new("simple_tag").with("agents", 1).with("predator_size", 1.0)).unwrap();
        ring.scripted(&caught, &mut rng, &mut actions);
        assert_eq!(actions[2..], [0.0, 0.0], "nowhere to go");
    }

    #[test]
    fn the_preys_push_is_not_scaled() {
        let s = scenario(1);
        let mut state = row(&*s, &[[-3.0, 0.0], [3.0, 0.0], [9.0, 9.0], [9.0, 9.0]]);
        s.step(&mut state, &[1.0, 0.0, 1.0, 0.0], &mut [0.0; 2], &mut Scratch::default());
        let world = s.shape().world(&state);
        assert!((world.velocity(0)[0] - 0.3).abs() < 1e-12 && (world.velocity(1)[0] - 0.1).abs() < 1e-12);
    }
}
