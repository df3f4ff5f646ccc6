"""Rigid-body step of the vehicle in closed form: a free chassis with two wheel hinges, as `mjx.step` moves them.

The bodies are those of the MJCF asset. For one free body with wheels whose inertia is the same about every axis the
mass matrix is known, and so is its inverse: with F and T the force and the torque about the chassis origin, h the
first moment and c = h / m the common centre of mass, I the inertia about it (all in the chassis frame),

    I alpha = T - c x F - omega x I omega - J (s_left + s_right) omega x e_y        rotation about the centre of mass
    a = F / m + g + c x alpha - omega x (omega x c)                                 of the chassis origin
    s' = (T_wheel - J alpha_y) / (J + A)                                            of each wheel, with armature A

then speeds by Euler's step, as MuJoCo's integrator without implicit damping, and positions with the mean of old and
new speeds. With the new speeds, as MuJoCo has them, everything would come half a step early. The suspension is
damped enough for that, and no stiffer than a step carries (vehicle.py). Source: Newton and Euler.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from whill_mjx.vehicle.kinematics import rotation_from_quaternion
from whill_mjx.vehicle.model import VehicleModel
from whill_mjx.vehicle.types import World


class Chassis(NamedTuple):
    """Mass distribution of the chassis body."""

    mass: jax.Array  # () kg
    inertia: jax.Array  # (3,) kg m^2, about its centre of mass
    com: jax.Array  # (3,) m


def step(
    model: VehicleModel, chassis: Chassis, world: World, qpos: jax.Array, qvel: jax.Array, force: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """qpos (9,) and qvel (8,) one physics step on.

    Args:
        model: static model.
        chassis: of this instance.
        world: its gravity, and its inertia of the wheels over the model's.
        qpos, qvel: the present state.
        force: (8,) as MuJoCo's qfrc_applied.
    """
    dt = model.config.physics_dt
    rotation = rotation_from_quaternion(qpos[3:7])
    acceleration = accelerations(model, chassis, world, rotation, qvel, force)
    return moved(qpos, qvel + acceleration * (dt / 2), dt), qvel + acceleration * dt


def moved(qpos: jax.Array, qvel: jax.Array, dt: float) -> jax.Array:
    """qpos (9,) after moving with qvel (8,) for dt."""
    return jnp.concatenate([qpos[:3] + dt * qvel[:3], turned(qpos[3:7], qvel[3:6], dt), qpos[7:] + dt * qvel[6:]])


def accelerations(
    model: VehicleModel, chassis: Chassis, world: World, rotation: jax.Array, qvel: jax.Array, force: jax.Array
) -> jax.Array:
    """qacc (8,): M^-1 (force - bias). Arguments as of `step`, with the rotation (3, 3), chassis to world."""
    mass, inertia, com = chassis
    wheels = model.wheels
    total = mass + 2 * wheels.mass
    middle = jnp.array([wheels.x, 0.0, 0.0])  # of both wheels
    centre = (mass * com + 2 * wheels.mass * middle) / total
    # About the common centre: parallel axes for the chassis and for each wheel.
    about = jnp.diag(inertia) + _parallel(mass, com - centre) + 2 * wheels.inertia * jnp.eye(3)
    for side in (wheels.y, -wheels.y):
        about = about + _parallel(wheels.mass, jnp.array([wheels.x, side, 0.0]) - centre)
    rate, spin = qvel[3:6], qvel[6:8]
    push = rotation.T @ force[:3]
    hinge = wheels.inertia + wheels.armature * world.wheel_inertia
    torque, wheel_torque = force[3:6], force[6:8]
    turning = about @ rate + jnp.array([0.0, 1.0, 0.0]) * wheels.inertia * (spin[0] + spin[1])  # angular momentum
    moment = torque - _cross(centre, push) - _cross(rate, turning)
    # The wheels turn against the chassis: what accelerates them about y is missing there.
    moment = moment - jnp.array([0.0, 1.0, 0.0]) * wheels.inertia / hinge * (wheel_torque[0] + wheel_torque[1])
    held = about - jnp.diag(jnp.array([0.0, 2 * wheels.inertia**2 / hinge, 0.0]))
    angular = solve_symmetric(held, moment)
    linear = push / total + _cross(centre, angular) - _cross(rate, _cross(rate, centre))
    wheel = (wheel_torque - wheels.inertia * angular[1]) / hinge
    return jnp.concatenate([rotation @ linear + world.gravity, angular, wheel])


def solve_symmetric(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Solution (3,) of a symmetric positive definite system (3, 3), by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
    yy, yz, zz = a * f - c * c, b * c - a * e, a * d - b * b
    cofactors = jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])
    return cofactors @ vector / (a * xx + b * xy + c * xz)


def turned(quaternion: jax.Array, rate: jax.Array, dt: float) -> jax.Array:
    """Quaternion (4,) after turning at `rate` (3,) [rad/s] of the body for dt, of unit length.

    Sine and cosine of half the angle h by their series in h^2: smooth at rest, and exact to rounding up to 0.3 rad.
    """
    square = (dt / 2) ** 2 * (rate * rate).sum()
    sinc = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    w = 1 - square / 2 * (1 - square / 12 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90))))
    x, y, z = rate * (dt / 2 * sinc)
    a, b, c, d = quaternion
    product = jnp.stack([
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ])  # fmt: skip
    return product / jnp.sqrt((product * product).sum())


def _parallel(mass: jax.Array | float, arm: jax.Array) -> jax.Array:
    """Inertia (3, 3) of a point mass at `arm` (3,)."""
    return mass * ((arm * arm).sum() * jnp.eye(3) - arm[:, None] * arm[None, :])


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
