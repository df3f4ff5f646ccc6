"""The camera of the vehicle file, at any size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from whill_mjx.sensors.base import Reading, Sensor, View
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.world.photometric import augment
from whill_mjx.world.render import pinhole, render


@dataclass(frozen=True)
class Camera(Sensor):
    """Colour image (H, W, 3) uint8; with the photometric change of the episode where the environment has one."""

    name: ClassVar[str] = "camera"
    visual: ClassVar[bool] = True

    height: int | None = None
    """Rows; None takes those of the environment."""
    width: int | None = None
    """Columns; None takes those of the environment."""

    def size(self, env: Any) -> tuple[int, int]:
        """Rows and columns."""
        return self.height or env.height, self.width or env.width

    def reading(self, env: Any) -> Reading:
        return Reading((*self.size(env), 3), 0, 255, np.uint8)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        env, state = view.env, view.state
        position, rotation = camera_pose(env.model, state.vehicle.qpos)
        height, width = self.size(env)
        intrinsics = pinhole(env.model.spec.camera.fov_y, height, width)
        image = render(position, rotation, intrinsics, state.scene, height, width)
        return memory, augment(image, state.photometry, key) if env.photometric else image

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value[..., ::-1, :]
