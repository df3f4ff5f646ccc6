"""Effects that a replay takes out of the vehicle, since their law applies to all commands or all records at once, and
what an odometry makes of a recorded motion: frames, low-pass and latency."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.command_delay import CommandDelay
from whill_mjx.effects.pose_delay import PoseDelay
from whill_mjx.effects.sensor_delay import SensorDelay
from whill_mjx.vehicle.types import Motion

LONG = 1e6  # A time after which every effect on commands has come to what it makes of a constant command [s]


def without(params: Any, name: str) -> tuple[Any, Any]:
    """The vehicle without the last of its effects of sensing, where that is the named one, and that effect or None."""
    effects = getattr(params, "effects", ())
    last = [effect for effect in effects if hasattr(effect, "sensing")][-1:]
    if not last or getattr(last[0], "name", "") != name:
        return params, None
    return replace(params, effects=tuple(effect for effect in effects if effect is not last[0])), last[0]


def delay_apart(params: Any) -> tuple[Any, CommandDelay | None]:
    """The vehicle without the first of its effects on commands, where that is a delay, and that delay or None."""
    effects = getattr(params, "effects", ())
    first = next((effect for effect in effects if hasattr(effect, "command")), None)
    if not isinstance(first, CommandDelay):
        return params, None
    return replace(params, effects=tuple(effect for effect in effects if effect is not first)), first


def delayed(delay: CommandDelay | None, command: jax.Array, dt: float, before: jax.Array | None = None) -> jax.Array:
    """Commands (R, K, 2) delayed by its law; `before` (2,) is the one in force until they begin, by default none."""
    if delay is None:
        return command
    return delay.ahead(command.reshape(-1, 2), dt, before).reshape(command.shape)


@struct.dataclass
class Reached(Effect):
    """An effect on commands as it is where each command has been in force for ever."""

    effect: Any

    def command(self, memory: Any, command: jax.Array, motion: Motion) -> tuple[Any, jax.Array]:
        """What the effect makes of a constant command (2,) in the end."""
        held: Any = SimpleNamespace(dt=LONG, track=getattr(motion, "track", None))
        return self.effect.command(memory, command, held)


def reached(params: Any) -> Any:
    """The vehicle with all effects on commands as they are in the end; memories are those of the vehicle itself."""
    effects = getattr(params, "effects", ())
    if not any(hasattr(effect, "command") for effect in effects):
        return params
    return replace(params, effects=tuple(Reached(one) if hasattr(one, "command") else one for one in effects))


def framed(speeds: jax.Array, time_constant: jax.Array, period: float, dt: float) -> jax.Array:
    """Speeds (R, 2) as an odometry reports them that is computed once a period [s], of true ones every `dt` [s].

    An encoder's counts give the mean over the period; the low-pass goes on by one step in each.
    """
    ways = jnp.concatenate([jnp.zeros((1, 2), speeds.dtype), jnp.cumsum((speeds[1:] + speeds[:-1]) / 2 * dt, axis=0)])
    back = period / dt
    whole = math.floor(back + 1e-6)
    part = max(back - whole, 0.0)

    def before(values: jax.Array) -> jax.Array:
        """Values one period ago; the first ones last for ever before them."""
        padded = jnp.concatenate([jnp.repeat(values[:1], whole + 1, axis=0), values])
        return padded[1 : 1 + len(values)] * (1 - part) + padded[: len(values)] * part

    # Before its first record the vehicle goes on as it begins: at rest, or at the start's speeds.
    known = jnp.minimum(jnp.arange(len(ways)) / back, 1.0)[:, None]  # share of the period since then
    means = (ways - before(ways)) / period + speeds[0] * (1 - known)
    keep = jnp.exp(-period / jnp.maximum(time_constant, 1e-6))

    size = max(whole, 1)  # records at once: none of them is filtered with another

    def step(past: jax.Array, means: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Filtered speeds of the next records, from their means (size, 2) and those of the size + 1 before, `past`."""
        old = past[1:] * (1 - part) + past[:-1] * part
        new = means + keep * (old - means)
        return jnp.concatenate([past[-1:], new]), new

    padded = jnp.concatenate([means, jnp.zeros((-len(means) % size, 2), means.dtype)]).reshape(-1, size, 2)
    filtered = jax.lax.scan(step, jnp.repeat(speeds[:1], size + 1, axis=0), padded)[1]
    return filtered.reshape(-1, 2)[: len(means)]


def late(path: jax.Array, latency: SensorDelay, dt: float) -> jax.Array:
    """Odometry (R, 5) as reported with that latency, of one recorded every `dt` [s], yaw unwrapped."""
    place = jnp.clip(jnp.arange(path.shape[0]) - (latency.delay + latency.speed) / dt, 0.0, None)
    before = jnp.minimum(place.astype(int), path.shape[0] - 2)
    speeds = path[before, 3:] + (place - before)[:, None] * (path[before + 1, 3:] - path[before, 3:])
    return jnp.concatenate([PoseDelay(latency.delay).outside((), path[:, :3], dt)[1], speeds], axis=1)
