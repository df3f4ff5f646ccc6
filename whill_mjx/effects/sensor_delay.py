"""Latency of the reported odometry."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.types import Motion, Odometry, parameter

SLOTS = 16  # readings kept; SLOTS * GAP is the longest delay
GAP = 0.02  # [s] between them


@struct.dataclass
class PastReadings:
    """Readings of the past, newest first. Scalars apart from one another, which a compiler makes one loop of."""

    value: tuple[tuple[jax.Array, ...], ...]  # SLOTS times x, y, yaw, v, omega
    age: jax.Array  # () s, of the newest; the others follow at the same distance


@struct.dataclass
class SensorDelay(Effect):
    """y(t) = x(t - tau) of pose and speeds of the odometry.

    A reading is kept every 20 ms and those between are interpolated. Before the first one the vehicle is taken to have
    stood at the odometry's origin.
    """

    name = "sensor_delay"
    typical = {"delay": (0.005, 0.1)}
    source = "estimate"
    delay: jax.Array = parameter("s", 0.0, 0.3, 0.0, "age of a reading when it is reported")

    def init(self) -> PastReadings:
        return PastReadings(tuple(tuple(jnp.zeros(5)) for _ in range(SLOTS)), jnp.asarray(GAP))

    def sensing(self, memory: PastReadings, reading: Odometry, motion: Motion) -> tuple[PastReadings, Odometry]:
        """Late reading."""
        gap = motion.dt * jnp.maximum(jnp.floor(GAP / motion.dt + 0.5), 1.0)  # a whole number of steps
        now = (reading.x, reading.y, reading.yaw, reading.v, reading.omega)
        late, newer = list(now), now
        for slot, older in enumerate(memory.value):
            # How much of the stretch between the two readings lies within the delay.
            since, length = (0.0, memory.age) if slot == 0 else (memory.age + (slot - 1) * gap, gap)
            share = jnp.clip((self.delay - since) / length, 0.0, 1.0)
            late = [value + share * (then - after) for value, then, after in zip(late, older, newer, strict=True)]
            newer = older
        keep = memory.age > gap - motion.dt / 2
        kept = tuple(
            tuple(jnp.where(keep, after, then) for after, then in zip(newer, older, strict=True))
            for newer, older in zip((now, *memory.value), memory.value, strict=False)
        )
        x, y, yaw, v, omega = late
        age = jnp.where(keep, 0.0, memory.age) + motion.dt
        return PastReadings(kept, age), replace(reading, x=x, y=y, yaw=yaw, v=v, omega=omega)
