"""The camera of the vehicle file, or a further one, at any size."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from whill_mjx.env import observe
from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import ALONG, IMAGE, Reading, Sensor, View
from whill_mjx.vehicle.specs import CameraMount, check_mount


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
    mount: CameraMount | None = None
    """Where it sits; None: where the vehicle's camera does. A second camera has its own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mount is not None:
            check_mount("sensor Camera: mount", self.mount)

    def size(self, env: Any) -> tuple[int, int]:
        """Rows and columns."""
        return self.height or env.height, self.width or env.width

    def reading(self, env: Any) -> Reading:
        return Reading((*self.size(env), 3), 0, 255, np.uint8)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        height, width = self.size(view.env)
        model = view.env.model
        if self.mount is not None:
            model = dataclasses.replace(model, spec=dataclasses.replace(model.spec, camera=self.mount))
        return memory, observe(dataclasses.replace(view.env, height=height, width=width, model=model), view.state)

    @property
    def mirrored(self) -> Callable[[jax.Array], jax.Array] | None:  # type: ignore[override]
        """Left and right exchanged; None of a further camera that does not look along the vehicle's middle."""
        return None if self.mount and is_aside(self.mount) else lambda value: value[..., ::-1, :]


def is_aside(mount: CameraMount) -> bool:
    """Whether a camera does not look along the vehicle's middle, so that its mirrored image is that of another one."""
    return max(abs(mount.y), abs(mount.roll), abs(math.remainder(mount.yaw, math.pi))) > ALONG
