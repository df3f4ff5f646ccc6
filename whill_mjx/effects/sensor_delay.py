"""Latency of the reported odometry."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Odometry, parameter

SLOTS = 16  # readings kept; SLOTS * GAP is the longest delay
GAP = 0.02  # [s] between them


@struct.dataclass
class PastReadings:
    """Readings of the past, newest first."""

    value: jax.Array  # (SLOTS, 5) x, y, yaw, v, omega
    age: jax.Array  # () s, of the newest; each next one is one gap older


@struct.dataclass
class SensorDelay(Effect):
    """y(t) = x(t - tau) for the pose of the odometry, y(t) = x(t - tau - tau_v) for its speeds.

    Speeds from encoder counts are means over the time between two counts, and older by half of that time. A reading is
    stored every 20 ms; between stored readings we interpolate. Before the first one the vehicle is assumed to have
    stood at the odometry's origin.
    """

    name = "sensor_delay"
    typical = {"delay": (0.005, 0.1), "speed": (0.0, 0.02)}
    source = "estimate"
    card = Card(
        order=250,
        variants=(Variant((Axis("delay", 0.02),)),),
        forbids=(SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, GONE_WHEN_SETTLED),
        sensor="an outside pose on the clock of the commands",
        shown_by_pose=True,
    )
    delay: jax.Array = parameter("s", 0.0, 0.3, 0.0, "age of a reading when it is reported, tau")
    speed: jax.Array = parameter("s", 0.0, 0.1, 0.0, "additional age of its speeds, tau_v")

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
