"""Where the point that an outside pose follows is on the vehicle."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import parameter


@struct.dataclass
class PoseMount(Effect):
    """p_tracked = p + R(yaw) (x, y), yaw_tracked = yaw + yaw_m: markers or a map's base frame off the reference point.

    It acts in replays of logs only. A turn on the spot shows x and y, travel along a line shows the angle.
    """

    name = "pose_mount"
    typical = {"x": (-0.2, 0.2), "y": (-0.1, 0.1), "yaw": (-0.17, 0.17)}
    source = "estimate: rigid bodies of a motion capture are drawn by hand; a laser sits ahead of the axle"
    card = Card(
        limits="A place on the vehicle, and no physics: a fit frees it, the closed loop does not look for it.",
        mirrored=("y", "yaw"),
    )
    x: jax.Array = parameter("m", -1.0, 1.0, 0.0, "tracked point ahead of the reference point")
    y: jax.Array = parameter("m", -1.0, 1.0, 0.0, "tracked point to the left of the reference point")
    yaw: jax.Array = parameter("rad", -1.6, 1.6, 0.0, "tracked heading to the left of the vehicle's, yaw_m")

    def outside(self, memory: tuple[()], path: jax.Array, dt: float) -> tuple[tuple[()], jax.Array]:
        """Tracked poses (R, 3) of those of the reference point, yaw unwrapped."""
        cos, sin = jnp.cos(path[:, 2]), jnp.sin(path[:, 2])
        moved = [cos * self.x - sin * self.y, sin * self.x + cos * self.y, jnp.full_like(cos, self.yaw)]
        return memory, path + jnp.stack(moved, axis=-1)

    def reference(self, start: jax.Array) -> jax.Array:
        """Start (5,) of the reference point for that of the tracked point: x, y, yaw; v and omega stay."""
        yaw = start[2] - self.yaw
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        moved = jnp.stack([cos * self.x - sin * self.y, sin * self.x + cos * self.y, self.yaw])
        return start.at[:3].add(-moved)
