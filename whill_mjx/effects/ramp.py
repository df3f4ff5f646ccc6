"""A ramp between two levels."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Surface
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import parameter


@struct.dataclass
class Ramp(Surface):
    """The ground rises by H over the length L, beyond a line at the distance d from the room's origin.

    d is measured along the direction psi in the room. The height is H s^2 (3 - 2 s) with s = (distance - d) / L between
    0 and 1: no kerb at either end, maximum slope 1.5 H / L.
    """

    name = "ramp"
    typical = {"rise": (-0.15, 0.15), "length": (1.0, 3.0), "distance": (0.5, 3.0), "direction": (0.0, 0.0)}
    source = "estimate: ramps of buildings to 1:12"
    card = Card(mirrored=("direction",))
    rise: jax.Array = parameter("m", -1.0, 1.0, 0.0, "height gained, H")
    length: jax.Array = parameter("m", 0.5, 20.0, 2.0, "length in the direction of the rise, L")
    distance: jax.Array = parameter("m", -20.0, 20.0, 1.0, "distance of its start from the room's origin, d")
    direction: jax.Array = parameter("rad", -3.2, 3.2, 0.0, "direction of the rise in the room, psi")

    def height(self, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Height [m] and slopes at places of any shape."""
        cos, sin = jnp.cos(self.direction), jnp.sin(self.direction)
        share = jnp.clip((cos * x + sin * y - self.distance) / self.length, 0.0, 1.0)
        slope = self.rise * 6 * share * (1 - share) / self.length
        return self.rise * share * share * (3 - 2 * share), slope * cos, slope * sin
