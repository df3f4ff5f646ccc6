"""Lateral damping of the axles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench, resting_mass
from whill_mjx.vehicle.specs import GRAVITY
from whill_mjx.vehicle.types import Motion, Wrench, parameter

TOUCHING = 3.0  # a passive wheel loses its damping smoothly below a third of the load that it has at rest


@struct.dataclass
class LateralDamping(Effect):
    """F_y = -c m v_y at each contact, with c of its axle and m the mass it carries (of passive wheels: at rest).

    A tyre's grip follows its present load. The rollers of a passive wheel turn in bearings, whose viscous drag does not
    depend on it. With the present load, a front axle that lifts while the vehicle pulls away would make turning easier.
    Fits of real vehicles, where this is not so, then put the centre of mass on the floor to avoid the shift of load.
    Source of the law and of c: reference paper, Table II.
    """

    name = "lateral_damping"
    typical = {"c_rear": (1.0, 35.0), "c_front": (0.1, 0.5)}
    source = "reference paper, Table II"
    c_rear: jax.Array = parameter("1/s", 0.0, 60.0, 0.0, "lateral damping of the rear axle")
    c_front: jax.Array = parameter("1/s", 0.0, 60.0, 0.0, "lateral damping of the front axle")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the lateral forces at the four contacts."""
        damping = jnp.stack([self.c_rear, self.c_rear, self.c_front, self.c_front])
        driven, carried = motion.world.geometry.driven, motion.normal_force / GRAVITY
        rest = resting_mass(motion)
        passive = rest * jnp.tanh(TOUCHING * carried / rest)
        lateral = -damping * (driven * carried + (1 - driven) * passive) * motion.contact_vy
        return memory, contact_wrench(motion, jnp.zeros(4), lateral)
