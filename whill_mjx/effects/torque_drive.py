"""The physical drive: torque control of each wheel's speed."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.types import Drive, Motion, parameter


@struct.dataclass
class TorqueDrive(Effect):
    """T = clip(kp e + ki integral of e, +-limit) with e = v_target / r - spin.

    While the torque is at its limit the integral goes on at `windup` times its rate: 1 is a plain PI controller, which
    overshoots after a long acceleration, 0 stops integrating (anti-windup).
    """

    name = "torque_drive"
    typical = {"kp": (2.0, 20.0), "ki": (2.0, 30.0), "limit": (8.0, 30.0)}
    source = "estimate, for the chair"
    kp: jax.Array = parameter("N m s/rad", 0.1, 200.0, 0.0, "proportional gain")
    ki: jax.Array = parameter("N m/rad", 0.0, 500.0, 0.0, "integral gain")
    limit: jax.Array = parameter("N m", 1.0, 2000.0, float("inf"), "largest torque of one side")
    windup: jax.Array = parameter("-", 0.0, 1.0, 0.0, "rate of the integral while the torque is at its limit")

    def init(self) -> jax.Array:
        return jnp.zeros(2)  # integral of the speed error [rad]

    def actuation(self, memory: jax.Array, drive: Drive, motion: Motion) -> tuple[jax.Array, Drive]:
        """Adds the motor torque (2,) [N m]."""
        error = drive.target / motion.wheel_radius - motion.spin
        wanted = self.kp * error + self.ki * memory
        torque = jnp.clip(wanted, -self.limit, self.limit)
        free = (jnp.abs(wanted) < self.limit) | (wanted * error < 0)  # inside the limit, or coming back to it
        return memory + jnp.where(free, error, self.windup * error) * motion.dt, replace(
            drive, torque=drive.torque + torque
        )
