"""An inertial measurement unit at the chassis origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.sensors.base import Reading, Sensor, View
from whill_mjx.vehicle.kinematics import rotation_from_quaternion
from whill_mjx.vehicle.specs import GRAVITY


@dataclass(frozen=True)
class Imu(Sensor):
    """(6,) specific force [m/s^2] and angular velocity [rad/s] in the chassis frame (x ahead, y left, z up).

    The force is the mean since the last step, so a level vehicle at rest shows +9.81 along z. The yaw rate is that of
    the vehicle's gyro, with its effects of sensing.
    """

    name: ClassVar[str] = "imu"

    def reading(self, env: Any) -> Reading:
        return Reading((6,))

    def begin(self, view: View) -> Any:
        return view.state.vehicle.qvel[:3], view.moment.time_s

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        before, since = memory
        vehicle, now = view.state.vehicle, view.moment.time_s
        seconds = now - since
        change = jnp.where(seconds > 0, (vehicle.qvel[:3] - before) / jnp.where(seconds > 0, seconds, 1.0), 0.0)
        force = rotation_from_quaternion(vehicle.qpos[3:7]).T @ (change + jnp.array([0.0, 0.0, GRAVITY]))
        turn = jnp.stack([vehicle.qvel[3], vehicle.qvel[4], jnp.asarray(vehicle.odometry.gyro)])
        return (vehicle.qvel[:3], now), jnp.concatenate([force, turn])

    def mirrored(self, value: jax.Array) -> jax.Array:  # type: ignore[override]
        return value * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], np.float32)
