//! # What it is
//! Two agents, three coloured landmarks; each must reach a landmark that only the other knows.
//!
//! # Definition
//! Everything starts uniform in [-1, 1]², at rest; each agent's goal is one of the three landmarks, uniform, and the two
//! may be the same. After each step every agent earns 10 if both agents overlap their goals (`cover_radius`), 5 if one
//! does, else 0, and the team reward is the sum, 20, 10 or 0. With `reward = "distance"` (profile `mpe2`) agent i earns
//! minus the distance of the OTHER agent from that agent's goal, mixed half and half (`local_ratio`) with the mean over
//! both; the team reward is the sum.
//!
//! # Shapes and units
//! Observation `11 + words` (13; 21 with mpe2's ten words), world units: own velocity, landmarks relative, colour of the
//! other's goal (0.75 in its own component, 0.25 in the others), what the other said in the last step. Action: the
//! decoder's, then the utterance `words`. State: `x y vx vy` and `c0…` per agent, `x y` per landmark, and
//! `goal.<agent>`, the landmark that this agent must reach.
//!
//! # Parameters
//! See [`Params`]; `agents` is 2. `silent` takes the utterance out of the actions and leaves zeros in the observations.
//!
//! # When it fails
//! An utterance reaches the other without passing the link: for a task in which messages are the only way, set `silent`.
//! Reward is sparse: a random policy earns about 1 per episode.
//!
//! # Reference
//! Lowe et al. 2017 (MPE `simple_reference`); PMIC's file for bodies that collide, two words and the 20/10/0 reward.
//! Profile `mpe2`: `simple_reference_v3` of mpe2 1.1.1, to whose trajectories it is held.
//!
//! # Differences from the reference implementation
//! mpe2 stores with each agent the goal of the other; here `goal.<agent>` is the agent's own. Two bodies in exactly the
//! same place do not push.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::params::{AgentBodies, Common, Profile, read};
use super::{Base, Body, Build, Physics, Scenario, Scratch, Team};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Stream, below};

/// The scenario's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "simple_reference",
    summary: "two agents each reach a landmark that only the other knows",
    reference: "Lowe et al. 2017 (MPE); reward scale of PMIC",
    value: None,
    build,
};

/// Both know the other's goal.
const AGENTS: usize = 2;

/// One per colour component.
const LANDMARKS: usize = 3;

/// What an agent earns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Reward {
    /// `both_reward` while both are at their goals, `one_reward` while one is.
    Overlap,
    /// Minus the distance of the other from its goal, mixed with the mean.
    Distance,
}

/// Every constant of the task. Lengths in world units, speeds per second.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Params {
    /// Profile, N (2), laws of motion.
    #[serde(flatten)]
    common: Common,
    /// Gain, top speed and radius of the agents, and whether they and the landmarks push each other.
    #[serde(flatten)]
    bodies: AgentBodies,
    /// Radius of a landmark: [0, 1].
    landmark_size: f64,
    /// Width of an utterance: 0 to 100.
    words: usize,
    /// Whether nobody speaks.
    silent: bool,
    /// What an agent earns.
    reward: Reward,
    /// Distance at which an agent is at its goal: [0, 10].
    cover_radius: f64,
    /// Earned by each agent while both are at their goals: [-1000, 1000].
    both_reward: f64,
    /// Earned by each agent while one is: [-1000, 1000].
    one_reward: f64,
    /// Weight of the agent's own part against the mean, for `reward = "distance"`: [0, 1].
    local_ratio: f64,
}

impl Params {
    fn of(profile: Profile) -> Self {
        let paper = profile == Profile::Paper;
        Self {
            common: Common::of(profile, AGENTS),
            bodies: AgentBodies::of(0.05, paper),
            landmark_size: 0.05,
            words: if paper { 2 } else { 10 },
            silent: false,
            reward: if paper { Reward::Overlap } else { Reward::Distance },
            cover_radius: 0.1,
            both_reward: 10.0,
            one_reward: 5.0,
            local_ratio: 0.5,
        }
    }

    fn check(&self, spec: &Spec) -> Result<(), RegistryError> {
        self.common.check(spec, AGENTS, AGENTS)?;
        self.bodies.check(spec)?;
        spec.in_range("landmark_size", self.landmark_size, 0.0, 1.0)?;
        spec.in_range("words", self.words as f64, 0.0, 100.0)?;
        spec.in_range("cover_radius", self.cover_radius, 0.0, 10.0)?;
        spec.in_range("both_reward", self.both_reward, -1000.0, 1000.0)?;
        spec.in_range("one_reward", self.one_reward, -1000.0, 1000.0)?;
        spec.in_range("local_ratio", self.local_ratio, 0.0, 1.0)
    }
}

struct SimpleReference {
    params: Params,
    base: Base,
}

fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    let p: Params = read(spec, Params::of)?;
    p.check(spec)?;
    let words = if p.silent { 0 } else { p.words };
    let space = p.common.space(words);
    let agent = p.bodies.body();
    let landmark = Body { size: p.landmark_size, ..agent };
    let observation = 2 + 2 * LANDMARKS + 3 + p.words;
    let named = |i| super::learner(format!("agent_{i}"), "agents", observation, space.width());
    let base = Base {
        agents: (0..AGENTS).map(named).collect(),
        space,
        physics: Physics::new(p.common.laws(), &[agent; AGENTS], &[landmark; LANDMARKS], words, true),
        steps: p.common.steps,
        team: Team::Sum,
    };
    Ok(Box::new(SimpleReference { params: p, base }))
}

