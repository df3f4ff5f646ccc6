"""Sideways friction of the rollers of omni-wheels."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench
from whill_mjx.effects.card import GONE_WHEN_STRAIGHT, SAME_ALL_DRIVE, SAME_LEFT_AND_RIGHT, Axis, Card, Variant
from whill_mjx.effects.smooth import REST_SPIN, soft_sign
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class OmniRollerFriction(Effect):
    """F_y = -mu_t N tanh(v_y / v_0) - c v_y at each free wheel, v_0 = r 0.15 rad/s.

    A skid drive has no free wheels: no effect there.
    """

    name = "omni_roller_friction"
    typical = {"mu_t": (0.02, 0.1), "viscous": (0.0, 20.0)}
    source = "estimate"
    card = Card(
        order=150,
        variants=(Variant((Axis("mu_t", 0.02),)),),
        forbids=(SAME_LEFT_AND_RIGHT, GONE_WHEN_STRAIGHT, SAME_ALL_DRIVE),
    )
    mu_t: jax.Array = parameter("-", 0.0, 0.5, 0.0, "sideways friction coefficient of the rollers")
    viscous: jax.Array = parameter("N s/m", 0.0, 200.0, 0.0, "sideways viscous friction of one free wheel, c")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the sideways forces at the free wheels."""
        free = 1 - motion.world.geometry.driven
        dry = self.mu_t * motion.normal_force * soft_sign(motion.contact_vy, REST_SPIN * motion.wheel_radius)
        return memory, contact_wrench(motion, jnp.zeros(4), -free * (dry + self.viscous * motion.contact_vy))
