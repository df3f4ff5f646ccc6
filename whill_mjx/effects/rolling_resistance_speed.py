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
    """F = -mu_1 v N at each contact, in addition to the constant part, `rolling_resistance`."""

    name = "rolling_resistance_speed"
    typical = {"mu_1": (0.001, 0.01)}
    source = "estimate; the effect of speed is small: PMC8049518"
    card = Card(
        order=180,
        variants=lambda scale: (Variant((Axis("mu_1", 0.004 / scale.speed, limit=25.0),)),),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
        alike=(Alike(("rolling_resistance",), "hidden behind the speed control", "coasting"),),
    )
    mu_1: jax.Array = parameter("s/m", 0.0, 0.1, 0.0, "rise of the rolling resistance coefficient with speed")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the losses at the four contacts."""
        return memory, contact_wrench(motion, -self.mu_1 * motion.normal_force * motion.contact_vx, jnp.zeros(4))
