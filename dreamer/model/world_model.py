"""World model: encoder, recurrent model, decoder, reward and continue heads, and their joint loss."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dreamer.config import DreamerConfig
from dreamer.experience.replay import Batch
from dreamer.layers import distributions as dist
from dreamer.layers import nets, sensors
from dreamer.model import rssm
from dreamer.model.rssm import Latent
from dreamer.spaces import ObsShape
from dreamer.training import parallel
from dreamer.types import Params

PARTS = ("enc", "dyn", "dec", "reward", "continue")
"""Parameters of the world model by name."""


def init(config: DreamerConfig, obs_shape: ObsShape, action_width: int, key: jax.Array) -> Params:
    """Parameters named as in `PARTS`."""
    keys = jax.random.split(key, 5)
    features = config.deter + config.stoch_size
    return {
        "enc": sensors.init_encoder(config, obs_shape, keys[0]),
        "dyn": rssm.init(config, sensors.token_size(config, obs_shape), action_width, keys[1]),
        "dec": sensors.init_decoder(config, obs_shape, keys[2]),
        "reward": init_head(config, keys[3], features, config.reward_layers, config.bins, outscale=0.0),
        "continue": init_head(config, keys[4], features, config.continue_layers, 1),
    }


def init_head(
    config: DreamerConfig, key: jax.Array, inputs: int, layers: int, outputs: int, outscale: float = 1.0
) -> Params:
    """An MLP and a linear output named out."""
    mlp_key, out_key = jax.random.split(key)
    params = nets.init_mlp(mlp_key, inputs, config.units, layers)
    return {**params, "out": nets.init_linear(out_key, config.units, outputs, outscale)}


def head(params: Params, features: jax.Array) -> jax.Array:
    """Outputs (..., K) float32 of a head from features (..., F)."""
    return nets.linear(params["out"], nets.mlp(params, features)).astype(jnp.float32)


def predict_reward(params: Params, features: jax.Array) -> jax.Array:
    """Expected reward (...) earned on the way into a state."""
    return dist.twohot_mean(head(params["reward"], features))


def predict_continue(params: Params, features: jax.Array) -> jax.Array:
    """Probability (...) that the episode goes on times the discount, which the head has learned with it."""
    return jax.nn.sigmoid(head(params["continue"], features)[..., 0])


def continue_target(config: DreamerConfig, is_terminal: jax.Array) -> jax.Array:
    """Target (...) of the continue head: the discount, or 0 where the task ended. Time-outs do not end the task."""
    return config.discount * (1.0 - is_terminal.astype(jnp.float32))


def kl_losses(config: DreamerConfig, post: jax.Array, prior: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Dynamics and representation loss (...) [nat] of probabilities (..., S, C).

    Each is summed over the latents first and then floored at the free nats, so that small terms share one allowance.
    """
    stop = jax.lax.stop_gradient
    dyn = dist.categorical_kl(stop(post), prior)
    rep = dist.categorical_kl(post, stop(prior))
    return jnp.maximum(dyn, config.free_nats), jnp.maximum(rep, config.free_nats)


def loss(
    config: DreamerConfig, params: Params, batch: Batch, key: jax.Array
) -> tuple[dict[str, jax.Array], Latent, dict[str, jax.Array]]:
    """Losses (T, B) by name, weighted; posterior states (T, B, ...); metrics.

    Args:
        config: sizes and weights.
        params: from `init`.
        batch: replayed sequences, T leading.
        key: consumed by the latents' samples.
    """
    steps = batch.reward.shape
    tokens = sensors.encode(config, params["enc"], batch.obs)
    uniform = parallel.own_rows(lambda rows: jax.random.uniform(key, (steps[0], rows, config.stoch)), steps[1:])
    sequences = rssm.Sequences(batch.prev_action, tokens, batch.is_first, uniform)
    latent, post = rssm.observe(config, params["dyn"], batch.start, sequences)
    prior = rssm.prior_probs(config, params["dyn"], latent.deter)
    dyn, rep = kl_losses(config, post, prior)
    features = latent.features()
    represent = sensors.representation_losses(config, params["dec"], latent, batch.obs, tokens)
    reward_logits = head(params["reward"], features)
    reward = dist.cross_entropy(reward_logits, dist.twohot(batch.reward, config.bins))
    continue_logit = head(params["continue"], features)[..., 0]
    continuation = dist.bernoulli_loss(continue_logit, continue_target(config, batch.is_terminal))
    losses = {
        "dyn": config.dyn_scale * dyn,
        "rep": config.rep_scale * rep,
        **represent,
        "reward": config.reward_scale * reward,
        "continue": config.continue_scale * continuation,
    }
    goal = (batch.is_terminal & (batch.reward > 0)).astype(jnp.float32)
    predicted = dist.twohot_mean(jax.lax.stop_gradient(reward_logits))
    metrics = {
        "kl": jnp.mean(dist.categorical_kl(post, prior)),
        "post_entropy": jnp.mean(jnp.sum(-post * jnp.log(post), (-2, -1))),
        "goal_reward_sum": parallel.total(jnp.sum(goal * predicted)),
        "goal_reward_true_sum": parallel.total(jnp.sum(goal * batch.reward)),
        "goal_frames": parallel.total(jnp.sum(goal)),
    }
    return losses, latent, metrics
