//! The learner: what its updates allocate, and a problem whose value is known in closed form.

use ccmarl::algo::{ActorStep, Batch, Maddpg, MaddpgConfig, Messages};
use ccmarl::nn::Activation;
use ccmarl::record::{ActionNoise, Recording, Trained, build_link};
use ccmarl::registry::Spec;
use ccmarl::rng::{self, Seeds};
use ccmarl::schema::{AgentSpec, Controller};
use ccmarl::train::config::{DumieConfig, Estimators, Negatives, PairSource};
use ccmarl::train::dumie::Dumie;
use ccmarl::train::replay::Replay;

use super::allocations::allocations;

/// A replay of this learner's play over lossy links, which `dumie` has observed too.
fn replay(learner: &Maddpg, dumie: &mut Dumie) -> Replay {
    let scenario = ccmarl::scenario::build(&Spec::new("simple_spread")).unwrap();
    let link = build_link(&Spec::new("dropout").with("p", 0.2), &*scenario).unwrap();
    let params = learner.params.actors.read();
    let policy = Trained::new(learner.actors.clone(), &params, ActionNoise::Gaussian(1.0), serde_json::Map::new());
    let recording = Recording { scenario: &*scenario, link: &*link, policy: &policy, seed: 1, episodes: 60 };
    let mut replay = Replay::new(&scenario.layout(), scenario.steps(), 10_000, learner.actors.encodes()).unwrap();
    for index in 0..60 {
        let episode = recording.episode(index);
        replay.push(&episode, &[]).unwrap();
        dumie.observe(&episode);
    }
    replay
}

#[test]
fn an_update_allocates_nothing_of_its_own_once_it_is_warm() {
    // candle's in-place operation allocates a list of its operands each time parameters are written
    let params = ccmarl::nn::Params::new(vec![0.0; 8]).unwrap();
    let per_write = allocations(|| params.update(|p| p[0] = 1.0).unwrap());
    assert!(per_write <= 1);
    let layout = ccmarl::scenario::build(&Spec::new("simple_spread")).unwrap().layout();
    let learners: Vec<&AgentSpec> = layout.agents.iter().filter(|a| a.learner).collect();
    let variants = [
        (MaddpgConfig::default(), DumieConfig::default()),
        (
            MaddpgConfig { messages: Messages::Off, actor_step: ActorStep::PerAgent, ..MaddpgConfig::default() },
            DumieConfig {
                estimators: Estimators::PerLink,
                start: 50,
                pairs: PairSource::Replay,
                ..DumieConfig::default()
            },
        ),
        (
            MaddpgConfig { messages: Messages::Encoder, ..MaddpgConfig::default() },
            DumieConfig { pairs: PairSource::Replay, ..DumieConfig::default() },
        ),
        (MaddpgConfig::default(), DumieConfig { negatives: Negatives::All, batch: 100, ..DumieConfig::default() }),
    ];
    for (config, estimators) in variants {
        let rows = if estimators.negatives == Negatives::All { 100 } else { 1024 };
        let seeds = Seeds::new(1);
        let mut learner = Maddpg::new(&learners, Activation::Tanh, config, &seeds).unwrap();
        let mut layout = layout.clone();
        layout.agents.iter_mut().zip(&learner.actors.message).for_each(|(agent, width)| agent.message = *width);
        let mut dumie = Dumie::new(&layout, estimators, [0.01, 0.01], &seeds).unwrap();
        let replay = replay(&learner, &mut dumie);
        let (mut batch, mut sent, mut bonus) = (Batch::default(), Vec::new(), Vec::new());
        let mut update = |index: u64| {
            let mut rng = seeds.indexed_stream("update", index);
            replay.sample(&mut rng, rows, &mut batch);
            replay.redraw_links(&mut rng, &mut batch);
            let mut senders = learner.senders();
            let metrics = dumie.train(&replay, senders.as_mut(), &mut rng, None).unwrap();
            let messages = senders.map_or(&batch.observations, |mut senders| {
                senders.encode(&batch.observations, rows, &mut sent);
                &sent
            });
            dumie.bonus(&batch, messages, &mut rng, &mut bonus);
            assert!(metrics.jsd.is_some() && metrics.club.is_some() && bonus.iter().any(|&b| b != 0.0));
            learner.update(&batch, &bonus).unwrap();
        };
        (0..12).for_each(&mut update);
        let found = allocations(|| (12..20).for_each(&mut update));
        // actors, critic, their targets, and the estimators
        assert_eq!(found, 8 * per_write * (4 + dumie.named().count() as u64));
    }
}

