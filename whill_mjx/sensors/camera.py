"""The camera of the vehicle file, or a further one, at any size."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from whill_mjx.env import observe
from whill_mjx.sensors.base import Reading, View
from whill_mjx.sensors.image import Image


@dataclass(frozen=True)
class Camera(Image):
    """Colour image (H, W, 3) uint8; as the looks of the environment have it."""

    name: ClassVar[str] = "camera"

    def reading(self, env: Any) -> Reading:
        return Reading((*self.size(env), 3), 0, 255, np.uint8)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        height, width = self.size(view.env)
        env = dataclasses.replace(view.env, height=height, width=width, model=self.model(view.env))
        return memory, observe(env, view.state)
