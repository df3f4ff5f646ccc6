"""Drag that grows with the square of speed."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import LAW_OF_SPEED, SAME_ALL_DRIVE, SAME_BACKWARD, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, Wrench, parameter


@struct.dataclass
class QuadraticDrag(Effect):
    """F = -c |v| v along the chassis x axis: `air_drag` with both factors in one, and no wind."""

    name = "quadratic_drag"
    typical = {"coefficient": (0.2, 2.0)}
    source = "rho C_d A / 2 with C_d 0.5 to 1.2 and 0.6 to 1.1 m^2; more on soft ground"
    card = Card(
        order=190,
        variants=lambda scale: (Variant((Axis("coefficient", scale.force / scale.speed**2),)),),
        forbids=(LAW_OF_SPEED, SAME_BACKWARD, SAME_ALL_DRIVE),
    )
    coefficient: jax.Array = parameter("N s^2/m^2", 0.0, 100.0, 0.0, "drag coefficient, c")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench along the chassis x axis."""
        speed = motion.velocity[0]
        return memory, replace(Wrench.zero(), fx=-self.coefficient * jnp.abs(speed) * speed)
