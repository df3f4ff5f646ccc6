"""Ground that rises evenly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Surface
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import parameter


@struct.dataclass
class Incline(Surface):
    """The ground is a plane through the room's origin that rises by a towards +x and by b towards +y.

    The vehicle climbs and tilts, and its camera with it. `slope` is the same motion in coordinates of the ground plane:
    gravity tilts instead, and the vehicle's height stays.
    """

    name = "incline"
    typical = {"along_x": (-0.08, 0.08), "along_y": (-0.05, 0.05)}
    source = "estimate: wheelchair ramps to 1:12 (0.083 rad), cross slopes to 1:20"
    card = Card(mirrored=("along_y",))
    along_x: jax.Array = parameter("rad", -0.3, 0.3, 0.0, "rise of the ground towards +x of the room, a")
    along_y: jax.Array = parameter("rad", -0.3, 0.3, 0.0, "rise of the ground towards +y of the room, b")

    def height(self, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Height [m] and slopes at places of any shape; the normal is (-sin a, -sin b, ...)."""
        rise_x, rise_y = jnp.sin(self.along_x), jnp.sin(self.along_y)
        upright = jnp.sqrt(1 - rise_x**2 - rise_y**2)
        slope_x, slope_y = rise_x / upright, rise_y / upright
        return slope_x * x + slope_y * y, slope_x + 0 * x, slope_y + 0 * y
