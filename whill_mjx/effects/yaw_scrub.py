"""Scrub of wide contact patches."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, yaw_rate
from whill_mjx.types import Motion, Wrench, parameter

REST_RATE = 0.05  # [rad/s], smooths the change of sign at rest


@struct.dataclass
class YawScrub(Effect):
    """Torque against turning: T_z = -T_s tanh(omega / omega_0). Typical 2 to 15 N m for a powered chair (estimate)."""

    name = "yaw_scrub"
    typical = {"torque": (2.0, 15.0)}
    source = "estimate; grows with the load of the drive wheels: Lin 2015"
    torque: jax.Array = parameter("N m", 0.0, 200.0, 0.0, "scrub torque")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench with a yaw torque only."""
        return memory, replace(Wrench.zero(), tz=-self.torque * jnp.tanh(yaw_rate(motion) / REST_RATE))
