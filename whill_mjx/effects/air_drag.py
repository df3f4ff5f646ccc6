"""Air drag."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Alike, Card
from whill_mjx.vehicle.types import Motion, Wrench, parameter

AIR_DENSITY = 1.2  # [kg/m^3] at 20 degrees and sea level


@struct.dataclass
class AirDrag(Effect):
    """F = -1/2 rho C_d A |v_air| v_air along the chassis x axis. Source: reference paper, Table II.

    Only the product of the two parameters matters: free at most one of them in a fit.
    """

    name = "air_drag"
    typical = {"c_d": (0.2, 1.2), "area": (0.6, 1.1)}
    source = "reference paper, Table II"
    card = Card(alike=(Alike(("quadratic_drag",), "the same law", "wind"),))
    c_d: jax.Array = parameter("-", 0.0, 3.0, 0.0, "drag coefficient")
    area: jax.Array = parameter("m^2", 0.0, 2.0, 0.0, "frontal area")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench along the chassis x axis."""
        speed = motion.velocity[0] - (motion.rotation.T @ motion.world.wind)[0]
        force = -0.5 * AIR_DENSITY * self.c_d * self.area * jnp.abs(speed) * speed
        return memory, replace(Wrench.zero(), fx=force)
