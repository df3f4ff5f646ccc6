"""Limit on the change of the commanded acceleration."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_ALL_DRIVE, Axis, Card, Falsifier, Variant
from whill_mjx.vehicle.types import Motion, parameter


@struct.dataclass
class JerkMemory:
    """The command followed so far, and its last change."""

    value: jax.Array  # (2,)
    change: jax.Array  # (2,) over one physics step


@struct.dataclass
class JerkLimit(Effect):
    """The command followed at a limited jerk: |d2v/dt2| <= j, an S-shaped ramp of duration 2 sqrt(step / j).

    The acceleration grows at the rate j. It then falls along a = sqrt(2 j e) with the distance e to the command, so
    that it is 0 when the command is reached. In discrete time the steps of that fall add up to e.
    """

    name = "jerk_limit"
    typical = {"linear": (5.0, 50.0), "angular": (10.0, 100.0)}
    source = "estimate: ramps of 0.1 to 0.3 s"
    card = Card(
        order=40,
        variants=(Variant((Axis("linear", 20.0, form="inverse"), Axis("angular", 40.0, form="inverse"))),),
        forbids=(Falsifier("lasts as the root of the command's step", "size of the step"), GONE_WHEN_SETTLED,
                 SAME_ALL_DRIVE),
        sensor="a log of the wheel-speed targets inside the vehicle",
    )
    linear: jax.Array = parameter("m/s^3", 0.2, 100.0, float("inf"), "largest change of the acceleration of v")
    angular: jax.Array = parameter("rad/s^3", 0.4, 200.0, float("inf"), "largest change of the acceleration of omega")

    def init(self) -> JerkMemory:
        return JerkMemory(jnp.zeros(2), jnp.zeros(2))

    def command(self, memory: JerkMemory, command: jax.Array, motion: Motion) -> tuple[JerkMemory, jax.Array]:
        """Smoothed command (2,)."""
        jerk = jnp.stack([self.linear, self.angular])
        value, change = memory.value, memory.change
        step = jerk * motion.dt**2  # largest difference between two changes
        # The change b from which steps of b, b - step, b - 2 step, ... add up to the distance.
        distance = jnp.abs(command - value)
        braking = 4 * distance / (1 + jnp.sqrt(1 + 8 * distance / step))
        # One-sided bounds, as in the acceleration limit: exact at an infinite jerk.
        wanted = jnp.minimum(jnp.maximum(command, value - braking), value + braking)
        followed = jnp.minimum(jnp.maximum(wanted, value + change - step), value + change + step)
        return JerkMemory(followed, followed - value), followed
