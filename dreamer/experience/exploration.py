"""How training acts: noise with a memory, and instances without any.

Noise that is drawn anew at every step averages out within a few of them: whatever integrates its actions, as a vehicle
does, hardly leaves its place. Here each instance's noise is a first-order autoregressive process with a unit normal
margin, so that every single action is distributed as the policy says. The instances' time constants spread over
decades, which together is close to pink noise (Eberhard et al., "Pink noise is all you need", ICLR 2023).

Evaluations act by the most probable action. Where noise carries every training episode past a place at which that
action stands still, the model has never seen that standing there pays nothing; instances without noise show it.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.spaces import ActionSpec


def init(config: DreamerConfig, instances: int, action_dim: ActionSpec, key: jax.Array) -> jax.Array | None:
    """(N, A) unit normal noise of each instance; None where noise has no memory.

    Raises:
        ValueError: memory is asked for, and the actions are classes.
    """
    if not config.noise_steps:
        return None
    kind = spaces.actions(action_dim)
    if not isinstance(kind, spaces.Box):
        raise ValueError(
            f"DreamerConfig.noise_steps = {config.noise_steps}: only continuous actions have such noise, and these are "
            f"{kind}. Set it to 0."
        )
    return kind.noise(key, (instances,))


def correlations(config: DreamerConfig, instances: int) -> jax.Array:
    """(N, 1) correlation of each instance's noise with that of the step before.

    The time constants go in equal ratios from one step to `noise_steps`; a single instance has the longest.
    """
    place = jnp.arange(instances) / max(instances - 1, 1) if instances > 1 else jnp.ones(1)
    return jnp.exp(-(config.noise_steps**-place))[:, None]


def advance(config: DreamerConfig, noise: jax.Array, key: jax.Array) -> jax.Array:
    """The noise (N, A) one step later, unit normal again."""
    kept = correlations(config, noise.shape[0])
    return kept * noise + jnp.sqrt(1.0 - kept**2) * jax.random.normal(key, noise.shape)


def uniform(noise: jax.Array) -> jax.Array:
    """Random actions (N, A), uniform in [-1, 1], with the memory of unit normal noise (N, A)."""
    return jax.scipy.special.erf(noise / jnp.sqrt(2.0))


def greedy(config: DreamerConfig, instances: int) -> jax.Array | None:
    """(N,) bool: the last `greedy_share` of the instances; None where that is none."""
    if not config.greedy_share:
        return None
    return jnp.arange(instances) >= instances - math.ceil(config.greedy_share * instances)
