"""Adaptive gradient clipping, RMS scaling, momentum, learning rate with warm-up: in this order (LaProp)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from dreamer.config import DreamerConfig
from dreamer.types import Params

BEHAVIOR = ("policy", "value")
"""Parameters that learn at `DreamerConfig.behavior_lr`."""


@struct.dataclass
class OptState:
    """State of the optimiser."""

    mu: Params
    """Running mean of the scaled gradients."""
    nu: Params
    """Running mean of the squared gradients."""
    count: jax.Array
    """() int32 updates done."""


def init(params: Params) -> OptState:
    """State before the first update."""
    zeros = jax.tree.map(jnp.zeros_like, params)
    return OptState(zeros, jax.tree.map(jnp.zeros_like, params), jnp.zeros((), jnp.int32))


def clip_adaptively(gradient: jax.Array, param: jax.Array, clip: float, min_norm: float) -> jax.Array:
    """The gradient of one tensor, shrunk to at most clip * |param|."""
    norm = jnp.linalg.norm(gradient.reshape(-1))
    limit = clip * jnp.maximum(min_norm, jnp.linalg.norm(param.reshape(-1)))
    return gradient / jnp.maximum(1.0, norm / limit)


def learning_rate(config: DreamerConfig, count: jax.Array) -> jax.Array:
    """() rate of the update after `count` updates: 0 at first, full after the warm-up, and falling from there."""
    rate = config.lr * jnp.minimum(1.0, count / max(config.warmup, 1) if config.warmup else 1.0)
    if config.lr_decay:
        fallen = jnp.clip((count - config.warmup) / (config.lr_decay - config.warmup), 0.0, 1.0)
        rate = rate * (1.0 - 0.95 * fallen)
    return rate


def update(config: DreamerConfig, params: Params, gradients: Params, state: OptState) -> tuple[Params, OptState]:
    """New parameters and state."""
    count = state.count + 1
    unbias1 = 1.0 - jnp.power(config.beta1, count.astype(jnp.float32))
    unbias2 = 1.0 - jnp.power(config.beta2, count.astype(jnp.float32))
    rate = learning_rate(config, state.count)

    def one(
        share: float, param: jax.Array, gradient: jax.Array, mu: jax.Array, nu: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        gradient = clip_adaptively(gradient, param, config.agc, config.agc_min_norm)
        nu = config.beta2 * nu + (1.0 - config.beta2) * jnp.square(gradient)
        scaled = gradient / (jnp.sqrt(nu / unbias2) + config.eps)
        mu = config.beta1 * mu + (1.0 - config.beta1) * scaled
        return param - rate * share * mu / unbias1, mu, nu

    leaves = [jax.tree.leaves(tree) for tree in (params, gradients, state.mu, state.nu)]
    shares = [config.behavior_lr if name in BEHAVIOR else 1.0
              for name in sorted(params) for _ in jax.tree.leaves(params[name])]  # in the order of the leaves
    results = [one(*group) for group in zip(shares, *leaves, strict=True)]
    structure = jax.tree.structure(params)
    new_params, mu, nu = (jax.tree.unflatten(structure, list(column)) for column in zip(*results, strict=True))
    return new_params, OptState(mu, nu, count)


def global_norm(tree: Params) -> jax.Array:
    """() Euclidean norm of all leaves together."""
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)))