#[test]
fn the_critic_reaches_the_closed_form_value_of_a_linear_quadratic_problem() {
    // two agents, x' = 0.7 x + 0.3 a each, r = −Σ (x² + 0.2 a²), and the policy that does nothing. Then
    // V(x) = −p Σ x² with p = 1 + γ 0.49 p, and Q(x, a) = r(x, a) + γ V(x')
    let (keep, push, cost, gamma) = (0.7f32, 0.3f32, 0.2f32, 0.6f32);
    let p = 1.0 / (1.0 - gamma * keep * keep);
    let agents: Vec<AgentSpec> = ["a", "b"]
        .iter()
        .map(|name| AgentSpec {
            name: (*name).to_owned(),
            team: "team".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 1,
            message: 1,
            action: 1,
        })
        .collect();
    let config = MaddpgConfig { gamma, tau: 0.05, actor_learning_rate: 0.0, ..MaddpgConfig::default() };
    let seeds = Seeds::new(3);
    let mut learner = Maddpg::new(&agents.iter().collect::<Vec<_>>(), Activation::Tanh, config, &seeds).unwrap();
    for params in [&learner.params.actors, &learner.params.target_actors] {
        params.update(|p| p.fill(0.0)).unwrap();
    }
    let rows = 256;
    let mut rng = seeds.stream("plant");
    let mut draw = |batch: &mut Batch| {
        let uniform = |rng: &mut rng::Stream| (0..2 * rows).map(|_| rng::uniform(rng, -1.0, 1.0) as f32).collect();
        (batch.rows, batch.observations, batch.actions) = (rows, uniform(&mut rng), uniform(&mut rng));
        let pairs = || batch.observations.iter().zip(&batch.actions);
        let next = pairs().map(|(x, a)| keep * x + push * a).collect();
        let costs: Vec<f32> = pairs().map(|(x, a)| x * x + cost * a * a).collect();
        batch.reward = costs.chunks_exact(2).map(|c| -c[0] - c[1]).collect();
        batch.next_observations = next;
        (batch.link, batch.next_link) = (vec![true; 4 * rows], vec![true; 4 * rows]);
    };
    let mut batch = Batch::default();
    for (rate, updates) in [(2e-3, 3000), (4e-4, 3000), (5e-5, 1500)] {
        learner.critic_adam.config.learning_rate = rate;
        for _ in 0..updates {
            draw(&mut batch);
            learner.update(&batch, &[]).unwrap();
        }
    }
    draw(&mut batch);
    let joint: Vec<f32> = batch
        .observations
        .chunks_exact(2)
        .zip(batch.actions.chunks_exact(2))
        .flat_map(|(x, a)| [x, a].concat())
        .collect();
    let mut tape = ccmarl::nn::Tape::default();
    let found = learner.critic.forward(&learner.params.critic.read(), &joint, rows, &mut tape);
    let exact: Vec<f32> = batch
        .reward
        .iter()
        .zip(batch.next_observations.chunks_exact(2))
        .map(|(r, next)| r - gamma * p * (next[0] * next[0] + next[1] * next[1]))
        .collect();
    let size = exact.iter().map(|q| f64::from(q * q)).sum::<f64>().sqrt();
    let error = found.iter().zip(&exact).map(|(f, e)| f64::from((f - e) * (f - e))).sum::<f64>().sqrt();
    assert!(error < 0.02 * size, "relative error {}", error / size);
}
