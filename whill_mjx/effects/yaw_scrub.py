"""Scrub of wide contact patches."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import GRAVITY, Effect, resting_mass, yaw_rate
from whill_mjx.vehicle.types import Motion, Wrench, parameter

REST_RATE = 0.05  # [rad/s], smooths the change of sign at rest


@struct.dataclass
class YawScrub(Effect):
    """Torque against turning: T_z = -T_s L tanh(omega / omega_0), L the load of the driven wheels over that at rest.

    Typical 2 to 15 N m for a powered chair (estimate), without what is on board. Where the wheels are braked, the load
    goes forward, and the vehicle turns more easily.
    """

    name = "yaw_scrub"
    typical = {"torque": (2.0, 15.0)}
    source = "estimate; grows with the load of the drive wheels: Lin 2015"
    torque: jax.Array = parameter("N m", 0.0, 200.0, 0.0, "scrub torque")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench with a yaw torque only."""
        driven = motion.world.geometry.driven
        rest = (driven * resting_mass(motion)).sum() * motion.mass / motion.total_mass
        share = (driven * motion.normal_force).sum() / (GRAVITY * rest)
        return memory, replace(Wrench.zero(), tz=-self.torque * share * jnp.tanh(yaw_rate(motion) / REST_RATE))
