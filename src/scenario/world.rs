//! Particle physics: discs with inertia, drag and soft contacts on an unbounded plane. All in `f64`.
//!
//! Facts of the original particle worlds: per step of `dt`, `v ← v (1 − damping) + F dt` (mass 1), |v| clipped to the
//! body's top speed, `p ← p + v dt`. Two colliding bodies push each other with `contact_force · pen`, where `pen` is the
//! softplus of the overlap at scale `contact_margin`. There are no walls.
//!
//! A world *is* a row of the `state` column: nothing else changes during an episode. Many worlds are many rows.

use serde::{Deserialize, Serialize};

use super::ActionSpace;
use crate::schema::AgentSpec;

/// Where everything lies in a row of state: per agent `x y vx vy` and its utterance, per landmark `x y`, then the
/// goals. Bodies are numbered agents first, then landmarks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Bodies that move.
    pub agents: usize,
    /// Width of each agent's utterance; 0 for silent agents.
    pub words: usize,
    /// Bodies that do not move.
    pub landmarks: usize,
    /// Whether each agent has a goal, the number of a landmark.
    pub goals: bool,
}

impl Shape {
    /// Elements of a row.
    pub fn width(self) -> usize {
        self.first_goal() + if self.goals { self.agents } else { 0 }
    }

    /// Names of the elements, in order, for agents of these names.
    pub fn fields(self, agents: &[AgentSpec]) -> Vec<String> {
        let mut fields = Vec::with_capacity(self.width());
        for agent in agents {
            fields.extend(["x", "y", "vx", "vy"].map(|c| format!("{}.{c}", agent.name)));
            fields.extend((0..self.words).map(|w| format!("{}.c{w}", agent.name)));
        }
        fields.extend((0..self.landmarks).flat_map(|l| ["x", "y"].map(|c| format!("landmark_{l}.{c}"))));
        if self.goals {
            fields.extend(agents.iter().map(|agent| format!("goal.{}", agent.name)));
        }
        fields
    }

    /// A row with these eyes.
    pub fn world(self, row: &[f64]) -> World<'_> {
        World { shape: self, row }
    }

    fn stride(self) -> usize {
        4 + self.words
    }

    fn first_landmark(self) -> usize {
        self.agents * self.stride()
    }

    fn first_goal(self) -> usize {
        self.first_landmark() + 2 * self.landmarks
    }

    /// Where the position of `body` lies.
    fn at(self, body: usize) -> usize {
        if body < self.agents { body * self.stride() } else { self.first_landmark() + 2 * (body - self.agents) }
    }

    /// Where the goals lie.
    pub(super) fn goals_at(self) -> std::ops::Range<usize> {
        self.first_goal()..self.width()
    }

    /// Puts `body` at a place.
    pub fn place(self, row: &mut [f64], body: usize, position: [f64; 2]) {
        row[self.at(body)..][..2].copy_from_slice(&position);
    }

    /// Gives `agent` a velocity.
    pub fn push(self, row: &mut [f64], agent: usize, velocity: [f64; 2]) {
        row[self.at(agent) + 2..][..2].copy_from_slice(&velocity);
    }

    /// Gives `agent` a goal, where agents have goals.
    pub fn set_goal(self, row: &mut [f64], agent: usize, landmark: usize) {
        row[self.first_goal() + agent] = landmark as f64;
    }
}

/// A row of state, read.
#[derive(Clone, Copy, Debug)]
pub struct World<'a> {
    shape: Shape,
    row: &'a [f64],
}

impl<'a> World<'a> {
    /// Position of a body, world units.
    pub fn position(self, body: usize) -> [f64; 2] {
        let at = self.shape.at(body);
        [self.row[at], self.row[at + 1]]
    }

    /// Velocity of an agent, world units per second.
    pub fn velocity(self, agent: usize) -> [f64; 2] {
        let at = self.shape.at(agent);
        [self.row[at + 2], self.row[at + 3]]
    }

