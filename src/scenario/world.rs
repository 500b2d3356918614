//! Particle physics.

/// All that changes during an episode.
#[derive(Clone, Debug, Default)]
pub struct World {
    /// Positions of the agents, then the landmarks, world units.
    pub positions: Vec<[f64; 2]>,
    /// Velocities of the agents, world units per second.
    pub velocities: Vec<[f64; 2]>,
}

impl World {
    /// Writes the state vector.
    pub fn write_state(&self, out: &mut Vec<f64>) {
        for (p, v) in self.positions.iter().zip(&self.velocities) {
            out.extend_from_slice(&[p[0], p[1], v[0], v[1]]);
        }
        for p in &self.positions[self.velocities.len()..] {
            out.extend_from_slice(p);
        }
    }
}
