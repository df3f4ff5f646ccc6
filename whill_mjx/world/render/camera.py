"""Camera model: pinhole with Brown-Conrady distortion, poses, and the ray of each pixel.

Camera axes: x right, y down, z forward. (u, v) = (x/z, y/z) is a point of the normalised image plane.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

UNDISTORT_STEPS = 6
"""Fixed-point steps that invert the distortion; 1e-4 of a pixel for |k1| < 0.35 inside a 90 degree view."""


@struct.dataclass
class Intrinsics:
    """Camera of one instance; pixel (row 0, column 0) has its centre at (0.5, 0.5)."""

    fx: jax.Array  # () focal lengths [pixels]
    fy: jax.Array
    cx: jax.Array  # () principal point [pixels]
    cy: jax.Array
    distortion: jax.Array | None = None  # (5,) k1, k2, p1, p2, k3 as in OpenCV; None: a pinhole, which is faster
    height: int = struct.field(pytree_node=False, default=64)  # rows of the image
    width: int = struct.field(pytree_node=False, default=64)


def pinhole(fov_y: float, height: int = 64, width: int = 64) -> Intrinsics:
    """Intrinsics of a camera with square pixels and vertical field of view `fov_y` [rad]."""
    focal = 0.5 * height / jnp.tan(0.5 * fov_y)
    return Intrinsics(focal, focal, jnp.asarray(0.5 * width), jnp.asarray(0.5 * height), height=height, width=width)


def camera_rotation(yaw, pitch=0.0, roll=0.0) -> jax.Array:
    """Rotation (3, 3), camera to world, of a camera that looks along +x at yaw 0.

    Args:
        yaw: turn to the left [rad].
        pitch: tilt downwards [rad].
        roll: turn clockwise about the line of sight, as seen from behind the camera [rad].
    """
    cy, sy, cp, sp = jnp.cos(yaw), jnp.sin(yaw), jnp.cos(pitch), jnp.sin(pitch)
    cr, sr = jnp.cos(roll), jnp.sin(roll)
    zero = jnp.zeros_like(cy * cp)
    right = jnp.stack([sy + zero, -cy + zero, zero])
    forward = jnp.stack([cy * cp, sy * cp, -sp + zero])
    down = jnp.cross(forward, right)
    return jnp.stack([cr * right + sr * down, cr * down - sr * right, forward], -1)


def look_at(position: jax.Array, target: jax.Array, roll=0.0) -> jax.Array:
    """Rotation (3, 3), camera to world, of a camera at `position` (3,) that looks at `target` (3,) [m]."""
    x, y, z = target - position
    return camera_rotation(jnp.arctan2(y, x), jnp.arctan2(-z, jnp.hypot(x, y)), roll)


def pixel_rays(intrinsics: Intrinsics, row, column, shift=(0.5, 0.5)) -> tuple[jax.Array, jax.Array]:
    """(u, v) of pixels at `row` and `column` (...,) float; `shift` is the place within a pixel."""
    u = (column + (shift[1] - intrinsics.cx)) * (1.0 / intrinsics.fx)
    v = (row + (shift[0] - intrinsics.cy)) * (1.0 / intrinsics.fy)
    if intrinsics.distortion is None:
        return u, v
    return undistort(u, v, intrinsics.distortion)


def distort(u, v, k) -> tuple[jax.Array, jax.Array]:
    """Where the lens shows the ideal image point (u, v): Brown (1966) in OpenCV's order k1, k2, p1, p2, k3."""
    radial, du, dv = _distortion(u, v, k)
    return u * radial + du, v * radial + dv


def undistort(u, v, k) -> tuple[jax.Array, jax.Array]:
    """Ideal image point that the lens shows at (u, v), by fixed-point iteration."""
    x, y = u, v
    for _ in range(UNDISTORT_STEPS):
        radial, du, dv = _distortion(x, y, k)
        inverse = 1.0 / radial
        x, y = (u - du) * inverse, (v - dv) * inverse
    return x, y


def _distortion(x, y, k):
    square = x * x + y * y
    radial = 1.0 + square * (k[0] + square * (k[1] + square * k[4]))
    cross = 2.0 * x * y
    return radial, k[2] * cross + k[3] * (square + 2.0 * x * x), k[2] * (square + 2.0 * y * y) + k[3] * cross
