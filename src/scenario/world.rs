//! Particle physics: discs with inertia, drag and soft contacts on an unbounded plane. All in `f64`.
//!
//! Facts of the original particle worlds: per step of `dt`, `v ← v (1 − damping) + F dt` (mass 1), |v| clipped to the
//! body's top speed, `p ← p + v dt`. Two colliding bodies push each other with `contact_force · pen`, where `pen` is the
//! softplus of the overlap at scale `contact_margin`. There are no walls.

use serde::{Deserialize, Serialize};

use super::Decoder;

/// All that changes during an episode.
#[derive(Clone, Debug, Default)]
pub struct World {
    /// Positions of the agents, then the landmarks, world units.
    pub positions: Vec<[f64; 2]>,
    /// Velocities of the agents, world units per second.
    pub velocities: Vec<[f64; 2]>,
    /// Forces on the agents in the step being computed: scratch, no state.
    forces: Vec<[f64; 2]>,
}

impl World {
    /// A world of so many bodies, all at rest in the origin.
    pub fn at_rest(agents: usize, landmarks: usize) -> Self {
        let zeros = |n| vec![[0.0; 2]; n];
        Self { positions: zeros(agents + landmarks), velocities: zeros(agents), forces: zeros(agents) }
    }

    /// Writes the state vector: `x y vx vy` per agent, then `x y` per landmark.
    pub fn write_state(&self, out: &mut Vec<f64>) {
        for (p, v) in self.positions.iter().zip(&self.velocities) {
            out.extend_from_slice(&[p[0], p[1], v[0], v[1]]);
        }
        for p in &self.positions[self.velocities.len()..] {
            out.extend_from_slice(p);
        }
    }

    /// From body `from` to body `to`, world units.
    pub fn offset(&self, from: usize, to: usize) -> [f64; 2] {
        let (a, b) = (self.positions[from], self.positions[to]);
        [b[0] - a[0], b[1] - a[1]]
    }

    /// Squared distance between two bodies.
    pub fn squared_distance(&self, a: usize, b: usize) -> f64 {
        let d = self.offset(a, b);
        d[0] * d[0] + d[1] * d[1]
    }
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

/// The laws and the bodies of a world: agents first, which move, then landmarks, which do not.
#[derive(Clone, Debug)]
pub struct Physics {
    dt: f64,
    damping: f64,
    contact_force: f64,
    contact_margin: f64,
    integration: Integration,
    bodies: Vec<Body>,
    agents: usize,
    colliders: Vec<usize>,
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

/// Beyond this many margins of clearance a contact is skipped: its push, `contact_force · margin · e^-40 · dt` ≈ 4e-20
/// with the usual constants, is below half the last bit of any speed over 4e-4 and of any position over 4e-5.
const NEGLIGIBLE_MARGINS: f64 = 40.0;

impl Physics {
    /// A world under `laws`: `agents`, then `landmarks`.
    pub fn new(laws: Laws, agents: &[Body], landmarks: &[Body]) -> Self {
        let bodies = [agents, landmarks].concat();
        let Laws { dt, damping, contact_force, contact_margin, integration } = laws;
        let colliders = (0..bodies.len()).filter(|&b| bodies[b].collide).collect();
        Self { dt, damping, contact_force, contact_margin, integration, agents: agents.len(), bodies, colliders }
    }

    /// A world of these bodies, not yet placed.
    pub fn world(&self) -> World {
        World::at_rest(self.agents, self.bodies.len() - self.agents)
    }

    /// One step under the actions of all agents, `[agents · decoder.width()]`.
    pub fn step(&self, world: &mut World, decoder: Decoder, actions: &[f32]) {
        let agents = world.forces.iter_mut().zip(&self.bodies).zip(actions.chunks_exact(decoder.width()));
        for ((force, body), action) in agents {
            *force = decoder.control(action).map(|u| u * body.accel);
        }
        self.add_contacts(world);
        for agent in 0..self.agents {
            let (f, p, v) = (world.forces[agent], &mut world.positions[agent], &mut world.velocities[agent]);
            let new = self.new_velocity(*v, f, self.bodies[agent].max_speed);
            let moving = if self.integration == Integration::VelocityFirst { new } else { *v };
            *p = [p[0] + moving[0] * self.dt, p[1] + moving[1] * self.dt];
            *v = new;
        }
    }

    fn new_velocity(&self, v: [f64; 2], force: [f64; 2], max_speed: f64) -> [f64; 2] {
        let kept = 1.0 - self.damping;
        let v = [v[0] * kept + force[0] * self.dt, v[1] * kept + force[1] * self.dt];
        let speed = (v[0] * v[0] + v[1] * v[1]).sqrt();
        if speed > max_speed { v.map(|c| c / speed * max_speed) } else { v }
    }

