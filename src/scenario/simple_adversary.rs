//! # What it is
//! One adversary looks for a goal that only the good agents know; everyone learns and communicates.
//!
//! # Definition
//! Agents and landmarks start uniform in [-1, 1]², at rest; one landmark is the goal. After each step the adversary earns
//! `−|p_adversary − goal|²` and every good agent `|p_adversary − goal| − min_good |p_good − goal|`. The team reward is
//! the ADVERSARY's: what the code behind the paper trains everyone on and reports. Profile `mpe2`: the adversary earns the
//! plain distance, and the team reward is the sum over all agents.
//!
//! # Shapes and units
//! With N agents and N − 1 landmarks: the adversary (agent 0) observes landmarks and others, relative, `4 (N − 1)` (8 at
//! N = 3); a good agent the goal first, `2 + 4 (N − 1)` (10). World units. Action 2 (`force2`) or 5 (`mpe5`, `mpe2`).
//! State: `x y vx vy` per agent, `x y` per landmark, `goal.<agent>`, the same for all.
//!
//! # Parameters
//! See [`Params`]; `agents` is N, the adversary included.
//!
//! # When it fails
//! Under the paper's team reward the good agents learn to help the adversary: it is a cooperative task there, solved by
//! telling the adversary where the goal is.
//!
//! # Reference
//! Lowe et al. 2017 (MPE `simple_adversary`); arXiv 2512.03528 for the team reward. Profile `mpe2`:
//! `simple_adversary_v3` of mpe2 1.1.1, to whose trajectories it is held.
//!
//! # Differences from the reference implementation
//! mpe2's `N` counts the good agents only, ours all. Its neighbour filters are not here.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::params::{AgentBodies, Common, MAX_AGENTS, Profile, read};
use super::{Base, Body, Build, Physics, Scenario, Scratch, Team};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Stream, below};

/// The scenario's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "simple_adversary",
    summary: "one adversary looks for a goal that only the others know",
    reference: "Lowe et al. 2017 (MPE); team reward of PMIC",
    value: Some("agents"),
    build,
};

/// What the adversary loses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Loss {
    /// The squared distance from the goal.
    Squared,
    /// The distance.
    Distance,
}

/// What the team earns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum TeamReward {
    /// What the adversary earns.
    Adversary,
    /// The sum over all agents.
    Sum,
}

/// Every constant of the task. Lengths in world units, speeds per second.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Params {
    /// Profile, N (2 to 1000), laws of motion.
    #[serde(flatten)]
    common: Common,
    /// Gain, top speed and radius of the agents, and whether they push each other.
    #[serde(flatten)]
    bodies: AgentBodies,
    /// Radius of a landmark: [0, 1].
    landmark_size: f64,
    /// What the adversary loses.
    adversary_loss: Loss,
    /// What the team earns.
    team_reward: TeamReward,
}

impl Params {
    fn of(profile: Profile) -> Self {
        let paper = profile == Profile::Paper;
        Self {
            common: Common::of(profile, 3),
            bodies: AgentBodies::of(0.15, false),
            landmark_size: 0.08,
            adversary_loss: if paper { Loss::Squared } else { Loss::Distance },
            team_reward: if paper { TeamReward::Adversary } else { TeamReward::Sum },
        }
    }

    fn check(&self, spec: &Spec) -> Result<(), RegistryError> {
        self.common.check(spec, 2, MAX_AGENTS)?;
        self.bodies.check(spec)?;
        spec.in_range("landmark_size", self.landmark_size, 0.0, 1.0)
    }
}

struct SimpleAdversary {
    params: Params,
    base: Base,
}

fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    let p: Params = read(spec, Params::of)?;
    p.check(spec)?;
    let (n, space) = (p.common.agents, p.common.space(0));
    let agent = p.bodies.body();
    let landmark = Body { size: p.landmark_size, collide: false, ..agent };
    let adversary = super::learner("adversary_0".to_owned(), "adversaries", 4 * (n - 1), space.width());
    let good = |i| super::learner(format!("agent_{i}"), "good", 2 + 4 * (n - 1), space.width());
    let base = Base {
        agents: std::iter::once(adversary).chain((0..n - 1).map(good)).collect(),
        space,
        physics: Physics::new(p.common.laws(), &vec![agent; n], &vec![landmark; n - 1], 0, true),
        steps: p.common.steps,
        team: if p.team_reward == TeamReward::Sum { Team::Sum } else { Team::First },
    };
    Ok(Box::new(SimpleAdversary { params: p, base }))
}

