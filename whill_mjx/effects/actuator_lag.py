"""First-order lag of the drive."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.types import Drive, Motion, parameter


@struct.dataclass
class ActuatorLag(Effect):
    """T dF/dt + F = F_wanted, on the force or the torque of each side (backward Euler)."""

    name = "actuator_lag"
    typical = {"time_constant": (0.02, 0.15)}
    source = "estimate"
    time_constant: jax.Array = parameter("s", 0.0, 0.5, 0.0, "time constant of the drive")

    def init(self) -> jax.Array:
        return jnp.zeros((2, 2))  # force and torque of each side so far

    def actuation(self, memory: jax.Array, drive: Drive, motion: Motion) -> tuple[jax.Array, Drive]:
        """Drive with lagging force (2,) and torque (2,)."""
        wanted = jnp.stack([drive.force, drive.torque])
        kept = self.time_constant / (self.time_constant + motion.dt)
        lagged = wanted + (memory - wanted) * kept
        return lagged, replace(drive, force=lagged[0], torque=lagged[1])
