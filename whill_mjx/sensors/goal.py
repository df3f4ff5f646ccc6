"""Where the goal is, as a localised vehicle would know it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from whill_mjx.sensors.base import Reading, Sensor, View
from whill_mjx.tasks.terms import to_body


@dataclass(frozen=True)
class Goal(Sensor):
    """(2,) goal in the frame of the driven-axle centre: ahead and to the left [m]."""

    name: ClassVar[str] = "goal"

    def reading(self, env: Any) -> Reading:
        return Reading((2,))

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        return memory, to_body(view.moment.pose, view.env.task.goal(view.moment.scene))

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value * np.array([1.0, -1.0], np.float32)
