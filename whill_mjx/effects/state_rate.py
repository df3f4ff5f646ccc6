"""State messages at a fixed rate."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import Motion, Odometry, parameter

MAKER = {"period": 0.02}
"""The maker's driver asks for 50 Hz."""


@struct.dataclass
class StateRate(Effect):
    """The odometry is that of the latest message, one every `period`: a value is up to one period old.

    The mean delay is half a period. `whill_mjx.drive` samples the simulated state at the log's own rate, so this effect
    is for programs that act on the state between messages. Not smooth in the period.
    """

    name = "state_rate"
    typical = {"period": (0.01, 0.05)}
    source = "maker's drivers: 50 Hz of at most 100 Hz; 2 Hz by default on the CR2"
    card = Card(stepped=True)
    period: jax.Array = parameter("s", 0.0, 1.0, 0.0, "time between two messages")

    def init(self) -> jax.Array:
        return jnp.zeros(6).at[5].set(1e3)  # x, y, yaw, v, omega of the latest message; its age [s]

    def sensing(self, memory: jax.Array, reading: Odometry, motion: Motion) -> tuple[jax.Array, Odometry]:
        """Reading of the latest message."""
        now = jnp.stack([reading.x, reading.y, reading.yaw, reading.v, reading.omega])
        due = memory[5] + motion.dt / 2 >= self.period
        message = jnp.where(due, now, memory[:5])
        age = jnp.where(due, 0.0, memory[5]) + motion.dt
        x, y, yaw, v, omega = message
        after = jnp.concatenate([message, age[None]])
        return after, replace(reading, x=x, y=y, yaw=yaw, v=v, omega=omega)