    /// What an agent said in the last step, `[words]`.
    pub fn utterance(self, agent: usize) -> &'a [f64] {
        &self.row[self.shape.at(agent) + 4..][..self.shape.words]
    }

    /// The goal of an agent as the number of a body. A row from outside may hold anything here: the last landmark stands
    /// for all that are too large ([`super::Scenario::check_state`] refuses them).
    pub fn goal(self, agent: usize) -> usize {
        let landmark = self.row[self.shape.first_goal() + agent] as usize;
        self.shape.agents + landmark.min(self.shape.landmarks - 1)
    }

    /// From body `from` to body `to`, world units.
    pub fn offset(self, from: usize, to: usize) -> [f64; 2] {
        minus(self.position(to), self.position(from))
    }

    /// Squared distance between two bodies.
    pub fn squared_distance(self, a: usize, b: usize) -> f64 {
        square(self.offset(a, b))
    }

    /// Distance between two bodies.
    pub fn distance(self, a: usize, b: usize) -> f64 {
        self.squared_distance(a, b).sqrt()
    }
}

fn minus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn square(d: [f64; 2]) -> f64 {
    d[0] * d[0] + d[1] * d[1]
}

/// Which of velocity and position moves first within a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Integration {
    /// The new velocity moves the position (`OpenAI`, PMIC).
    #[default]
    VelocityFirst,
    /// The old velocity moves the position, then changes (`PettingZoo`, mpe2): one step of lag.
    PositionFirst,
}

/// A disc.
#[derive(Clone, Copy, Debug)]
pub struct Body {
    /// Radius, world units.
    pub size: f64,
    /// Gain from control to force.
    pub accel: f64,
    /// Top speed, world units per second; infinite for none.
    pub max_speed: f64,
    /// Whether it touches others that collide.
    pub collide: bool,
}

/// Constants of the laws; every scenario has them among its parameters.
#[derive(Clone, Copy, Debug)]
pub struct Laws {
    /// Seconds in a step.
    pub dt: f64,
    /// Share of velocity lost per step.
    pub damping: f64,
    /// Force per unit of overlap.
    pub contact_force: f64,
    /// Softness of a contact, world units.
    pub contact_margin: f64,
    /// Order of integration.
    pub integration: Integration,
}

/// What a step computes and forgets; one serves any number of worlds.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    /// Forces on the agents.
    forces: Vec<[f64; 2]>,
    /// Positions of the colliders before the step.
    places: Vec<[f64; 2]>,
}

/// The laws and the bodies of a world: agents first, which move, then landmarks, which do not.
#[derive(Clone, Debug)]
pub struct Physics {
    laws: Laws,
    shape: Shape,
    bodies: Vec<Body>,
    /// Bodies that touch each other, ascending.
    colliders: Vec<usize>,
}

/// Beyond this many margins of clearance a contact is skipped: its push, `contact_force · margin · e^-40 · dt` ≈ 4e-20
/// with the usual constants, is below half the last bit of any speed over 4e-4 and of any position over 4e-5.
const NEGLIGIBLE_MARGINS: f64 = 40.0;

impl Physics {
    /// A world under `laws`: `agents`, then `landmarks`.
    pub fn new(laws: Laws, agents: &[Body], landmarks: &[Body], words: usize, goals: bool) -> Self {
        let bodies = [agents, landmarks].concat();
        let colliders = (0..bodies.len()).filter(|&b| bodies[b].collide).collect();
        let shape = Shape { agents: agents.len(), words, landmarks: landmarks.len(), goals };
        Self { laws, shape, bodies, colliders }
    }

