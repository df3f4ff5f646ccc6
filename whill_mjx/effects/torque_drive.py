"""The physical drive: torque control of each wheel's speed."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.planar import by_mode, spin_response
from whill_mjx.types import Drive, Motion, parameter

TINY = 1e-6  # [N m], keeps the share defined where the torque does not change


@struct.dataclass
class DriveMemory:
    """State of the controller of each wheel."""

    integral: jax.Array  # (2,) of the speed error [rad]
    expected: jax.Array  # (2,) spin that the last torque alone would have led to [rad/s]
    begun: jax.Array  # () 0 before the first step, 1 after it


@struct.dataclass
class TorqueDrive(Effect):
    """T = clip(kp e + ki integral of e, +-limit) with e = v_target / r - spin.

    e and its integral are those in the middle of the physics step, with the acceleration that this torque gives to
    rolling wheels under the load of the step before: a controller that acts all the time, not once in a step.

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

    def init(self) -> DriveMemory:
        return DriveMemory(jnp.zeros(2), jnp.zeros(2), jnp.zeros(()))

    def actuation(self, memory: DriveMemory, drive: Drive, motion: Motion) -> tuple[DriveMemory, Drive]:
        """Adds the motor torque (2,) [N m]."""
        half = motion.dt / 2
        error = drive.target / motion.wheel_radius - motion.spin
        response = spin_response(motion)
        # What else than the torque changes the spin [rad/s^2]; bounded, as a wheel that spins up has little inertia.
        largest = self.limit * response.max()
        load = jnp.clip(memory.begun * (motion.spin - memory.expected) / motion.dt, -largest, largest)
        # T = kp (e - half (response T + load)) + ki (integral + half e), solved for T.
        wanted = by_mode(
            self.kp * (error - half * load) + self.ki * (memory.integral + half * error),
            1 / (1 + half * self.kp * response),
        )
        torque = jnp.clip(wanted, -self.limit, self.limit)
        gain = by_mode(torque, response)
        acceleration = gain + load
        # Share of the step within the limit, which the wanted torque crosses at the rate kp * acceleration.
        crossing = jnp.maximum(self.kp * jnp.abs(acceleration) * motion.dt, TINY)
        share = jnp.clip(0.5 + (self.limit - jnp.abs(wanted)) / crossing, 0.0, 1.0)
        share = jnp.where(wanted * error < 0, 1.0, share)  # coming back
        rate = (self.windup + (1 - self.windup) * share) * (error - half * acceleration)
        after = DriveMemory(memory.integral + rate * motion.dt, motion.spin + gain * motion.dt, jnp.ones(()))
        return after, replace(drive, torque=drive.torque + torque)
