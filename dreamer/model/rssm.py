"""Recurrent state-space model: a block GRU with categorical latents, observed along sequences or imagined.

Inside the learner the time axis leads, so that scans slice contiguous memory and nothing is transposed.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from dreamer.config import DreamerConfig
from dreamer.layers import distributions as dist
from dreamer.layers import nets
from dreamer.layers.recurrence import keep, scan_products
from dreamer.types import Params


@struct.dataclass
class Latent:
    """State of the model, any leading axes."""

    deter: jax.Array
    """(..., D) in the compute type."""
    stoch: jax.Array
    """(..., S * C) one-hot in the compute type."""

    def features(self) -> jax.Array:
        """(..., D + S * C), input of the heads."""
        return jnp.concatenate([self.deter, self.stoch], -1)


def init(config: DreamerConfig, tokens: int, action_dim: int, key: jax.Array) -> Params:
    """Parameters of the model.

    Args:
        config: sizes.
        tokens: width E of the encoder's output.
        action_dim: A.
        key: consumed.
    """
    keys = jax.random.split(key, 9)
    d, h, s, g = config.deter, config.hidden, config.stoch_size, config.blocks
    return {
        "in_deter": nets.init_layer(keys[0], d, h),
        "in_stoch": nets.init_layer(keys[1], s, h),
        "in_action": nets.init_layer(keys[2], action_dim, h),
        "core": {**nets.init_block_linear(keys[3], g, d + 3 * h * g, d), "scale": jnp.ones((d,), jnp.float32)},
        "gates": nets.init_block_linear(keys[4], g, d, 3 * d),
        "prior": nets.init_mlp(keys[5], d, h, 2),
        "prior_logit": nets.init_linear(keys[6], h, s),
        "post": nets.init_layer(keys[7], d + tokens, h),
        "post_logit": nets.init_linear(keys[8], h, s),
    }


def initial(config: DreamerConfig, batch: int) -> Latent:
    """All-zero state of `batch` episodes at their start."""
    return Latent(jnp.zeros((batch, config.deter), config.dtype), jnp.zeros((batch, config.stoch_size), config.dtype))


def embed_action(params: Params, action: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """(..., A) raw samples -> (..., hidden). Samples beyond +-1 are scaled back, not clipped."""
    bounded = action / jax.lax.stop_gradient(jnp.maximum(1.0, jnp.abs(action)))
    return nets.layer(params["in_action"], bounded.astype(dtype))


def to_logits(config: DreamerConfig, flat: jax.Array) -> jax.Array:
    """(..., S * C) -> (..., S, C) float32."""
    return flat.astype(jnp.float32).reshape(*flat.shape[:-1], config.stoch, config.classes)


def prior_probs(config: DreamerConfig, params: Params, deter: jax.Array) -> jax.Array:
    """Probabilities (..., S, C) of the latent before seeing the image, from deter (..., D)."""
    logits = nets.linear(params["prior_logit"], nets.mlp(params["prior"], deter))
    return dist.unimix_probs(to_logits(config, logits), config.unimix)


def gru(config: DreamerConfig, deter: jax.Array, gates: jax.Array) -> jax.Array:
    """New deter (B, D) from old deter (B, D) and gate inputs (B, G, 3 D / G)."""
    reset, candidate, update = jnp.split(gates.astype(jnp.float32), 3, -1)
    old = deter.astype(jnp.float32).reshape(reset.shape)
    candidate = jnp.tanh(jax.nn.sigmoid(reset) * candidate)
    update = jax.nn.sigmoid(update - 1.0)
    new = update * candidate + (1.0 - update) * old
    return new.reshape(deter.shape).astype(deter.dtype)


def core(config: DreamerConfig, params: Params, latent: Latent, action: jax.Array) -> jax.Array:
    """Next deter (B, D) from the latent (B, ...) and the action (B, A) taken in it."""
    parts = [
        nets.layer(params["in_deter"], latent.deter),
        nets.layer(params["in_stoch"], latent.stoch),
        embed_action(params, action, latent.deter.dtype),
    ]
    operand = _core_operand(config, latent.deter, jnp.concatenate(parts, -1))
    wide = nets.block_linear(params["core"], operand).reshape(latent.deter.shape)
    wide = nets.norm_act(wide, params["core"]["scale"])
    return gru(config, latent.deter, nets.block_linear(params["gates"], _blocks(config, wide)))


def posterior_probs(config: DreamerConfig, params: Params, deter: jax.Array, tokens: jax.Array) -> jax.Array:
    """Probabilities (B, S, C) of the latent after seeing the image, from deter (B, D) and tokens (B, E)."""
    hidden = nets.layer(params["post"], jnp.concatenate([deter, tokens], -1))
    return dist.unimix_probs(to_logits(config, nets.linear(params["post_logit"], hidden)), config.unimix)


def observe_step(
    config: DreamerConfig,
    params: Params,
    latent: Latent,
    action: jax.Array,
    tokens: jax.Array,
    uniform: jax.Array | None,
) -> Latent:
    """Posterior state of one step, used for acting; equal to one step of `observe`.

    Args:
        config: sizes.
        params: from `init`.
        latent: previous state (B, ...), zero at the start of an episode.
        action: (B, A) previous action, zero at the start of an episode.
        tokens: (B, E).
        uniform: (B, S) random numbers in [0, 1), or None to take the most probable class.
    """
    deter = core(config, params, latent, action)
    probs = posterior_probs(config, params, deter, tokens)
    index = jnp.argmax(probs, -1) if uniform is None else dist.sample_index(probs, uniform)
    stoch = dist.one_hot(index, config.classes).reshape(*index.shape[:-1], -1)
    return Latent(deter, stoch.astype(deter.dtype))


class Sequences(NamedTuple):
    """What B agents did and saw in T steps."""

    actions: jax.Array
    """(T, B, A), the action taken BEFORE each image."""
    tokens: jax.Array
    """(T, B, E)."""
    is_first: jax.Array
    """(T, B) bool; there, state and action are zeroed."""
    uniform: jax.Array
    """(T, B, S) random numbers in [0, 1)."""


def observe(
    config: DreamerConfig, params: Params, start: Latent, sequences: Sequences
) -> tuple[Latent, jax.Array]:
    """Posterior states along sequences.

    Everything that does not depend on the recurrent state is computed before the scan: the action's and the tokens'
    share of the products, the random numbers and the masks. Two products of the new deter (into the posterior and into
    the next step) are one.

    Args:
        config: sizes.
        params: from `init`.
        start: state (B, ...) before the first step.
        sequences: of actions and observations.

    Returns:
        States (T, B, ...) with straight-through gradients, and posterior probabilities (T, B, S, C).
    """
    actions, tokens, is_first, uniform = sequences
    dtype = start.deter.dtype
    d, h, g = config.deter, config.hidden, config.blocks
    steps = is_first.shape

    def cast(w: jax.Array) -> jax.Array:
        return w.astype(dtype)

    def every_step(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x, (*steps, *x.shape))

    core_weight, post_weight = cast(params["core"]["w"]), cast(params["post"]["w"])
    weights = _recurrent_weights(config, params, core_weight, post_weight)
    action = embed_action(params, jnp.where(is_first[..., None], 0.0, actions), dtype)
    action_term = jnp.einsum("tbh,gho->tbgo", action, core_weight[:, d // g + 2 * h :])
    token_term = tokens.astype(dtype) @ post_weight[d:] + cast(params["post"]["b"])
    terms = {
        "in_stoch": every_step(cast(params["in_stoch"]["b"])),
        "core": action_term + cast(params["core"]["b"]),
        "gates": every_step(cast(params["gates"]["b"])),
        "deter": jnp.concatenate([jnp.zeros_like(token_term), token_term], -1),
        "post_logit": every_step(cast(params["post_logit"]["b"])),
        "in_deter_bias": every_step(cast(params["in_deter"]["b"])),
        **{f"{name}_scale": every_step(params[name]["scale"]) for name in ("in_deter", "in_stoch", "core", "post")},
    }
    carry = (start.deter, start.stoch, start.deter @ weights["deter"][:, :h])
    inputs = {"is_first": is_first[..., None], "uniform": uniform}
    step = partial(_observe_body, config)
    _, (deter, stoch, probs) = scan_products(step, config.scan_unroll, weights, carry, terms, inputs)
    return Latent(deter, stoch), probs


def _recurrent_weights(
    config: DreamerConfig, params: Params, core: jax.Array, post: jax.Array
) -> dict[str, jax.Array]:
    """Weights of the products with the recurrent state, in the type of those of the core and the posterior."""
    d, h, g, dtype = config.deter, config.hidden, config.blocks, core.dtype
    return {
        "in_stoch": params["in_stoch"]["w"].astype(dtype),
        "core": core[:, : d // g + 2 * h],
        "gates": params["gates"]["w"].astype(dtype),
        "deter": jnp.concatenate([params["in_deter"]["w"].astype(dtype), post[:d]], -1),
        "post_logit": params["post_logit"]["w"].astype(dtype),
    }


def _observe_body(
    config: DreamerConfig,
    weights: dict[str, jax.Array],
    carry: tuple[jax.Array, jax.Array, jax.Array],
    terms: dict[str, jax.Array],
    inputs: dict[str, jax.Array],
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], tuple[jax.Array, ...], dict[str, jax.Array]]:
    """One step of `observe` in the form `scan_products` asks for."""
    h = config.hidden
    deter, stoch, deter_product = (jnp.where(inputs["is_first"], jnp.zeros_like(x), x) for x in carry)
    from_deter = nets.norm_act(deter_product + terms["in_deter_bias"], terms["in_deter_scale"])
    from_stoch = nets.norm_act(keep(stoch @ weights["in_stoch"] + terms["in_stoch"]), terms["in_stoch_scale"])
    operand = _core_operand(config, deter, jnp.concatenate([from_deter, from_stoch], -1))
    wide = keep(nets.block_product(operand, weights["core"]) + terms["core"])
    wide = _blocks(config, nets.norm_act(wide.reshape(deter.shape), terms["core_scale"]))
    gates = keep(nets.block_product(wide, weights["gates"]) + terms["gates"])
    deter = gru(config, deter, gates)
    products = keep(deter @ weights["deter"] + terms["deter"])
    hidden = nets.norm_act(products[:, h:], terms["post_scale"])
    logits = hidden @ weights["post_logit"] + terms["post_logit"]
    probs = dist.unimix_probs(to_logits(config, logits), config.unimix)
    index = dist.sample_index(jax.lax.stop_gradient(probs), inputs["uniform"])
    new_stoch = dist.straight_through(probs, index).reshape(stoch.shape).astype(deter.dtype)
    operands = {"in_stoch": stoch, "core": operand, "gates": wide, "deter": deter, "post_logit": hidden}
    return (deter, new_stoch, products[:, :h]), (deter, new_stoch, probs), operands


def _blocks(config: DreamerConfig, x: jax.Array) -> jax.Array:
    """(B, D) -> (B, G, D / G)."""
    return x.reshape(x.shape[0], config.blocks, -1)


def _core_operand(config: DreamerConfig, deter: jax.Array, shared: jax.Array) -> jax.Array:
    """Each block's own slice of deter beside a copy of the shared inputs: (B, D), (B, X) -> (B, G, D / G + X)."""
    copies = jnp.broadcast_to(shared[:, None], (shared.shape[0], config.blocks, shared.shape[1]))
    return jnp.concatenate([_blocks(config, deter), copies], -1)
