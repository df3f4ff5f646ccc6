"""What the sensors share that make an image: its size, and where they sit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import ALONG, IMAGE, Sensor
from whill_mjx.vehicle.model import VehicleModel
from whill_mjx.vehicle.specs import CameraMount, check_mount


@dataclass(frozen=True)
class Image(Sensor):
    """A sensor that looks through the vehicle's camera, or from a place of its own."""

    visual: ClassVar[bool] = True
    ranges: ClassVar[tuple[Field, ...]] = IMAGE

    height: int | None = None
    """Rows; None takes those of the environment."""
    width: int | None = None
    """Columns; None takes those of the environment."""
    mount: CameraMount | None = dataclasses.field(default=None, kw_only=True)
    """Where it sits; None: where the vehicle's camera does. A second camera has its own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mount is not None:
            check_mount(f"sensor {type(self).__name__}: mount", self.mount)

    def size(self, env: Any) -> tuple[int, int]:
        """Rows and columns."""
        return self.height or env.height, self.width or env.width

    def model(self, env: Any) -> VehicleModel:
        """The vehicle, with its camera where this sensor sits."""
        if self.mount is None:
            return env.model
        return dataclasses.replace(env.model, spec=dataclasses.replace(env.model.spec, camera=self.mount))

    @property
    def mirrored(self) -> Callable[[jax.Array], jax.Array] | None:  # type: ignore[override]
        """Left and right exchanged; None where a place of its own does not look along the vehicle's middle."""
        return None if self.mount and is_aside(self.mount) else self.turned

    def turned(self, value: jax.Array) -> jax.Array:
        """An image (..., H, W, C) with its columns in reverse."""
        return value[..., ::-1, :]


def is_aside(mount: CameraMount) -> bool:
    """Whether a camera does not look along the vehicle's middle, so that its mirrored image is that of another one."""
    return max(abs(mount.y), abs(mount.roll), abs(math.remainder(mount.yaw, math.pi))) > ALONG
