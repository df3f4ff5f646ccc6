"""Rolling resistance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench
from whill_mjx.effects.smooth import REST_SPIN, soft_sign
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class RollingResistance(Effect):
    """F = -mu_r N tanh(v / v_0) at each contact, v_0 = r 0.15 rad/s. Source: reference paper, Table II."""

    name = "rolling_resistance"
    typical = {"mu_r": (0.002, 0.015)}
    source = "reference paper, Table II; carpet adds 0.0118 over linoleum: Hoffman 2003"
    mu_r: jax.Array = parameter("-", 0.0, 0.08, 0.0, "rolling resistance coefficient")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the losses at the four contacts."""
        loss = -self.mu_r * motion.normal_force * soft_sign(motion.contact_vx, REST_SPIN * motion.wheel_radius)
        return memory, contact_wrench(motion, loss, jnp.zeros(4))
