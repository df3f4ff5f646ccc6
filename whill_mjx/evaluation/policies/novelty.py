"""Surprise: how far what a policy believes contradicts itself, and how far it does so in the policy's own world.

A world model that has learned in training where the goal lies believes in each frame where it is, and how the vehicle
moves. Where both are right, the goal moves backwards in the body frame as the vehicle moves ahead. In a picture that
the model misreads it jumps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env, reset, step

SURPRISE, BELIEVED = "surprise", "believed"
"""Names of the carries (1,) and (4,) of a policy that is watched."""
RATE = 0.1
"""Weight of the newest frame in the running mean: a second at 10 Hz."""
SLOW, STOP = 0.9, 0.99
"""Shares of the arrivals in its own world in which a policy is never slowed down, and never stopped."""


def contradiction(before: jax.Array, now: jax.Array, seconds: float) -> jax.Array:
    """() m between the goal as it is believed now and where the beliefs one frame before put it by now.

    Args:
        before, now: (4,) goal x, y [m], speed [m/s] and yaw rate [rad/s] in the body frame.
        seconds: between them.
    """
    x, y, turn = before[0] - before[2] * seconds, before[1], before[3] * seconds
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return jnp.sqrt((now[0] - cos * x - sin * y) ** 2 + (now[1] + sin * x - cos * y) ** 2)


def watched(step: Callable, carry: dict[str, Any], seconds: float, believe: Callable) -> tuple[Callable, dict]:
    """A policy step whose carry also holds its surprise [m], a running mean of `contradiction`; and its first carry.

    Args:
        step: (weights, carry, image) -> carry, action.
        carry: at the start, all zeros.
        seconds: between two frames.
        believe: (weights, carry) -> (4,) as `contradiction` takes it.
    """

    def watching(weights: Any, carry: dict[str, jax.Array], image: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        inner = {name: value for name, value in carry.items() if name not in (SURPRISE, BELIEVED)}
        inner, action = step(weights, inner, image)
        now, before = believe(weights, inner), carry[BELIEVED]
        fresh = jnp.where(jnp.sum(jnp.abs(before)) > 0.0, contradiction(before, now, seconds), 0.0)
        return {**inner, SURPRISE: carry[SURPRISE] + RATE * (fresh - carry[SURPRISE]), BELIEVED: now}, action

    return watching, {**carry, SURPRISE: jnp.zeros(1), BELIEVED: jnp.zeros(4)}


def largest_surprise(
    env: Env, params: Any, act: Callable, weights: Any, carry: dict[str, Any], keys: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Largest surprise of each episode (N,) [m], of all its decisions as the bridge sees them; whether it arrived (N,).

    Args:
        env, params: the policy's own world.
        act: (weights, carry, image) -> carry, action; the carry holds SURPRISE.
        weights: of the policy.
        carry: at the start.
        keys: (N,) of the episodes.
    """
    length = -(-env.task.max_steps // env.task.action_repeat)

    def one(weights: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state, first = reset(env, params, key)

        def decide(before, _):
            state, memory, image, most, arrived = before
            memory, action = act(weights, memory, image)
            now = jnp.where(state.done, 0.0, jnp.mean(memory[SURPRISE]))
            state, seen = step(env, params, state, action)
            arrived = jnp.maximum(arrived, seen.metrics["success"])
            return (state, memory, seen.obs, jnp.maximum(most, now), arrived), None

        start = (state, jax.tree.map(jnp.asarray, carry), first.obs, jnp.zeros(()), jnp.zeros(()))
        last, _ = jax.lax.scan(decide, start, length=length)
        return last[3], last[4]

    most, arrived = jax.jit(jax.vmap(one, in_axes=(None, 0)))(weights, keys)
    return np.asarray(most), np.asarray(arrived)


def limits(largest: np.ndarray, arrived: np.ndarray) -> tuple[float, float]:
    """Surprise [m] from which a vehicle slows down, and at which it stands still.

    Drives that would not arrive are those to stop, so the limits are of the others. Where none arrived, all count.
    """
    good = np.asarray(arrived) > 0.5
    slow, stop = np.quantile(largest[good] if good.any() else largest, [SLOW, STOP])
    return float(slow), float(max(stop, slow * 1.001))