    fn add_contacts(&self, world: &mut World) {
        let slack = NEGLIGIBLE_MARGINS * self.contact_margin;
        for (k, &a) in self.colliders.iter().enumerate() {
            if a >= self.agents {
                break; // landmarks do not move one another
            }
            for &b in &self.colliders[k + 1..] {
                let reach = self.bodies[a].size + self.bodies[b].size;
                let squared = world.squared_distance(a, b);
                if squared >= (reach + slack) * (reach + slack) || squared == 0.0 {
                    continue; // too far to feel, or no direction to push in
                }
                let distance = squared.sqrt();
                let overlap = (reach - distance) / self.contact_margin;
                let push = self.contact_force * softplus(overlap) * self.contact_margin / distance;
                let d = world.offset(a, b);
                let f = [d[0] * push, d[1] * push];
                world.forces[a] = [world.forces[a][0] - f[0], world.forces[a][1] - f[1]];
                if b < self.agents {
                    world.forces[b] = [world.forces[b][0] + f[0], world.forces[b][1] + f[1]];
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

    const LAWS: Laws = Laws {
        dt: 0.1,
        damping: 0.25,
        contact_force: 100.0,
        contact_margin: 1e-3,
        integration: Integration::VelocityFirst,
    };
    const BODY: Body = Body { size: 0.15, accel: 5.0, max_speed: f64::INFINITY, collide: true };

    fn close(found: [f64; 2], expected: [f64; 2]) {
        assert!((found[0] - expected[0]).abs() < 1e-12 && (found[1] - expected[1]).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn free_motion_in_both_orders() {
        for (integration, x) in [(Integration::VelocityFirst, 0.125), (Integration::PositionFirst, 0.1)] {
            let physics = Physics::new(Laws { integration, ..LAWS }, &[BODY], &[]);
            let mut world = physics.world();
            world.velocities[0] = [1.0, 0.0];
            physics.step(&mut world, Decoder::Force2, &[1.0, -0.5]);
            close(world.velocities[0], [0.75 + 0.5, -0.25]); // 1 · 0.75 + 1 · 5 · 0.1
            close(world.positions[0], [x, if x > 0.1 { -0.025 } else { 0.0 }]);
        }
    }

    #[test]
    fn the_top_speed_keeps_the_direction() {
        let physics = Physics::new(LAWS, &[Body { max_speed: 1.0, accel: 30.0, ..BODY }], &[]);
        let mut world = physics.world();
        physics.step(&mut world, Decoder::Force2, &[1.0, 0.0]);
        close(world.velocities[0], [1.0, 0.0]); // 3 is clipped
        physics.step(&mut world, Decoder::Force2, &[0.75, 1.0]);
        close(world.velocities[0], [3.0 / 18.0_f64.sqrt(), 3.0 / 18.0_f64.sqrt()]); // (0.75 + 2.25, 3)
    }

    #[test]
    fn overlapping_discs_push_apart_by_the_softplus_of_the_overlap() {
        let physics = Physics::new(LAWS, &[BODY, BODY], &[Body { collide: false, ..BODY }]);
        let mut world = physics.world();
        world.positions[1] = [0.3, 0.0]; // just touching: pen = 1e-3 ln 2
        physics.step(&mut world, Decoder::Force2, &[0.0; 4]);
        let speed = 100.0 * 1e-3 * core::f64::consts::LN_2 * 0.1;
        close(world.velocities[0], [-speed, 0.0]);
        close(world.velocities[1], [speed, 0.0]);
        world = physics.world();
        world.positions[1] = [0.0, 0.2]; // 0.1 deep: a hundred margins, softplus(x) = x
        physics.step(&mut world, Decoder::Force2, &[0.0; 4]);
        close(world.velocities[1], [0.0, 1.0]);
        assert_eq!(world.positions[2], [0.0; 2], "a landmark stays where it is");
    }

    #[test]
    fn a_landmark_pushes_an_agent_and_distance_or_coincidence_does_not() {
        let physics = Physics::new(LAWS, &[BODY], &[BODY]);
        for (x, expected) in [(0.2, 1.0), (0.35, 0.0), (0.0, 0.0)] {
            let mut world = physics.world();
            world.positions[0] = [x, 0.0];
            physics.step(&mut world, Decoder::Force2, &[0.0; 2]);
            close(world.velocities[0], [expected, 0.0]);
        }
    }
}
