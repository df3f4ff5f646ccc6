"""The vehicle's own odometry, with whatever its effects of sensing do to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.sensors.base import Reading, Sensor, View


@dataclass(frozen=True)
class Odometry(Sensor):
    """(5,) x, y [m], yaw [rad] since the start of the episode, v [m/s], omega [rad/s]."""

    name: ClassVar[str] = "odometry"

    def reading(self, env: Any) -> Reading:
        return Reading((5,))

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        reported = view.state.vehicle.odometry
        return memory, jnp.stack([reported.x, reported.y, reported.yaw, reported.v, reported.omega])

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value * np.array([1.0, -1.0, -1.0, 1.0, -1.0], np.float32)
