"""Ramp on velocity commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.types import Motion, parameter


@struct.dataclass
class AccelerationLimit(Effect):
    """The command followed at a limited rate: |dv/dt| <= linear, |domega/dt| <= angular.

    Source: the maker's protocol specification, 3.2.8: velocity commands are ramped with about 1.7 m/s^2. Whether the
    ramp acts on (v, omega) or on each wheel is not documented; here it acts on (v, omega).
    """

    name = "acceleration_limit"
    typical = {"linear": (0.5, 2.0), "angular": (1.0, 8.0)}
    source = "maker's protocol specification, 3.2.8: about 1.7 m/s^2 on velocity commands"
    linear: jax.Array = parameter("m/s^2", 0.1, 5.0, float("inf"), "largest change of v")
    angular: jax.Array = parameter("rad/s^2", 0.2, 15.0, float("inf"), "largest change of omega")

    def init(self) -> jax.Array:
        return jnp.zeros(2)  # the ramped command so far

    def command(self, memory: jax.Array, command: jax.Array, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """Ramped command (2,)."""
        step = jnp.stack([self.linear, self.angular]) * motion.dt
        # Two one-sided bounds instead of memory + clip(...): exact at infinite limits.
        ramped = jnp.minimum(jnp.maximum(command, memory - step), memory + step)
        return ramped, ramped
