"""Lateral damping of the axles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench
from whill_mjx.types import Motion, Wrench, parameter

GRAVITY = 9.81  # [m/s^2], turns the load of a contact into the mass it carries


@struct.dataclass
class LateralDamping(Effect):
    """F_y = -c (N / g) v_y at each contact, c of its axle. Source: reference paper, Table II."""

    name = "lateral_damping"
    typical = {"c_rear": (1.0, 35.0), "c_front": (0.1, 0.5)}
    source = "reference paper, Table II"
    c_rear: jax.Array = parameter("1/s", 0.0, 60.0, 0.0, "lateral damping of the rear axle")
    c_front: jax.Array = parameter("1/s", 0.0, 60.0, 0.0, "lateral damping of the front axle")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the lateral forces at the four contacts."""
        damping = jnp.stack([self.c_rear, self.c_rear, self.c_front, self.c_front])
        lateral = -damping * motion.normal_force / GRAVITY * motion.contact_vy
        return memory, contact_wrench(motion, jnp.zeros(4), lateral)