    /// Where everything lies in a row.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// A row of this world's state, read.
    pub fn world<'a>(&self, row: &'a [f64]) -> World<'a> {
        self.shape.world(row)
    }

    /// The control that brings a body from moving at `velocity` to moving at `wish` in one step, each component at most
    /// `bound`: for oracles.
    pub fn control_towards(&self, body: usize, velocity: [f64; 2], wish: [f64; 2], bound: f64) -> [f64; 2] {
        let gain = (self.bodies[body].accel * self.laws.dt).max(1e-9);
        let kept = 1.0 - self.laws.damping;
        [0, 1].map(|c| ((wish[c] - kept * velocity[c]) / gain).clamp(-bound, bound))
    }

    /// One step of a row under the actions of all agents, `[agents · space.width()]`.
    pub fn step(&self, row: &mut [f64], space: ActionSpace, actions: &[f32], scratch: &mut Scratch) {
        scratch.forces.clear();
        let agents = actions.chunks_exact(space.width()).zip(&self.bodies);
        scratch.forces.extend(agents.map(|(action, body)| space.decoder.control(action).map(|u| u * body.accel)));
        self.add_contacts(row, scratch);
        let agents = row.chunks_exact_mut(self.shape.stride()).zip(actions.chunks_exact(space.width()));
        for ((own, action), (force, body)) in agents.zip(scratch.forces.iter().zip(&self.bodies)) {
            let (p, v) = ([own[0], own[1]], [own[2], own[3]]);
            let new = self.new_velocity(v, *force, body.max_speed);
            let moving = if self.laws.integration == Integration::VelocityFirst { new } else { v };
            own[..4].copy_from_slice(&[
                p[0] + moving[0] * self.laws.dt,
                p[1] + moving[1] * self.laws.dt,
                new[0],
                new[1],
            ]);
            for (word, &said) in own[4..].iter_mut().zip(&action[space.decoder.width()..]) {
                *word = f64::from(said);
            }
        }
    }

    fn new_velocity(&self, v: [f64; 2], force: [f64; 2], max_speed: f64) -> [f64; 2] {
        let (kept, dt) = (1.0 - self.laws.damping, self.laws.dt);
        let v = [v[0] * kept + force[0] * dt, v[1] * kept + force[1] * dt];
        let speed = square(v).sqrt();
        if speed > max_speed { v.map(|c| c / speed * max_speed) } else { v }
    }

    fn add_contacts(&self, row: &[f64], scratch: &mut Scratch) {
        let Laws { contact_force, contact_margin, .. } = self.laws;
        let slack = NEGLIGIBLE_MARGINS * contact_margin;
        let world = self.world(row);
        let Scratch { forces, places } = scratch;
        places.clear();
        places.extend(self.colliders.iter().map(|&body| world.position(body)));
        for (k, &a) in self.colliders.iter().enumerate() {
            if a >= self.shape.agents {
                break; // landmarks do not move one another
            }
            for (&b, &other) in self.colliders[k + 1..].iter().zip(&places[k + 1..]) {
                let reach = self.bodies[a].size + self.bodies[b].size;
                let d = minus(other, places[k]);
                let squared = square(d);
                if squared >= (reach + slack) * (reach + slack) || squared == 0.0 {
                    continue; // too far to feel, or no direction to push in
                }
                let distance = squared.sqrt();
                let overlap = (reach - distance) / contact_margin;
                let push = contact_force * softplus(overlap) * contact_margin / distance;
                let f = [d[0] * push, d[1] * push];
                forces[a] = minus(forces[a], f);
                if b < self.shape.agents {
                    forces[b] = [forces[b][0] + f[0], forces[b][1] + f[1]];
                }
            }
        }
    }
}

