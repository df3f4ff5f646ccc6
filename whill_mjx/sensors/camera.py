"""The camera of the vehicle file, at any size."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from whill_mjx.env import observe
from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import IMAGE, Reading, Sensor, View


@dataclass(frozen=True)
class Camera(Sensor):
    """Colour image (H, W, 3) uint8; as the looks of the environment have it."""

    name: ClassVar[str] = "camera"
    visual: ClassVar[bool] = True
    ranges: ClassVar[tuple[Field, ...]] = IMAGE

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
        height, width = self.size(view.env)
        return memory, observe(dataclasses.replace(view.env, height=height, width=width), view.state)

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value[..., ::-1, :]
