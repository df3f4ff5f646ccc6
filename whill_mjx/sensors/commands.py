"""The last commands, which a controller knows because it sent them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.io.fields import Field
from whill_mjx.sensors.base import Reading, Sensor, View


@dataclass(frozen=True)
class Commands(Sensor):
    """(2 length,) speeds [m/s] and yaw rates [rad/s] commanded in the last steps, the newest first."""

    name: ClassVar[str] = "commands"
    ranges: ClassVar[tuple[Field, ...]] = (Field("length", kind="whole", low=1, high=1000),)

    length: int = 1
    """Steps that are remembered; those before the start are zero."""

    def reading(self, env: Any) -> Reading:
        return Reading((2 * self.length,))

    def begin(self, view: View) -> Any:
        return jnp.zeros(2 * self.length)

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        kept = jnp.concatenate([view.state.command, memory])[: 2 * self.length]
        return kept, kept

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value * np.tile(np.array([1.0, -1.0], np.float32), self.length)
