"""How surprising its own world is to a policy: the scale on which its surprise elsewhere is read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env, reset, step

SETTLED = 5
"""Decisions after which the running mean no longer shows the first frame, which is new to every policy."""
SLOW, STOP = 0.9, 0.99
"""Shares of the episodes of its own world in which a policy is never slowed down, and never stopped."""


def largest_surprise(
    env: Env, params: Any, act: Callable, weights: Any, carry: dict[str, Any], keys: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Largest surprise of each episode (N,) [nat], and whether it arrived (N,).

    Args:
        env, params: the policy's own world.
        act: (weights, carry, image) -> carry, action; the carry holds "surprise".
        weights: of the policy.
        carry: at the start.
        keys: (N,) of the episodes.
    """
    length = -(-env.task.max_steps // env.task.action_repeat)

    def one(weights: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state, first = reset(env, params, key)

        def decide(before, index):
            state, memory, image, most, arrived = before
            memory, action = act(weights, memory, image)
            now = jnp.where((index >= SETTLED) & ~state.done, jnp.mean(memory["surprise"]), 0.0)
            state, seen = step(env, params, state, action)
            arrived = jnp.maximum(arrived, seen.metrics["success"])
            return (state, memory, seen.obs, jnp.maximum(most, now), arrived), None

        start = (state, jax.tree.map(jnp.asarray, carry), first.obs, jnp.zeros(()), jnp.zeros(()))
        last, _ = jax.lax.scan(decide, start, jnp.arange(length))
        return last[3], last[4]

    most, arrived = jax.jit(jax.vmap(one, in_axes=(None, 0)))(weights, keys)
    return np.asarray(most), np.asarray(arrived)


def limits(largest: np.ndarray) -> tuple[float, float]:
    """Surprise [nat] from which a vehicle slows down, and at which it stands still."""
    slow, stop = np.quantile(largest, [SLOW, STOP])
    return float(slow), float(max(stop, slow * 1.001))
