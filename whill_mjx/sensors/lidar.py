"""A scanning range finder in a horizontal plane."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import ALONG, SCAN, Reading, Sensor, View
from whill_mjx.world.lidar import disturbed, first_hits, sent_from
from whill_mjx.world.scene import Boxes


@dataclass(frozen=True)
class Lidar(Sensor):
    """Distances (rays,) [m] to the first thing in each direction, at most `reach`; the vehicle itself is not seen.

    Ray k looks (k + 0.5) / rays of the field of view to the left of its right edge. The scan is level: the tilt of the
    vehicle is not followed. It meets boxes, cylinders, capsules and people, and the walls of a map. A ray without a
    return reads `reach`.
    """

    name: ClassVar[str] = "lidar"
    ranges: ClassVar[tuple[Field, ...]] = (*SCAN, Field("yaw", "rad", -6.2832, 6.2832))
    noisy: ClassVar[bool] = True

    rays: int = 360
    fov: float = 2.0 * math.pi
    """Field of view [rad], centred straight ahead."""
    reach: float = 10.0
    """Largest distance [m]."""
    x: float = 0.0
    """Ahead of the chassis origin [m]."""
    y: float = 0.0
    """To the left of it [m]."""
    z: float = 0.2
    """Height above the ground [m]; boxes that end below are not met."""
    yaw: float = 0.0
    """Turn to the left [rad]."""
    nearest: float = 0.0
    """Shorter distances give no return [m]."""
    noise: float = field(default=0.0, kw_only=True)
    """Standard deviation of a distance [m]."""
    dropouts: float = 0.0
    """Share of rays that give no return by chance."""
    period: float = 0.0
    """Duration of a scan [s], during which the vehicle moves on; the first ray is the oldest. 0 freezes it."""

    def angles(self) -> np.ndarray:
        """(rays,) rad, from straight ahead of the vehicle to the left."""
        return self.yaw + self.fov * ((np.arange(self.rays) + 0.5) / self.rays - 0.5)

    def reading(self, env: Any) -> Reading:
        return Reading((self.rays,), 0.0, self.reach)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        body, moment = view.moment.body, view.moment
        c, s = jnp.cos(body.yaw), jnp.sin(body.yaw)
        place = jnp.stack([body.x + self.x * c - self.y * s, body.y + self.x * s + self.y * c])
        x, y, turn = sent_from(place, moment.pose, moment.twist, self.rays, self.period)
        found = first_hits(moment.scene, x, y, body.yaw + turn + self.angles(), self.z)
        if not (self.noise or self.dropouts or self.nearest):
            return memory, jnp.minimum(found, self.reach)
        return memory, disturbed(found, key, self.noise, self.dropouts, self.nearest, self.reach)

    @property
    def mirrored(self) -> Callable[[jax.Array], jax.Array] | None:  # type: ignore[override]
        """Left and right exchanged; None of a scanner beside the vehicle's middle, or that scans from right to left."""
        aside = self.period or max(abs(self.y), abs(math.remainder(self.yaw, math.pi))) > ALONG
        return None if aside else lambda value: value[..., ::-1]


def distances(
    x: jax.Array, y: jax.Array, angles: jax.Array, boxes: Boxes, reach: float, heights: tuple[float, Any]
) -> jax.Array:
    """(R,) m from a place to the first box in each direction, at most `reach`.

    Args:
        x, y: () m, where the rays begin.
        angles: (R,) rad in the room.
        boxes: what they meet.
        reach: largest distance [m].
        heights: from where to where [m]; boxes that end below the first or begin at the second or above are not met.
    """
    low, high = heights
    turn = angles[:, None] - boxes.yaw  # (R, P): direction in each box's frame
    dx, dy = x - boxes.centre[:, 0], y - boxes.centre[:, 1]
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    start = jnp.stack([dx * c + dy * s, dy * c - dx * s])[:, None]  # (2, 1, P)
    way = jnp.stack([jnp.cos(turn), jnp.sin(turn)])  # (2, R, P)
    way = jnp.where(jnp.abs(way) < 1e-6, 1e-6, way)
    half = jnp.stack([boxes.half[:, 0], boxes.half[:, 1]])[:, None]
    ends = jnp.stack([(-half - start) / way, (half - start) / way])  # (2, 2, R, P)
    enter, leave = ends.min(0).max(0), ends.max(0).min(0)
    bottom, top = boxes.centre[:, 2] - boxes.half[:, 2], boxes.centre[:, 2] + boxes.half[:, 2]
    met = (leave >= jnp.maximum(enter, 0.0)) & boxes.mask & (bottom < high) & (top >= low)
    return jnp.min(jnp.where(met, jnp.maximum(enter, 0.0), reach), -1, initial=reach)