impl Scenario for SimpleReference {
    fn base(&self) -> &Base {
        &self.base
    }

    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn reward_convention(&self) -> &'static str {
        match self.params.reward {
            Reward::Overlap => {
                "both_reward (10 unless set) per agent and step with both at their goals, one_reward (5) with one, summed"
            }
            Reward::Distance => "sum over agents of the mix (local_ratio) of −distance of the other and the mean",
        }
    }

    fn link_unit(&self) -> f64 {
        1.0
    }

    fn reset(&self, state: &mut [f64], rng: &mut Stream) {
        state.fill(0.0);
        for agent in 0..AGENTS {
            self.shape().set_goal(state, agent, below(rng, LANDMARKS));
        }
        super::scatter(self.shape(), state, 0..AGENTS + LANDMARKS, self.params.common.arena, rng);
    }

    fn observe(&self, state: &[f64], observations: &mut [f32]) {
        let world = self.base.physics.world(state);
        for (i, mut out) in super::writers(&self.base.agents, observations) {
            let other = AGENTS - 1 - i;
            out.pair(world.velocity(i));
            for landmark in AGENTS..AGENTS + LANDMARKS {
                out.pair(world.offset(i, landmark));
            }
            let mut colour = [0.25; LANDMARKS];
            colour[world.goal(other) - AGENTS] = 0.75;
            out.numbers(&colour);
            out.numbers(world.utterance(other));
            out.rest.fill(0.0);
        }
    }

    /// Each agent heads for its own goal.
    fn oracle(&self, state: &[f64], actions: &mut [f32]) {
        self.base.head_for(state, actions, |agent| self.base.physics.world(state).goal(agent));
    }

    fn step(&self, state: &mut [f64], actions: &[f32], rewards: &mut [f32], scratch: &mut Scratch) {
        let p = &self.params;
        self.base.physics.step(state, self.base.space, actions, scratch);
        let world = self.base.physics.world(state);
        let away = [0, 1].map(|agent| world.distance(agent, world.goal(agent)));
        let earned = match p.reward {
            Reward::Overlap => {
                let there = away.iter().filter(|&&d| d < p.cover_radius).count();
                [[0.0, p.one_reward, p.both_reward][there]; AGENTS]
            }
            Reward::Distance => {
                let mean = -0.5 * (away[0] + away[1]);
                [0, 1].map(|agent| (1.0 - p.local_ratio) * mean - p.local_ratio * away[AGENTS - 1 - agent])
            }
        };
        rewards.copy_from_slice(&earned.map(|r| r as f32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(s: &dyn Scenario, agents: [[f64; 2]; 2], goals: [usize; 2]) -> Vec<f64> {
        let (shape, mut state) = (s.shape(), vec![0.0; s.shape().width()]);
        for (body, place) in agents.into_iter().chain([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]]).enumerate() {
            shape.place(&mut state, body, place);
        }
        for (agent, goal) in goals.into_iter().enumerate() {
            shape.set_goal(&mut state, agent, goal);
        }
        state
    }

    #[test]
    fn both_one_or_none_at_their_goals_earn_20_10_or_0() {
        let s = build(&Spec::new("simple_reference").with("collide", false)).unwrap();
        for (places, expected) in [
            ([[1.0, 0.05], [0.0, 1.95]], 20.0),
            ([[1.0, 0.05], [0.0, 1.85]], 10.0),
            ([[0.0, 1.95], [1.0, 0.0]], 0.0), // each at the other's
        ] {
            let mut state = row(&*s, places, [1, 2]);
            let mut rewards = [9.0; 2];
            s.step(&mut state, &[0.0; 8], &mut rewards, &mut Scratch::default());
            assert_eq!(s.team_reward(&rewards), expected);
            assert_eq!(rewards, [expected / 2.0; 2]);
        }
    }

    #[test]
    fn an_agent_sees_the_others_goal_and_hears_its_word() {
        let s = build(&Spec::new("simple_reference")).unwrap();
        let mut state = row(&*s, [[0.5, 0.5], [-1.0, 0.0]], [0, 2]);
        let mut seen = [9.0; 26];
        s.step(&mut state, &[0.0, 0.0, 0.25, -0.5, 0.0, 0.0, 1.0, -1.0], &mut [0.0; 2], &mut Scratch::default());
        s.observe(&state, &mut seen);
        assert_eq!(seen[2..13], [-0.5, -0.5, 0.5, -0.5, -0.5, 1.5, 0.25, 0.25, 0.75, 1.0, -1.0]);
        assert_eq!(seen[21..], [0.75, 0.25, 0.25, 0.25, -0.5]);
        let silent = build(&Spec::new("simple_reference").with("silent", true)).unwrap();
        assert_eq!((silent.agents()[0].action, silent.agents()[0].observation, silent.shape().words), (2, 13, 0));
    }
}
