"""Coulomb and Stribeck friction of the driven wheels."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, contact_wrench, driven_mean, side_forces
from whill_mjx.effects.card import SAME_ALL_DRIVE, SAME_AT_ANY_SPEED, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.effects.smooth import REST_SPIN, soft_sign
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class DryFriction(Effect):
    """F = -(F_c + F_e exp(-(v / v_s)^2)) tanh(v / v_0) at the driven contacts of each side, v_0 = r 0.15 rad/s.

    It is a force on the ground contact, not a torque on the wheel, because the paper's drive has no wheel speeds of its
    own. Without slip both are the same. The smooth sign lets a pushed vehicle creep instead of stick.
    """

    name = "dry_friction"
    typical = {"coulomb": (2.5, 10.0), "excess": (0.5, 10.0), "stribeck_speed": (0.05, 0.1)}
    source = "estimate: 5 to 20 N for the vehicle, breakaway 1.2 to 2 times as much"
    card = Card(
        order=100,
        variants=lambda scale: (Variant((Axis("coulomb", scale.force / 2),)),),
        forbids=(SAME_AT_ANY_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
    )
    coulomb: jax.Array = parameter("N", 0.0, 200.0, 0.0, "friction of each side, F_c")
    excess: jax.Array = parameter("N", 0.0, 200.0, 0.0, "friction near rest above F_c, of each side, F_e")
    stribeck_speed: jax.Array = parameter("m/s", 0.02, 0.5, 0.08, "speed at which the excess has faded, v_s")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench of the friction at the driven contacts."""
        speed = driven_mean(motion, motion.contact_vx)
        size = self.coulomb + self.excess * jnp.exp(-jnp.square(speed / self.stribeck_speed))
        friction = -size * soft_sign(speed, REST_SPIN * motion.wheel_radius)
        return memory, contact_wrench(motion, side_forces(motion, friction), jnp.zeros(4))
