"""A depth camera at the place of the vehicle's camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import IMAGE, Reading, Sensor, View
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.world.maps.walls import shown
from whill_mjx.world.render import pinhole, render_frame


@dataclass(frozen=True)
class Depth(Sensor):
    """Distance along the optical axis (H, W) [m], at most `reach`; or as bytes (H, W, 1), 255 at the lens."""

    name: ClassVar[str] = "depth"
    visual: ClassVar[bool] = True
    ranges: ClassVar[tuple[Field, ...]] = (*IMAGE, Field("reach", "m", 0.01, 1e4))

    height: int | None = None
    """Rows; None takes those of the environment."""
    width: int | None = None
    """Columns; None takes those of the environment."""
    reach: float = 10.0
    """Largest distance [m]; what is farther, and the sky, shows it."""
    as_bytes: bool = False
    """Bytes, as the learners read images, instead of metres."""

    def size(self, env: Any) -> tuple[int, int]:
        """Rows and columns."""
        return self.height or env.height, self.width or env.width

    def reading(self, env: Any) -> Reading:
        if self.as_bytes:
            return Reading((*self.size(env), 1), 0, 255, np.uint8)
        return Reading(self.size(env), 0.0, self.reach)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        env, state = view.env, view.state
        position, rotation = camera_pose(env.model, state.vehicle.qpos)
        mount = env.model.spec.camera
        intrinsics = pinhole(mount.fov_y, *self.size(env))
        scene = shown(state.scene, position, rotation, intrinsics, mount)
        depth = render_frame(position, rotation, intrinsics, scene).depth
        depth = jnp.clip(depth, 0.0, self.reach)
        if not self.as_bytes:
            return memory, depth
        return memory, jnp.round(255.0 * (1.0 - depth / self.reach))[..., None]

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value[..., ::-1, :] if self.as_bytes else value[..., ::-1]
