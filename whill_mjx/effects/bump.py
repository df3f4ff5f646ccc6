"""A bump or a hollow in the ground."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Surface
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import parameter


@struct.dataclass
class Bump(Surface):
    """A round bump of height H at (x, y), or a hollow: H exp(-(distance / w)^2), at most 0.86 H / w steep.

    The vehicle rolls when the wheels of one side pass over it. A width below 0.1 m would be a kerb for a wheel.
    """

    name = "bump"
    typical = {"rise": (-0.03, 0.03), "width": (0.2, 0.5), "x": (0.5, 2.0), "y": (-0.5, 0.5)}
    source = "estimate: door sills, cable covers, worn floors"
    card = Card(mirrored=("y",))
    rise: jax.Array = parameter("m", -0.2, 0.2, 0.0, "height, H; negative for a hollow")
    width: jax.Array = parameter("m", 0.1, 3.0, 0.3, "distance at which 37 % of the height is left, w")
    x: jax.Array = parameter("m", -50.0, 50.0, 1.0, "x of its centre in the room")
    y: jax.Array = parameter("m", -50.0, 50.0, 0.0, "y of its centre in the room")

    def height(self, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Height [m] and slopes at places of any shape."""
        dx, dy = (x - self.x) / self.width, (y - self.y) / self.width
        height = self.rise * jnp.exp(-(dx * dx + dy * dy))
        return height, -2 * dx / self.width * height, -2 * dy / self.width * height