/// ln(1 + eˣ) without overflow.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + libm::log1p(libm::exp(-x.abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Decoder;

    const LAWS: Laws = Laws {
        dt: 0.1,
        damping: 0.25,
        contact_force: 100.0,
        contact_margin: 1e-3,
        integration: Integration::VelocityFirst,
    };
    const BODY: Body = Body { size: 0.15, accel: 5.0, max_speed: f64::INFINITY, collide: true };
    const FORCE: ActionSpace = ActionSpace { decoder: Decoder::Force2, discrete: false, words: 0 };

    fn close(found: [f64; 2], expected: [f64; 2]) {
        assert!((found[0] - expected[0]).abs() < 1e-12 && (found[1] - expected[1]).abs() < 1e-12, "{found:?}");
    }

    /// One step from rest at `places` under `actions`, with the bodies' first velocity.
    fn step(physics: &Physics, places: &[[f64; 2]], velocity: [f64; 2], actions: &[f32]) -> Vec<f64> {
        let mut row = vec![0.0; physics.shape().width()];
        for (body, &place) in places.iter().enumerate() {
            physics.shape().place(&mut row, body, place);
        }
        physics.shape().push(&mut row, 0, velocity);
        physics.step(&mut row, FORCE, actions, &mut Scratch::default());
        row
    }

    #[test]
    fn free_motion_in_both_orders() {
        for (integration, x) in [(Integration::VelocityFirst, 0.125), (Integration::PositionFirst, 0.1)] {
            let physics = Physics::new(Laws { integration, ..LAWS }, &[BODY], &[], 0, false);
            let row = step(&physics, &[], [1.0, 0.0], &[1.0, -0.5]);
            close(physics.world(&row).velocity(0), [0.75 + 0.5, -0.25]); // 1 · 0.75 + 1 · 5 · 0.1
            close(physics.world(&row).position(0), [x, if x > 0.1 { -0.025 } else { 0.0 }]);
        }
    }

    #[test]
    fn the_top_speed_keeps_the_direction() {
        let physics = Physics::new(LAWS, &[Body { max_speed: 1.0, accel: 30.0, ..BODY }], &[], 0, false);
        let row = step(&physics, &[], [0.0; 2], &[1.0, 0.0]);
        close(physics.world(&row).velocity(0), [1.0, 0.0]); // 3 is clipped
        let row = step(&physics, &[], [1.0, 0.0], &[0.75, 1.0]);
        close(physics.world(&row).velocity(0), [3.0 / 18.0_f64.sqrt(), 3.0 / 18.0_f64.sqrt()]); // (0.75 + 2.25, 3)
    }

    #[test]
    fn overlapping_discs_push_apart_by_the_softplus_of_the_overlap() {
        let physics = Physics::new(LAWS, &[BODY, BODY], &[Body { collide: false, ..BODY }], 0, false);
        let row = step(&physics, &[[0.0; 2], [0.3, 0.0]], [0.0; 2], &[0.0; 4]); // just touching: pen = 1e-3 ln 2
        let speed = 100.0 * 1e-3 * core::f64::consts::LN_2 * 0.1;
        close(physics.world(&row).velocity(0), [-speed, 0.0]);
        close(physics.world(&row).velocity(1), [speed, 0.0]);
        // 0.1 deep: a hundred margins, softplus(x) = x
        let row = step(&physics, &[[0.0; 2], [0.0, 0.2]], [0.0; 2], &[0.0; 4]);
        close(physics.world(&row).velocity(1), [0.0, 1.0]);
        assert_eq!(physics.world(&row).position(2), [0.0; 2], "a landmark stays where it is");
    }

    #[test]
    fn a_landmark_pushes_an_agent_and_distance_or_coincidence_does_not() {
        let physics = Physics::new(LAWS, &[BODY], &[BODY], 0, false);
        for (x, expected) in [(0.2, 1.0), (0.35, 0.0), (0.0, 0.0)] {
            let row = step(&physics, &[[x, 0.0]], [0.0; 2], &[0.0; 2]);
            close(physics.world(&row).velocity(0), [expected, 0.0]);
        }
    }

    #[test]
    fn a_row_holds_bodies_words_landmarks_and_goals_in_this_order() {
        let physics = Physics::new(LAWS, &[BODY, BODY], &[BODY], 2, true);
        let shape = physics.shape();
        let mut row = vec![0.0; shape.width()];
        shape.place(&mut row, 1, [1.0, 2.0]);
        shape.push(&mut row, 1, [3.0, 4.0]);
        shape.place(&mut row, 2, [7.0, 8.0]);
        shape.set_goal(&mut row, 1, 0);
        assert_eq!(row[6..12], [1.0, 2.0, 3.0, 4.0, 0.0, 0.0]);
        assert_eq!(row[12..], [7.0, 8.0, 0.0, 0.0]);
        let space = ActionSpace { words: 2, ..FORCE };
        physics.step(&mut row, space, &[0.0, 0.0, 0.5, -0.5, 0.0, 0.0, 0.25, 1.0], &mut Scratch::default());
        assert_eq!(physics.world(&row).utterance(0), [0.5, -0.5]);
        assert_eq!(physics.world(&row).utterance(1), [0.25, 1.0]);
        row[14] = f64::NAN;
        row[15] = 1e300;
        assert_eq!([0, 1].map(|agent| physics.world(&row).goal(agent)), [2, 2], "no goal leads out of the world");
    }
}
