"""Offset between the clocks of commands and odometry."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Odometry, parameter

SMOOTHING = 0.02  # [s] low-pass of the acceleration


@struct.dataclass
class ClockMemory:
    """Latest speeds, and their low-passed slope."""

    speed: jax.Array  # (2,) v and omega
    slope: jax.Array  # (2,)


@struct.dataclass
class ClockOffset(Effect):
    """y(t) = x(t - delta), delta of either sign, to first order: speeds less delta times their slope, the pose moved
    back along its arc.

    With a clock that runs ahead the log shows the future, which no buffer holds. So the speeds are extrapolated: exact
    within ramps, wrong for a time |delta| at their corners. Use `sensor_delay` for a known latency.
    """

    name = "clock_offset"
    typical = {"offset": (-0.05, 0.05)}
    source = "estimate"
    card = Card(
        order=260,
        variants=(Variant((Axis("offset", 0.01, signed=True),)),),
        forbids=(SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, GONE_WHEN_SETTLED),
        sensor="an outside pose on the clock of the commands",
        shown_by_pose=True,
    )
    offset: jax.Array = parameter("s", -0.15, 0.15, 0.0, "by how much the odometry's time stamps are late, delta")

    def init(self) -> ClockMemory:
        return ClockMemory(jnp.zeros(2), jnp.zeros(2))

    def sensing(self, memory: ClockMemory, reading: Odometry, motion: Motion) -> tuple[ClockMemory, Odometry]:
        """Reading of another time."""
        speed = jnp.stack([reading.v, reading.omega])
        rise = (speed - memory.speed) / motion.dt
        slope = memory.slope + (rise - memory.slope) * motion.dt / (motion.dt + SMOOTHING)
        middle = reading.yaw - self.offset * reading.omega / 2
        shifted = replace(
            reading,
            x=reading.x - self.offset * reading.v * jnp.cos(middle),
            y=reading.y - self.offset * reading.v * jnp.sin(middle),
            yaw=reading.yaw - self.offset * reading.omega,
            v=reading.v - self.offset * slope[0],
            omega=reading.omega - self.offset * slope[1],
        )
        return ClockMemory(speed, slope), shifted
