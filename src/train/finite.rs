//! Where a run's numbers stopped being numbers.

use super::Trainer;
use crate::nn::{Adam, Mlp};

/// The first tensor that holds a number that is not finite: the minibatch, which would be the cause, then networks
/// (actors before their encoders), targets, optimisers and estimators.
pub(super) fn first_not_finite(trainer: &Trainer) -> Option<String> {
    let fault = |values: &[f32]| values.iter().position(|v| !v.is_finite());
    let whole = |name: &str, values: &[f32]| fault(values).map(|_| name.to_owned());
    let batch = &trainer.batch;
    for (name, values) in [
        ("minibatch.observations", &batch.observations),
        ("minibatch.next_observations", &batch.next_observations),
        ("minibatch.actions", &batch.actions),
        ("minibatch.reward", &batch.reward),
        ("minibatch.messages", &trainer.sent),
    ] {
        if let Some(found) = whole(name, values) {
            return Some(found);
        }
    }
    let learner = &trainer.learner;
    let actors = |prefix: &str, params: &[f32]| -> Option<String> {
        let actors = &learner.actors;
        let network = |kind: &str, i: usize, network, own| {
            layer_of(&format!("{prefix}{kind}.{}", actors.names[i]), network, &params[own])
        };
        let actor = |(i, shape)| network("actor", i, shape, actors.range(i));
        let encoder = |(j, shape)| network("encoder", j, shape, actors.encoder_range(j));
        let found = actors.networks.iter().enumerate().find_map(actor);
        found.or_else(|| actors.encoders.iter().enumerate().find_map(encoder))
    };
    let params = &learner.params;
    let adam = |name: &str, adam: &Adam| fault(&adam.m).or(fault(&adam.v)).map(|_| name.to_owned());
    layer_of("critic", &learner.critic, &params.critic.read())
        .or_else(|| actors("", &params.actors.read()))
        .or_else(|| layer_of("target_critic", &learner.critic, &params.target_critic.read()))
        .or_else(|| actors("target_", &params.target_actors.read()))
        .or_else(|| adam("critic_adam", &learner.critic_adam))
        .or_else(|| adam("actor_adam", &learner.actor_adam))
        .or_else(|| {
            let dumie = trainer.dumie.as_ref()?;
            dumie.named().find_map(|(name, e)| whole(&name, &e.params.read()).or_else(|| adam(&name, &e.adam)))
        })
}

/// The layer of `mlp` that holds a number that is not finite, by its name in the actor file.
fn layer_of(name: &str, mlp: &Mlp, params: &[f32]) -> Option<String> {
    let at = params.iter().position(|v| !v.is_finite())?;
    let layer = (0..mlp.layers()).rev().find(|&l| mlp.weight(l).1 <= at).unwrap_or(0);
    let ([outputs, inputs], start) = mlp.weight(layer);
    let part = if at < start + outputs * inputs { "weight" } else { "bias" };
    Some(format!("{name}.{layer}.{part}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::Activation;

    #[test]
    fn a_parameter_is_named_by_its_layer() {
        let mlp = Mlp::new(&[2, 3, 1], Activation::Relu, Activation::Identity);
        let name = |at: usize| {
            let mut params = vec![0.0; mlp.parameters()];
            params[at] = f32::NAN;
            layer_of("critic", &mlp, &params).unwrap()
        };
        let names = [0, 5, 6, 8, 9, 11, 12].map(name);
        let [w0, b0, w1, b1] = ["critic.0.weight", "critic.0.bias", "critic.1.weight", "critic.1.bias"];
        assert_eq!(names, [w0, w0, b0, b0, w1, w1, b1]);
        assert_eq!(layer_of("critic", &mlp, &vec![0.0; mlp.parameters()]), None);
    }
}
