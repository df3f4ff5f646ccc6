"""Frames and speeds: (v, omega) <-> wheel speeds, and poses of the reference point and the camera."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from whill_mjx.vehicle.model import VehicleModel


def wheel_speeds(command: jax.Array, track: float) -> jax.Array:
    """Speeds (2,) of the left and right wheels [m/s] for a command (2,) of v [m/s] and omega [rad/s]."""
    v, omega = command[0], command[1]
    return jnp.stack([v - omega * track / 2, v + omega * track / 2])


def twist_from_wheels(speeds: jax.Array, track: float) -> jax.Array:
    """(v, omega) (2,) of a vehicle whose left and right wheels (2,) roll without slip at these speeds [m/s]."""
    return jnp.stack([(speeds[0] + speeds[1]) / 2, (speeds[1] - speeds[0]) / track])


def rotation_from_quaternion(quaternion: jax.Array) -> jax.Array:
    """Rotation (3, 3), body to world, of a quaternion (4,) w, x, y, z that need not be of unit length."""
    w, x, y, z = quaternion / jnp.linalg.norm(quaternion)
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def quaternion_from_angles(roll: jax.Array, pitch: jax.Array, yaw: jax.Array) -> jax.Array:
    """Quaternion (4,) of the rotation yaw about z, then pitch about y, then roll about x [rad]."""
    cr, sr = jnp.cos(roll / 2), jnp.sin(roll / 2)
    cp, sp = jnp.cos(pitch / 2), jnp.sin(pitch / 2)
    cy, sy = jnp.cos(yaw / 2), jnp.sin(yaw / 2)
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def heading(rotation: jax.Array) -> jax.Array:
    """Yaw () in (-pi, pi] of a rotation (3, 3)."""
    return jnp.arctan2(rotation[1, 0], rotation[0, 0])


def reference_pose(model: VehicleModel, qpos: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """x, y [m] and yaw [rad] of the reference point (driven-axle centre) in the world."""
    rotation = rotation_from_quaternion(qpos[3:7])
    point = qpos[:3] + rotation[:, 0] * model.spec.reference_x
    return point[0], point[1], heading(rotation)


def body_twist(model: VehicleModel, qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Forward speed [m/s] at the reference point and yaw rate [rad/s] of the body.

    The reference point lies on the chassis x axis, so its forward speed is that of the origin.
    """
    rotation = rotation_from_quaternion(qpos[3:7])
    yaw = heading(rotation)
    forward = jnp.cos(yaw) * qvel[0] + jnp.sin(yaw) * qvel[1]
    return forward, (rotation @ qvel[3:6])[2]


def camera_pose(model: VehicleModel, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position (3,) and rotation (3, 3), camera to world, of the camera; its axes are x right, y down, z forward."""
    mount = model.spec.camera
    rotation = rotation_from_quaternion(qpos[3:7])
    position = qpos[:3] + rotation @ jnp.array([mount.x, mount.y, mount.z])
    cos, sin = jnp.cos(mount.pitch), jnp.sin(mount.pitch)
    # Columns: the camera's right, down and forward axes in the chassis frame, tilted down by `pitch`.
    mounted = jnp.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]).T
    right, down, forward = mounted.T
    tilted = jnp.stack([right, cos * down - sin * forward, cos * forward + sin * down])
    if mount.roll or mount.yaw:  # clockwise for somebody who looks along with the camera, then to the left
        (right, down, forward), c, s = tilted, jnp.cos(mount.roll), jnp.sin(mount.roll)
        tilted = jnp.stack([c * right + s * down, c * down - s * right, forward])
        c, s = jnp.cos(mount.yaw), jnp.sin(mount.yaw)
        tilted = tilted @ jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    return position, rotation @ tilted.T
