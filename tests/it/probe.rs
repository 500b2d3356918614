//! A task of two steps with a known optimum that needs the message: what the trainer must solve with messages, and what
//! nobody solves without. A scenario of this test alone.
//!
//! The sender sees b = ±1 (equally likely); the receiver sees only its own place x, which starts at 0 and moves by half
//! its action. Each step earns −(x − ¾ b)². Knowing b, the best is x = ½ b, then ¾ b: −1/16 in all. A receiver that does
//! not know b stands at places x₁, x₂ that do not depend on it: E −(x − ¾ b)² = −(x² + 9/16) each, −9/8 in all at best.

use ccmarl::algo::Messages;
use ccmarl::link::channel;
use ccmarl::record::{ActionNoise, Trained};
use ccmarl::registry::Spec;
use ccmarl::rng::{Stream, bernoulli};
use ccmarl::scenario::{ActionSpace, Base, Body, Decoder, Integration, Laws, Physics, Scenario, Scratch, Team};
use ccmarl::schema::{AgentSpec, Controller, Episode};
use ccmarl::train::{TrainConfig, Trainer, evaluate};
use serde_json::{Map, Value};

struct Probe(Base);

const SENDER: usize = 0;
const RECEIVER: usize = 1;

/// With the message, and at most without it.
const OPTIMUM: f64 = -1.0 / 16.0;
const SILENT: f64 = -9.0 / 8.0;

impl Probe {
    fn new() -> Self {
        let agent = |name: &str| AgentSpec {
            name: name.to_owned(),
            team: "team".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 1,
            message: 1,
            action: 2,
        };
        let body = Body { size: 0.1, accel: 1.0, max_speed: f64::INFINITY, collide: false };
        let laws = Laws {
            dt: 0.1,
            damping: 0.25,
            contact_force: 100.0,
            contact_margin: 1e-3,
            integration: Integration::VelocityFirst,
        };
        Self(Base {
            agents: vec![agent("sender"), agent("receiver")],
            space: ActionSpace { decoder: Decoder::Force2, discrete: false, words: 0 },
            physics: Physics::new(laws, &[body, body], &[], 0, false),
            steps: 2,
            team: Team::First,
        })
    }

    fn place(&self, state: &[f64], agent: usize) -> f64 {
        self.shape().world(state).position(agent)[0]
    }
}

impl Scenario for Probe {
    fn base(&self) -> &Base {
        &self.0
    }

    fn parameters(&self) -> Map<String, Value> {
        [("name".to_owned(), Value::from("probe"))].into_iter().collect()
    }

    fn reward_convention(&self) -> &'static str {
        "−(x − ¾ b)²"
    }

    fn reset(&self, state: &mut [f64], rng: &mut Stream) {
        state.fill(0.0);
        self.shape().place(state, SENDER, [if bernoulli(rng, 0.5) { 1.0 } else { -1.0 }, 0.0]);
    }

    fn observe(&self, state: &[f64], observations: &mut [f32]) {
        observations.copy_from_slice(&[SENDER, RECEIVER].map(|agent| self.place(state, agent) as f32));
    }

    fn oracle(&self, state: &[f64], actions: &mut [f32]) {
        let wish = 0.75 * self.place(state, SENDER) - self.place(state, RECEIVER);
        actions.copy_from_slice(&[0.0, 0.0, (2.0 * wish).clamp(-1.0, 1.0) as f32, 0.0]);
    }

    fn step(&self, state: &mut [f64], actions: &[f32], rewards: &mut [f32], _scratch: &mut Scratch) {
        let x = self.place(state, RECEIVER) + 0.5 * f64::from(actions[2]);
        self.shape().place(state, RECEIVER, [x, 0.0]);
        rewards.fill(-(x - 0.75 * self.place(state, SENDER)).powi(2) as f32);
    }
}

/// Trains and tests on 400 episodes over the training link: the mean return.
fn trained(algorithm: &str, messages: Messages) -> f64 {
    let mut config = TrainConfig::new(Spec::new("probe"), algorithm);
    (config.steps, config.replay, config.update_every) = (24_000, 5000, 10);
    (config.maddpg.hidden, config.maddpg.batch) = (vec![32], Some(128));
    (config.maddpg.actor_learning_rate, config.maddpg.critic_learning_rate) = (2e-3, 4e-3);
    config.noise.episodes = 6000;
    config.maddpg.messages = messages;
    if messages == Messages::Encoder {
        (config.maddpg.message_width, config.maddpg.encoder_hidden) = (Some(2), Some(vec![16]));
    }
    let config = config.resolve_for(&Probe::new()).unwrap();
    let mut trainer = Trainer::in_scenario(config, Box::new(Probe::new()), std::path::Path::new("unused")).unwrap();
    while trainer.step() < trainer.config.steps {
        trainer.advance(None).unwrap();
    }
    let learner = &trainer.learner;
    let team = Trained::new(learner.actors.clone(), &learner.params.actors.read(), ActionNoise::None, Map::new());
    let link = if algorithm == "maddpg" { "none" } else { "unrestricted" };
    let rows = evaluate(&Probe::new(), &team, &[channel(link).unwrap()], 400, 1, &mut |_| {}).unwrap();
    rows.iter().map(|r| r.episode_return).sum::<f64>() / rows.len() as f64
}

/// The share of b = 1 among these 400 episodes, which all policies of a seed meet; the oracle plays them here.
fn share() -> f64 {
    use ccmarl::record::{Recording, build_link, build_policy};
    let probe = Probe::new();
    let link = build_link(&Spec::new("perfect"), &probe).unwrap();
    let policy = build_policy(&Spec::new("scripted"), &probe).unwrap();
    let recording = Recording { scenario: &probe, link: &*link, policy: &*policy, seed: 1, episodes: 400 };
    let episodes = recording.together(&recording.layout(), 0, 400);
    let mean = episodes.iter().map(Episode::episode_return).sum::<f64>() / 400.0;
    assert!((mean - OPTIMUM).abs() < 1e-6, "the oracle earns the optimum, found {mean}");
    episodes.iter().filter(|e| e.observations[SENDER].data[0] > 0.0).count() as f64 / 400.0
}

#[test]
fn full_communication_solves_what_nobody_can_without_messages() {
    // places that do not depend on b: −Σ (x² + 9/16 − 3/2 x (2 share − 1)) is at most this, for any x
    let bound = SILENT * (1.0 - (2.0 * share() - 1.0).powi(2));
    for messages in [Messages::Observation, Messages::Encoder] {
        let (with, without) = (trained("fc-maddpg", messages), trained("maddpg", messages));
        assert!(without <= bound + 1e-6, "{without} is above what any silent team can earn, {bound}, {messages:?}");
        assert!(without > bound - 0.3, "even the silent optimum was missed: {without}, {messages:?}");
        assert!(with > OPTIMUM - 0.1, "{with} is far from the optimum {OPTIMUM}, {messages:?}");
    }
}
