"""The paper's drive: a PID per wheel gives an acceleration, mapped to a force on the chassis."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.effects.planar import look_ahead
from whill_mjx.vehicle.types import Drive, Motion, Wrench, parameter

DERIVATIVE_FILTER = 0.03  # [s] time constant of the low-pass on the derivative


@struct.dataclass
class PidMemory:
    """Integral of the error, last measured speed and its filtered derivative, per wheel."""

    integral: jax.Array  # (2,)
    measured: jax.Array  # (2,)
    derivative: jax.Array  # (2,)


@struct.dataclass
class PidDrive(Effect):
    """F = m/2 PID(v_target - v_wheel) on each side, the mass shared equally. Source: reference paper, Table II."""

    name = "pid_drive"
    typical = {"kp": (10.0, 28.0), "ki": (0.0, 0.5), "kd": (0.0, 0.75), "integral_limit": (0.5, 1.5)}
    source = "reference paper, Table II"
    card = Card(drives=True)
    kp: jax.Array = parameter("1/s", 0.5, 60.0, 0.0, "proportional gain")
    ki: jax.Array = parameter("1/s^2", 0.0, 20.0, 0.0, "integral gain")
    kd: jax.Array = parameter("-", 0.0, 0.9, 0.0, "derivative gain")
    integral_limit: jax.Array = parameter("m", 0.0, 3.0, 0.0, "anti-windup limit of the integral")

    def init(self) -> PidMemory:
        return PidMemory(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))

    def actuation(self, memory: PidMemory, drive: Drive, motion: Motion) -> tuple[PidMemory, Drive]:
        """Adds the force (2,) of each side [N]."""
        speed = motion.spin * motion.wheel_radius
        memory, acceleration = self.control(memory, drive.target, speed, motion.dt)
        return memory, replace(drive, force=drive.force + motion.mass / 2 * acceleration)

    def control(
        self, memory: PidMemory, target: jax.Array, measured: jax.Array, dt: float
    ) -> tuple[PidMemory, jax.Array]:
        """kp e + ki clip(integral of e, +-limit) - kd d(measured)/dt per wheel, with e = target - measured.

        The derivative is of the measurement, not of the error: a step of the target would otherwise kick the vehicle
        with kd * step / dt, which depends on the time step. It is low-passed: an acceleration fed back within one
        physics step would oscillate at kd near 1.

        Args:
            memory: from `init` or the previous call.
            target, measured: (2,) speeds.
            dt: time since the previous call [s].

        Returns:
            New memory, and the control output (2,).
        """
        error, limit = target - measured, self.integral_limit
        integral = jnp.clip(memory.integral + error * dt, -limit, limit)
        slope = (measured - memory.measured) / dt
        derivative = memory.derivative + (slope - memory.derivative) * dt / (dt + DERIVATIVE_FILTER)
        output = self.kp * error + self.ki * integral - self.kd * derivative
        return PidMemory(integral, measured, derivative), output


@struct.dataclass
class ForwardSlip(Effect):
    """Traction that reaches the ground: F -> eta F. Source: reference paper, Table II (forward slip multiplier)."""

    name = "forward_slip"
    typical = {"eta": (0.8, 1.0)}
    source = "reference paper, Table II"
    eta: jax.Array = parameter("-", 0.3, 1.2, 1.0, "forward slip multiplier")

    def actuation(self, memory: tuple[()], drive: Drive, motion: Motion) -> tuple[tuple[()], Drive]:
        """Scales the force (2,) of each side."""
        return memory, replace(drive, force=self.eta * drive.force)


@struct.dataclass
class RollingContact(Effect):
    """Driven wheels roll without slip: the torque that makes their speed that of the ground after one step.

    The paper's model has no wheel speeds of its own; this effect makes its wheels follow the body. With `grip` = 0 it
    does nothing, with 1 the wheels roll without slip.
    """

    name = "rolling_contact"
    reacts = True
    typical = {"grip": (1.0, 1.0)}
    source = "definition of the paper's model, which has no wheel speeds"
    grip: jax.Array = parameter("-", 0.0, 1.0, 0.0, "share of the speed difference removed in one step")

    def force(self, memory: tuple[()], motion: Motion) -> tuple[tuple[()], Wrench]:
        """Wrench with a torque on the driven wheels only."""
        ground_speed = look_ahead(motion).forward / motion.world.geometry.wheel_radius
        torque = self.grip * motion.wheel_inertia * (ground_speed - motion.spin) / motion.dt
        return memory, replace(Wrench.zero(), spin_torque=torque)
