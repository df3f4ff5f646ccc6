"""A scanning range finder of several rings, fixed to the vehicle."""

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
from whill_mjx.vehicle.kinematics import rotation_from_quaternion
from whill_mjx.world.lidar import disturbed, sent_from
from whill_mjx.world.lidar3d import first_returns


@dataclass(frozen=True)
class Lidar3D(Sensor):
    """Distance [m] and intensity (rings, rays, 2) of what each ray meets; ring 0 is the lowest.

    Ray k looks (k + 0.5) / rays of the field of view to the left of its right edge. The scanner tilts with the vehicle,
    which itself is not seen. Intensity is the brightness of the thing times the cosine of incidence, 0 to 1. A ray
    without a return reads `reach` and intensity 0.
    """

    name: ClassVar[str] = "lidar3d"
    ranges: ClassVar[tuple[Field, ...]] = (
        *SCAN, Field("rings", kind="whole", low=1, high=1000), Field("lowest", "rad", -1.5708, 1.5708),
        Field("highest", "rad", -1.5708, 1.5708),
    )  # fmt: skip
    noisy: ClassVar[bool] = True

    rings: int = 16
    rays: int = 180
    """Rays of a ring."""
    fov: float = 2.0 * math.pi
    """Horizontal field of view [rad], centred straight ahead."""
    lowest: float = -0.26
    highest: float = 0.26
    """Angle of the lowest and the highest ring over the scanner's plane [rad]."""
    reach: float = 20.0
    """Largest distance [m]."""
    x: float = 0.0
    """Ahead of the chassis origin [m]."""
    y: float = 0.0
    """To the left of it [m]."""
    z: float = 0.8
    """Above it, along the chassis [m]."""
    nearest: float = 0.0
    """Shorter distances give no return [m]."""
    noise: float = field(default=0.0, kw_only=True)
    """Standard deviation of a distance [m]."""
    dropouts: float = 0.0
    """Share of rays that give no return by chance."""
    period: float = 0.0
    """Duration of a scan [s], during which the vehicle moves on; ray 0 of every ring is the oldest. 0 freezes it."""

    def reading(self, env: Any) -> Reading:
        return Reading((self.rings, self.rays, 2), 0.0, max(self.reach, 1.0))

    def directions(self) -> np.ndarray:
        """(rings, rays, 3) unit vectors in the scanner's own frame: x ahead, y to the left, z up."""
        azimuth = self.fov * ((np.arange(self.rays) + 0.5) / self.rays - 0.5)
        raised = np.linspace(self.lowest, self.highest, self.rings)[:, None]
        flat = np.cos(raised)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(raised) + 0.0 * azimuth], -1)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        qpos, moment = view.state.vehicle.qpos, view.moment
        rotation = rotation_from_quaternion(qpos[3:7])
        place = qpos[:3] + rotation @ jnp.array([self.x, self.y, self.z])
        x, y, turn = sent_from(place[:2], moment.pose, moment.twist, self.rays, self.period)
        c, s, zero = jnp.cos(turn), jnp.sin(turn), jnp.zeros(self.rays)
        turned = jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, zero + 1.0])])
        origin = jnp.stack([x, y, zero + place[2]], -1)
        way = jnp.einsum("ijr,jk,nrk->nri", turned, rotation, jnp.asarray(self.directions(), jnp.float32))
        origin = jnp.broadcast_to(origin, way.shape)
        found = first_returns(view.moment.scene, origin.reshape(-1, 3), way.reshape(-1, 3))
        far = disturbed(found.distance, key, self.noise, self.dropouts, self.nearest, self.reach)
        strength = jnp.where(far < self.reach, jnp.clip(found.albedo * found.cosine, 0.0, 1.0), 0.0)
        return memory, jnp.stack([far, strength], -1).reshape(self.rings, self.rays, 2)

    @property
    def mirrored(self) -> Callable[[jax.Array], jax.Array] | None:  # type: ignore[override]
        """Left and right exchanged; None of a scanner beside the vehicle's middle, or that scans from right to left."""
        return None if self.period or abs(self.y) > ALONG else lambda value: value[..., ::-1, :]
