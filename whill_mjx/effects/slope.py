"""Sloping ground."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import FIXED_IN_ROOM, SAME_BACKWARD, Alike, Axis, Card, Variant
from whill_mjx.vehicle.types import World, parameter


@struct.dataclass
class Slope(Effect):
    """g -> g (-sin a, -sin b, -sqrt(1 - sin^2 a - sin^2 b)): the room's ground rises by a towards +x and b towards +y.

    Coordinates stay those of the ground plane, and gravity tilts instead. 1 degree (0.0175 rad) pulls with 1.7 % of the
    weight, downhill at any heading.
    """

    name = "slope"
    room_fixed = True
    typical = {"along_x": (-0.05, 0.05), "along_y": (-0.05, 0.05)}
    source = "estimate: floors to 1 degree, ramps to 3"
    card = Card(
        order=210,
        variants=(Variant((Axis("along_x", 0.005, signed=True), Axis("along_y", 0.005, signed=True))),),
        forbids=(*FIXED_IN_ROOM, SAME_BACKWARD),
        sensor="an inclinometer on the floor",
        shown_by_pose=True,
        alike=(Alike(("incline",), "the same motion in other coordinates", "height and attitude"),
               Alike(("wind",), "both are a force fixed in the room",
                     "a known load on board: only the slope's pull grows")),
        mirrored=("along_y",),
    )
    along_x: jax.Array = parameter("rad", -0.2, 0.2, 0.0, "rise of the ground towards +x of the room, a")
    along_y: jax.Array = parameter("rad", -0.2, 0.2, 0.0, "rise of the ground towards +y of the room, b")

    def world(self, memory: tuple[()], world: World) -> tuple[tuple[()], World]:
        """World with tilted gravity (3,)."""
        down = world.gravity[2]
        pull_x, pull_y = jnp.sin(self.along_x), jnp.sin(self.along_y)
        upright = jnp.sqrt(1 - pull_x**2 - pull_y**2)
        tilted = jnp.stack([world.gravity[0] + down * pull_x, world.gravity[1] + down * pull_y, down * upright])
        return memory, replace(world, gravity=tilted)