impl Scenario for SimpleAdversary {
    fn base(&self) -> &Base {
        &self.base
    }

    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn reward_convention(&self) -> &'static str {
        match (self.params.team_reward, self.params.adversary_loss) {
            (TeamReward::Adversary, Loss::Squared) => "the adversary's −|adversary − goal|², which all agents maximise",
            (TeamReward::Adversary, Loss::Distance) => "the adversary's −|adversary − goal|, which all agents maximise",
            (TeamReward::Sum, _) => "sum over agents: the adversary's −distance and what each good agent gains by it",
        }
    }

    fn reset(&self, state: &mut [f64], rng: &mut Stream) {
        let n = self.params.common.agents;
        state.fill(0.0);
        let goal = below(rng, n - 1);
        (0..n).for_each(|agent| self.shape().set_goal(state, agent, goal));
        super::scatter(self.shape(), state, 0..2 * n - 1, self.params.common.arena, rng);
    }

    fn observe(&self, state: &[f64], observations: &mut [f32]) {
        let (world, n) = (self.base.physics.world(state), self.params.common.agents);
        for (i, mut out) in super::writers(&self.base.agents, observations) {
            let goal = (i > 0).then(|| world.goal(i));
            for other in goal.into_iter().chain(n..2 * n - 1).chain((0..n).filter(|&a| a != i)) {
                out.pair(world.offset(i, other));
            }
        }
    }

    /// Everyone heads for the goal, the adversary too.
    fn oracle(&self, state: &[f64], actions: &mut [f32]) {
        self.base.head_for(state, actions, |agent| self.base.physics.world(state).goal(agent));
    }

    fn step(&self, state: &mut [f64], actions: &[f32], rewards: &mut [f32], scratch: &mut Scratch) {
        let n = self.params.common.agents;
        self.base.physics.step(state, self.base.space, actions, scratch);
        let world = self.base.physics.world(state);
        let squared = world.squared_distance(0, world.goal(0));
        let nearest = (1..n).map(|a| world.squared_distance(a, world.goal(a))).fold(f64::INFINITY, f64::min).sqrt();
        let adversary = match self.params.adversary_loss {
            Loss::Squared => -squared,
            Loss::Distance => -squared.sqrt(),
        };
        let good = squared.sqrt() - nearest;
        rewards.fill(good as f32);
        rewards[0] = adversary as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(s: &dyn Scenario) -> Vec<f64> {
        let mut state = vec![0.0; s.shape().width()];
        let places = [[0.0, 0.0], [1.0, 1.0], [3.0, 5.0], [3.0, 4.0], [9.0, 9.0]];
        places.into_iter().enumerate().for_each(|(body, place)| s.shape().place(&mut state, body, place));
        state // the goal is landmark 0 at (3, 4)
    }

    #[test]
    fn the_adversary_loses_by_the_square_and_the_good_gain_by_its_distance() {
        for (profile, adversary, team) in [("paper", -25.0, -25.0), ("mpe2", -5.0, 3.0)] {
            let s = build(&Spec::new("simple_adversary").with("profile", profile)).unwrap();
            let (mut state, mut rewards) = (row(&*s), [9.0; 3]);
            let actions = vec![0.0; 3 * s.space().width()];
            s.step(&mut state, &actions, &mut rewards, &mut Scratch::default());
            assert_eq!((rewards, s.team_reward(&rewards)), ([adversary, 4.0, 4.0], team), "{profile}");
        }
    }

    #[test]
    fn only_the_good_see_the_goal() {
        let s = build(&Spec::new("simple_adversary")).unwrap();
        let mut seen = [7.0; 28];
        s.observe(&row(&*s), &mut seen);
        assert_eq!(seen[..8], [3.0, 4.0, 9.0, 9.0, 1.0, 1.0, 3.0, 5.0]);
        assert_eq!(seen[8..18], [2.0, 3.0, 2.0, 3.0, 8.0, 8.0, -1.0, -1.0, 2.0, 4.0]);
    }
}
