"""Latency of the reported odometry."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, Odometry, parameter

SLOTS = 16  # readings kept; SLOTS * GAP is the longest delay
GAP = 0.02  # [s] between them


@struct.dataclass
class PastReadings:
    """Readings of the past, newest first."""

    value: jax.Array  # (SLOTS, 5) x, y, yaw, v, omega
    age: jax.Array  # () s, of the newest; each of the others is one gap older than the one before


@struct.dataclass
class SensorDelay(Effect):
    """y(t) = x(t - tau) of the pose of the odometry, y(t) = x(t - tau - tau_v) of its speeds.

    Speeds that come from counts of an encoder are means over the time between two counts, and older by half of it.

    A reading is kept every 20 ms and those between are interpolated. Before the first one the vehicle is taken to have
    stood at the odometry's origin.
    """

    name = "sensor_delay"
    typical = {"delay": (0.005, 0.1), "speed": (0.0, 0.02)}
    source = "estimate"
    delay: jax.Array = parameter("s", 0.0, 0.3, 0.0, "age of a reading when it is reported, tau")
    speed: jax.Array = parameter("s", 0.0, 0.1, 0.0, "by how much its speeds are older, tau_v")

    def init(self) -> PastReadings:
        return PastReadings(jnp.zeros((SLOTS, 5)), GAP * jnp.ones(()))

    def sensing(self, memory: PastReadings, reading: Odometry, motion: Motion) -> tuple[PastReadings, Odometry]:
        """Late reading."""
        gap = motion.dt * jnp.maximum(jnp.floor(GAP / motion.dt + 0.5), 1.0)  # a whole number of steps
        now = jnp.stack([reading.x, reading.y, reading.yaw, reading.v, reading.omega])
        value = jnp.concatenate([now[None], memory.value])
        since = jnp.concatenate([jnp.zeros(1), memory.age + gap * jnp.arange(SLOTS - 1)])
        length = jnp.concatenate([memory.age[None], jnp.full(SLOTS - 1, gap)])
        # How much of each stretch between two readings lies within the delay.
        delay = self.delay + self.speed * jnp.array([0.0, 0.0, 0.0, 1.0, 1.0])
        share = jnp.clip((delay - since[:, None]) / length[:, None], 0.0, 1.0)
        late = now + (share * (value[1:] - value[:-1])).sum(0)
        keep = memory.age > gap - motion.dt / 2
        x, y, yaw, v, omega = late
        kept = PastReadings(jnp.where(keep, value[:-1], memory.value), jnp.where(keep, 0.0, memory.age) + motion.dt)
        return kept, replace(reading, x=x, y=y, yaw=yaw, v=v, omega=omega)
