"""A depth camera, at the place of the vehicle's camera or at one of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import IMAGE, Reading, View
from whill_mjx.sensors.image import Image
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.world.maps.walls import shown
from whill_mjx.world.render import pinhole, render_frame


@dataclass(frozen=True)
class Depth(Image):
    """Distance along the optical axis (H, W) [m], at most `reach`; or as bytes (H, W, 1), 255 at the lens."""

    name: ClassVar[str] = "depth"
    ranges: ClassVar[tuple[Field, ...]] = (*IMAGE, Field("reach", "m", 0.01, 1e4))

    reach: float = 10.0
    """Largest distance [m]; what is farther, and the sky, shows it."""
    as_bytes: bool = False
    """Bytes, as the learners read images, instead of metres."""

    def reading(self, env: Any) -> Reading:
        if self.as_bytes:
            return Reading((*self.size(env), 1), 0, 255, np.uint8)
        return Reading(self.size(env), 0.0, self.reach)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        model = self.model(view.env)
        position, rotation = camera_pose(model, view.state.vehicle.qpos)
        mount = model.spec.camera
        intrinsics = pinhole(mount.fov_y, *self.size(view.env))
        scene = shown(view.state.scene, position, rotation, intrinsics, mount)
        depth = render_frame(position, rotation, intrinsics, scene).depth
        depth = jnp.clip(depth, 0.0, self.reach)
        if not self.as_bytes:
            return memory, depth
        return memory, jnp.round(255.0 * (1.0 - depth / self.reach))[..., None]

    def turned(self, value: jax.Array) -> jax.Array:
        return super().turned(value) if self.as_bytes else value[..., ::-1]
