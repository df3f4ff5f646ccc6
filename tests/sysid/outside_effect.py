"""An effect from outside the package, complete in one file: equation, parameters and card."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects import Effect
from whill_mjx.effects.card import SAME_ALL_DRIVE, SAME_AT_ANY_SPEED, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Odometry, parameter


@struct.dataclass
class HeadingDrift(Effect):
    """omega -> omega + b in the odometry, yaw -> yaw + b t: its heading comes from a gyro that drifts."""

    name = "heading_drift"
    typical = {"rate": (-0.02, 0.02)}
    source = "estimate: an uncalibrated gyro, 1 degree per second"
    card = Card(
        variants=(Variant((Axis("rate", 0.005, signed=True),)),),
        forbids=(SAME_AT_ANY_SPEED, SAME_ALL_DRIVE),
        sensor="the gyro at standstill",
        mirrored=("rate",),
    )
    rate: jax.Array = parameter("rad/s", -0.2, 0.2, 0.0, "yaw rate that is reported at standstill, b")

    def init(self) -> jax.Array:
        return jnp.zeros(())  # time of the drive [s]

    def sensing(self, memory: jax.Array, reading: Odometry, motion: Motion) -> tuple[jax.Array, Odometry]:
        """Reading with a drifting heading."""
        time = memory + motion.dt
        return time, replace(reading, yaw=reading.yaw + self.rate * time, omega=reading.omega + self.rate)
