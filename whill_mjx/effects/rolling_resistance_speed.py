"""Rolling resistance that grows with speed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench
from whill_mjx.effects.card import LAW_OF_SPEED, SAME_ALL_DRIVE, SAME_BACKWARD, Alike, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class RollingResistanceSpeed(Effect):
    """F = -mu_1 (1 + growth |v|) v N at each contact, in addition to the constant part, `rolling_resistance`."""

    name = "rolling_resistance_speed"
    typical = {"mu_1": (0.001, 0.01)}
    source = "estimate; the effect of speed is small: PMC8049518; terms of speed and of its square: SAE J2452"
    card = Card(
        order=180,
        variants=lambda scale: (Variant((Axis("mu_1", 0.004 / scale.speed, limit=25.0),
                                         Axis("growth", 0.5 / scale.speed, dependent=True, limit=8.0))),),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
        alike=(Alike(("rolling_resistance",), "hidden behind the speed control", "coasting"),),
    )
    mu_1: jax.Array = parameter("s/m", 0.0, 0.1, 0.0, "rise of the rolling resistance coefficient with speed")
    growth: jax.Array = parameter("s/m", 0.0, 20.0, 0.0, "growth of that rise with speed, as a share of it")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the losses at the four contacts."""
        rise = self.mu_1 * (1 + self.growth * jnp.abs(motion.contact_vx))
        return memory, contact_wrench(motion, -rise * motion.normal_force * motion.contact_vx, jnp.zeros(4))
