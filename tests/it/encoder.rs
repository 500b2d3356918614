//! Messages that encoders make: what a run with them records, keeps, resumes, starts from, and refuses.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use ccmarl::algo::{ActorStep, Actors, Masks, Messages};
use ccmarl::nn::Tape;
use ccmarl::registry::Spec;
use ccmarl::schema::Episode;
use ccmarl::train::config::{Estimators, LostMessage, PairSource, Shaping};
use ccmarl::train::{METRIC_COLUMNS, Options, TrainConfig, Trainer, train};

use super::train::{Set, bytes, config, each_resumes_and_differs, run};

fn encoded(algorithm: &str, steps: u64) -> TrainConfig {
    let mut config = config(algorithm, steps);
    (config.maddpg.messages, config.maddpg.message_width) = (Messages::Encoder, Some(4));
    config
}

fn episodes(store: &Path) -> Vec<Episode> {
    let mut source = ccmarl::storage::open(store).unwrap();
    std::iter::from_fn(|| source.next_episode().unwrap()).collect()
}

/// Exit code, stdout and stderr of the program.
fn ccmarl(words: &[&str]) -> (Option<i32>, String, String) {
    let output = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(words).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn every_way_to_train_an_encoder_differs_and_resumes_to_the_same_bytes() {
    let options: [(&str, Set); 10] = [
        ("defaults", |_| ()),
        ("other width", |c| c.maddpg.message_width = Some(2)),
        ("linear", |c| c.maddpg.encoder_hidden = Some(vec![])),
        ("actor step per agent", |c| c.maddpg.actor_step = ActorStep::PerAgent),
        ("masks redrawn", |c| c.maddpg.masks = Masks::Redrawn),
        ("an estimator per link", |c| (c.dumie.estimators, c.dumie.start) = (Estimators::PerLink, 60)),
        ("pairs from replay", |c| c.dumie.pairs = PairSource::Replay),
        ("lost messages as zeros", |c| c.dumie.lost_message = LostMessage::Zero),
        ("shaping at rollout", |c| c.dumie.shaping = Shaping::AtRollout),
        ("nothing arrives", |c| c.prior = Some(Spec::new("none"))),
    ];
    each_resumes_and_differs(&encoded("cc-maddpg", 3000), &options);
}

#[test]
fn what_is_recorded_is_what_the_encoders_sent_and_every_command_takes_such_a_run() {
    let dir = tempfile::tempdir().unwrap();
    let [path, store, acted, page] = ["run", "store", "acted", "page"].map(|name| dir.path().join(name));
    let word = |path: &Path| path.to_str().unwrap().to_owned();
    // a rate at which an untrained encoder is told from a trained one
    let mut fast = encoded("cc-maddpg", 2000);
    fast.maddpg.actor_learning_rate = 1e-2;
    run(fast, &path, &Options { record: Some(&store), ..Options::default() });
    let policy = format!("run:{}", word(&path));
    let record = ["record", "--scenario", "simple_spread", "--policy", &policy, "--link", "dropout:0.5"];
    let (code, _, err) = ccmarl(&[&record[..], &["--episodes", "3", "--out", &word(&acted)]].concat());
    assert_eq!(code, Some(0), "{err}");
    let (actors, params) = Actors::load(&path).unwrap();
    assert_eq!((actors.message.as_slice(), actors.encoders.len()), (&[4, 4, 4][..], 3));
    let mut tape = Tape::default();
    let mut distance = |episode: &Episode| {
        let mut worst = 0.0f32;
        for (j, encoder) in actors.encoders.iter().enumerate() {
            let (observed, sent) = (&episode.observations[j], &episode.messages[j]);
            let again = encoder.forward(&params[actors.encoder_range(j)], &observed.data, 26, &mut tape);
            assert_eq!((sent.width, sent.data.len()), (4, again.len()));
            worst = again.iter().zip(&sent.data).map(|(a, b)| (a - b).abs()).fold(worst, f32::max);
        }
        worst
    };
    // the trained team sends what its encoders make of what it sees; a rollout, what they made of it at the time
    assert!(episodes(&acted).iter().all(|e| distance(e) < 1e-6));
    let rolled: Vec<f32> = episodes(&store).iter().map(&mut distance).collect();
    assert!(rolled[0] > 0.01 && rolled[79] < rolled[0], "{rolled:?}");
    for words in [
        vec!["verify", &word(&acted), "--resimulate"],
        vec!["estimate-mi", &word(&acted), "--estimator", "gcmi", "--format", "json"],
        vec!["evaluate", &word(&path), "--episodes", "2"],
        vec!["report", &word(&path), "--out", &word(&page)],
    ] {
        let (code, out, err) = ccmarl(&words);
        assert_eq!(code, Some(0), "{words:?}: {out}{err}");
    }
    assert!(page.join("index.html").exists());
    // another world is refused as for any team
    let (code, _, err) =
        ccmarl(&["record", "--scenario", "simple_tag", "--policy", &policy, "--out", &word(&dir.path().join("x"))]);
    assert!(code == Some(1) && err.contains("name was \"simple_spread\" in training"), "{err}");
}

#[test]
fn a_warm_start_gives_the_next_critic_loss_and_the_rings_of_the_live_run() {
    let dir = tempfile::tempdir().unwrap();
    for (form, algorithm, steps) in [("s", "cc-maddpg", 2000), ("s.mcap", "maddpg", 1500)] {
        let (path, store) = (dir.path().join(format!("run-{form}")), dir.path().join(form));
        let report = run(encoded(algorithm, steps), &path, &Options { record: Some(&store), ..Options::default() });
        assert!(report.updates > 0);
        let resolved = encoded(algorithm, steps).resolve().unwrap();
        let [mut live, mut warm] = [(); 2].map(|()| Trainer::new(resolved.clone(), &path).unwrap());
        live.resume().unwrap();
        // the run's networks before a fresh memory: what the store says was sent is not needed for the loss
        warm.warm_start(ccmarl::storage::open(&store).unwrap().as_mut()).unwrap();
        assert_eq!(warm.rings().is_some(), algorithm == "cc-maddpg");
        if let (Some(warm), Some(live)) = (warm.rings(), live.rings()) {
            for (warm, live) in warm.iter().zip(live) {
                assert!((warm.pushed, &warm.actions) == (live.pushed, &live.actions) && warm.messages != live.messages);
            }
        }
        let (from, to) = (&live.learner.params, &warm.learner.params);
        for (from, to) in [
            (&from.actors, &to.actors),
            (&from.critic, &to.critic),
            (&from.target_actors, &to.target_actors),
            (&from.target_critic, &to.target_critic),
        ] {
            to.update(|params| params.copy_from_slice(&from.read())).unwrap();
        }
        let mut batches = [&live, &warm].map(|trainer| {
            let mut batch = ccmarl::algo::Batch::default();
            trainer.replay.sample(&mut ccmarl::rng::Seeds::new(1).stream("b"), 64, &mut batch);
            batch
        });
        let [a, b] = &mut batches;
        assert_eq!((&a.observations, &a.link, &a.actions), (&b.observations, &b.link, &b.actions));
        // the store's messages are of encoders that had learned less
        let mut sent = Vec::new();
        warm.learner.senders().unwrap().encode(&b.observations, 64, &mut sent);
        let (actors, params) = (&live.learner.actors, live.learner.params.actors.read().to_vec());
        let mut tape = Tape::default();
        for (seen, sent) in a.observations.chunks_exact(54).zip(sent.chunks_exact(12)) {
            for j in 0..3 {
                let encoder = &actors.encoders[j];
                let exact = encoder.forward(&params[actors.encoder_range(j)], &seen[18 * j..], 1, &mut tape);
                assert!(exact.iter().zip(&sent[4 * j..]).all(|(a, b)| (a - b).abs() < 1e-6), "sender {j}");
            }
        }
        let found = live.next_critic_loss().unwrap();
        assert_eq!(Some(found.to_bits()), report.next_critic_loss.map(f64::to_bits));
        assert_eq!(live.learner.td_loss(a).to_bits(), warm.learner.td_loss(b).to_bits());
    }
}

#[test]
fn a_warm_start_sends_anew_what_a_store_of_any_messages_observed() {
    let dir = tempfile::tempdir().unwrap();
    let mut wide = encoded("cc-maddpg", 1000);
    wide.maddpg.message_width = Some(18);
    // no update before step 1024: the encoders of the rollouts are those that the run starts with
    for (name, recorded, same) in [
        ("own", encoded("cc-maddpg", 1000), true),
        ("observed", config("cc-maddpg", 1000), false),
        ("wide", wide, false),
    ] {
        let [path, store] = ["run", "store"].map(|part| dir.path().join(name).join(part));
        run(recorded, &path, &Options { record: Some(&store), ..Options::default() });
        let rings = |config: TrainConfig| {
            let mut trainer = Trainer::new(config.resolve().unwrap(), Path::new("unused")).unwrap();
            trainer.warm_start(ccmarl::storage::open(&store).unwrap().as_mut()).unwrap();
            trainer
        };
        let mut warm = rings(encoded("cc-maddpg", 1000));
        if same {
            let mut rolled = Trainer::new(encoded("cc-maddpg", 1000).resolve().unwrap(), Path::new("unused")).unwrap();
            while rolled.step() < 1000 {
                rolled.advance(None).unwrap();
            }
            assert_eq!(warm.rings(), rolled.rings());
        }
        // the newest pairs of both rings are of the last episodes; each message is some sender's of some step
        let mut senders = warm.learner.senders().unwrap();
        let made: Vec<Vec<f32>> = episodes(&store)
            .iter()
            .flat_map(|e| {
                (0..3).map(|j| senders.encode_of(j, &e.observations[j].data, 26).to_vec()).collect::<Vec<_>>()
            })
            .flat_map(|rows| rows.chunks_exact(4).map(<[f32]>::to_vec).collect::<Vec<_>>())
            .collect();
        for ring in warm.rings().unwrap() {
            let pairs: Vec<&[f32]> = ring.messages.chunks_exact(4).collect();
            assert!(ring.widths[0] == 4 && pairs.len() > 200, "{name}");
            assert!(pairs.iter().step_by(40).all(|pair| made.iter().any(|made| made == pair)), "{name}");
        }
    }
    // an unshaped run has no rings, and takes the store all the same
    let store = dir.path().join("observed/store");
    run(encoded("maddpg", 500), &dir.path().join("b"), &Options { warm_start: Some(&store), ..Options::default() });
}

#[test]
fn a_store_of_an_encoders_messages_is_refused_where_a_message_is_the_observation() {
    let dir = tempfile::tempdir().unwrap();
    let store = |name: &str, config: TrainConfig| {
        let store = dir.path().join(format!("store-{name}"));
        run(config, &dir.path().join(name), &Options { record: Some(&store), ..Options::default() });
        store
    };
    let narrow = store("narrow", encoded("maddpg", 500));
    let refused = |config: TrainConfig, store: &Path| {
        let options = Options { warm_start: Some(store), ..Options::default() };
        let out = dir.path().join("out");
        let error = train(config, &out, &options, &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
        assert!(!out.exists());
        error.to_string()
    };
    let agent = |message| format!("agent_0 (observation 18, message {message}, action 2)");
    let expected = format!("cannot train on this: agent 0 is {} here and {} in the store", agent(18), agent(4));
    assert_eq!(refused(config("maddpg", 500), &narrow), expected);
    // messages as wide as observations, but an encoder's
    let mut alike = encoded("maddpg", 500);
    alike.maddpg.message_width = Some(18);
    let error = refused(config("maddpg", 500), &store("alike", alike));
    assert!(error.contains("episode 0: message.agent_0 is not observation.agent_0"), "{error}");
}

#[test]
fn an_encoders_gradient_is_logged_and_a_tensor_that_diverged_is_named() {
    let column = METRIC_COLUMNS.iter().position(|(name, _)| *name == "encoder_grad_norm").unwrap();
    let norms = |config: TrainConfig| {
        let mut trainer = Trainer::new(config.resolve().unwrap(), Path::new("unused")).unwrap();
        while trainer.step() < trainer.config.steps {
            trainer.advance(None).unwrap();
        }
        trainer.metrics().iter().map(|row| row.values[column]).collect::<Vec<_>>()
    };
    assert!(norms(encoded("fc-maddpg", 3000)).iter().all(|norm| norm.unwrap() > 0.0));
    assert!(norms(encoded("maddpg", 3000)).iter().all(|norm| *norm == Some(0.0)));
    assert!(norms(config("fc-maddpg", 3000)).iter().all(Option::is_none));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a");
    run(encoded("fc-maddpg", 1500), &path, &Options::default());
    let mut trainer = Trainer::new(encoded("fc-maddpg", 1500).resolve().unwrap(), &path).unwrap();
    trainer.resume().unwrap();
    for (online, name) in [(false, "target_encoder.agent_1.0.weight"), (true, "encoder.agent_1.0.weight")] {
        let at = trainer.learner.actors.encoder_range(1).start;
        let params = &trainer.learner.params;
        let params = if online { &params.actors } else { &params.target_actors };
        params.update(|p| p[at] = f32::NAN).unwrap();
        let before = bytes(&path, "checkpoint/state.safetensors");
        let error = trainer.save().unwrap_err().to_string();
        assert!(error.contains(&format!(": {name} is no longer finite; ")), "{error}");
        assert!(bytes(&path, "checkpoint/state.safetensors") == before, "the last good checkpoint is kept");
    }
}

#[test]
fn what_cannot_be_is_refused_and_what_is_left_out_is_filled_in() {
    let refused = |set: fn(&mut TrainConfig)| {
        let mut config = encoded("cc-maddpg", 500);
        set(&mut config);
        config.resolve().unwrap_err().to_string()
    };
    let width = "maddpg.message_width: it shapes encoders: set messages = \"encoder\", or leave it out";
    assert_eq!(refused(|c| c.maddpg.messages = Messages::Observation), width);
    assert_eq!(refused(|c| c.maddpg.messages = Messages::Off), width);
    let hidden = refused(|c| {
        (c.maddpg.messages, c.maddpg.message_width) = (Messages::Observation, None);
        c.maddpg.encoder_hidden = Some(vec![64]);
    });
    assert_eq!(hidden, width.replace("message_width", "encoder_hidden"));
    let range = refused(|c| c.maddpg.message_width = Some(0));
    assert_eq!(range, "maddpg.message_width: expected 1 to 4096, found 0");
    let layers = refused(|c| c.maddpg.encoder_hidden = Some(vec![8, 0]));
    assert_eq!(layers, "maddpg.encoder_hidden: expected at most 16 layers of 1 to 4096 units, found [8, 0]");
    let many = refused(|c| c.maddpg.encoder_hidden = Some(vec![4096; 16]));
    let found = "found 755467859: make layers narrower";
    assert_eq!(many, format!("maddpg.hidden: expected at most 268435456 parameters in all networks, {found}"));
    let alone = refused(|c| c.scenario = Spec::new("simple_spread").with("agents", 1));
    assert_eq!(alone, "maddpg.messages: an encoder learns through who hears it, found 1 learner: set \"observation\"");
    let mut plain = config("cc-maddpg", 500);
    plain.maddpg.messages = Messages::Encoder;
    let resolved = plain.resolve().unwrap();
    assert_eq!((resolved.maddpg.message_width, resolved.maddpg.encoder_hidden.clone()), (Some(8), Some(vec![64])));
    let again: TrainConfig = toml::from_str(&resolved.to_toml().unwrap()).unwrap();
    assert_eq!(again.clone().resolve().unwrap(), resolved);
    let text = config("cc-maddpg", 500).resolve().unwrap().to_toml().unwrap();
    assert!(!text.contains("message_width") && !text.contains("encoder"), "{text}");
}
