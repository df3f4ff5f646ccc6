"""Smooth forms of clipping and of the sign, shared by the effects; exact at an infinite limit."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from whill_mjx.vehicle.types import Drive, Yielding

REST_SPEED = 0.02  # [m/s] width over which sizes of a speed are smooth at rest
REST_SPIN = 0.02 / 0.1325
"""Spin of a wheel over which forces at it change their sign at rest [rad/s]: a small robot drives as a chair does, but
slower, so a width in m/s would make its dry friction a viscous one."""
REST_RATE = 0.05  # [rad/s] width over which torques change their sign at rest


def soft_limit(value: jax.Array, limit: jax.Array) -> jax.Array:
    """value / (1 + (value / limit)^4)^(1/4): `value` far below the limit, 0.84 of it at the knee.

    Sharper than limit * tanh(value / limit), and exactly `value` at limit = inf.
    """
    square = jnp.square(value / limit)
    return value / jnp.sqrt(jnp.sqrt(1 + jnp.square(square)))


def soft_sign(value: jax.Array, width: float) -> jax.Array:
    """tanh(value / width): the sign of `value`, smooth over `width` around 0."""
    return jnp.tanh(value / width)


def smooth_size(value: jax.Array | float) -> jax.Array:
    """|value|, smooth within `REST_SPEED` of 0, where it is 0."""
    return jnp.sqrt(jnp.square(value) + REST_SPEED**2) - REST_SPEED


def scale_drive(drive: Drive, factor: jax.Array) -> Drive:
    """Force and torque of the drive times `factor`, () or (2,); a vehicle's drive uses one of them."""
    return replace(drive, force=drive.force * factor, torque=drive.torque * factor,
                   yielding=yielding_by(drive, factor))


def yielding_by(drive: Drive, factor: jax.Array) -> Yielding:
    """How the drive's torque yields if only a share `factor` of it, () or (2,), reaches the wheel within the step."""
    return replace(drive.yielding, factor=drive.yielding.factor * factor)


def limit_drive(drive: Drive, force: jax.Array, torque: jax.Array) -> Drive:
    """The drive with force and torque limited by `soft_limit`; a torque at its limit yields no further."""
    square = jnp.square(jnp.square(drive.torque / torque))
    share = 1 / ((1 + square) * jnp.sqrt(jnp.sqrt(1 + square)))  # the limit's slope
    return replace(drive, force=soft_limit(drive.force, force), torque=soft_limit(drive.torque, torque),
                   yielding=yielding_by(drive, share))
