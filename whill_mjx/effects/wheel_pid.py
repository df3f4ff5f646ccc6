"""Wheel-speed control: a PID with anti-windup."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

DERIVATIVE_FILTER = 0.03  # [s] time constant of the low-pass on the derivative


@struct.dataclass
class PidMemory:
    """Integral of the error, last measured speed and its filtered derivative, per wheel."""

    integral: jax.Array  # (2,)
    measured: jax.Array  # (2,)
    derivative: jax.Array  # (2,)


def pid_memory() -> PidMemory:
    """Memory of a controller at rest."""
    return PidMemory(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))


def pid(
    kp: jax.Array,
    ki: jax.Array,
    kd: jax.Array,
    limit: jax.Array,
    memory: PidMemory,
    target: jax.Array,
    measured: jax.Array,
    dt: float,
) -> tuple[PidMemory, jax.Array]:
    """kp e + ki clip(integral of e, +-limit) - kd d(measured)/dt per wheel, with e = target - measured.

    The derivative is of the measurement, not of the error: a step of the target would otherwise kick the vehicle with
    kd * step / dt, which depends on the time step. It is low-passed: an acceleration fed back within one physics step
    would oscillate at kd near 1.

    Args:
        kp, ki, kd, limit: () gains, and the bound of the integral (anti-windup).
        memory: from `pid_memory` or the previous call.
        target, measured: (2,) speeds.
        dt: time since the previous call [s].

    Returns:
        New memory, and the control output (2,).
    """
    error = target - measured
    integral = jnp.clip(memory.integral + error * dt, -limit, limit)
    slope = (measured - memory.measured) / dt
    derivative = memory.derivative + (slope - memory.derivative) * dt / (dt + DERIVATIVE_FILTER)
    output = kp * error + ki * integral - kd * derivative
    return PidMemory(integral, measured, derivative), output
