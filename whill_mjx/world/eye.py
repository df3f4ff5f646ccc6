"""The camera's own part in an image: mount, lens, exposure control, film and delay of one instance.

Numbers are drawn once per episode; the noise is drawn anew in each frame. An image of linear light whose root is taken
(a curve of gamma 2) comes in, and what the camera would send goes out.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

DELAYS = 3
"""Frames by which an image may be late: 0, 1 or 2 control periods."""


@struct.dataclass
class Eye:
    """Camera of one instance; `plain_eye()` changes nothing."""

    turn: jax.Array  # (3,) roll, pitch, yaw by which the mount is off [rad]
    offset: jax.Array  # (3,) m by which it is off, in camera axes
    zoom: jax.Array  # () factor on the field of view
    delay: jax.Array  # () int32 frames
    key: jax.Array  # () level of the mean pixel that the exposure control aims at, in [0, 1]
    control: jax.Array  # () share of the difference that it removes
    white: jax.Array  # (3,) factors on red, green and blue
    contrast: jax.Array  # () factor on the difference from the mean
    saturation: jax.Array  # () factor on the difference from the pixel's own grey level
    vignetting: jax.Array  # () share of the light that is lost in the corners
    blur: jax.Array  # (2,) weight of either neighbour pixel, along rows and columns
    noise: jax.Array  # () standard deviation of the noise at full level [grey levels of 255]
    dark_noise: jax.Array  # () the same at level 0
    flicker: jax.Array  # () relative amplitude by which the exposure control hunts


def plain_eye() -> Eye:
    """The eye that leaves an image as it is."""
    one, zero = jnp.ones(()), jnp.zeros(())
    return Eye(
        jnp.zeros(3), jnp.zeros(3), one, jnp.zeros((), jnp.int32), jnp.asarray(0.45), zero, jnp.ones(3), one, one, zero,
        jnp.zeros(2), zero, zero, zero,
    )  # fmt: skip


def draw_eye(key: jax.Array) -> Eye:
    """An eye drawn at random: a mount off by some degrees, any exposure control, any cheap camera's film."""
    turn_key, key = jax.random.split(key)
    u = jax.random.uniform(key, (24,))
    between = lambda i, low, high: low + u[i] * (high - low)  # noqa: E731
    turn = jnp.deg2rad(jnp.array([1.2, 2.0, 1.2])) * jax.random.truncated_normal(turn_key, -2.0, 2.0, (3,))
    return Eye(
        turn=turn,
        offset=jnp.array([0.02, 0.03, 0.03]) * (2.0 * u[:3] - 1.0),
        zoom=between(3, 0.95, 1.05),
        delay=(u[4] * DELAYS).astype(jnp.int32),
        key=between(5, 0.32, 0.62),
        control=between(6, 0.5, 1.0),
        white=jnp.exp(0.16 * (2.0 * u[7:10] - 1.0)),
        contrast=between(10, 0.8, 1.3),
        saturation=between(11, 0.5, 1.4),
        vignetting=between(12, 0.0, 0.45),
        blur=jnp.stack([between(13, 0.0, 0.25), between(14, 0.0, 0.25)]) * (u[15] < 0.7),
        noise=between(16, 0.0, 6.0),
        dark_noise=between(17, 0.0, 6.0),
        flicker=between(18, 0.0, 0.12),
    )


def mounted(eye: Eye, position: jax.Array, rotation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position (3,) and rotation (3, 3) of the camera whose mount is off."""
    roll, pitch, yaw = eye.turn[0], eye.turn[1], eye.turn[2]
    # Camera axes: x right, y down, z forward. Small turns about them, one after the other.
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (jnp.cos, jnp.sin))
    zero, one = jnp.zeros(()), jnp.ones(())
    about_z = jnp.array([[cr, -sr, zero], [sr, cr, zero], [zero, zero, one]])
    about_x = jnp.array([[one, zero, zero], [zero, cp, sp], [zero, -sp, cp]])
    about_y = jnp.array([[cy, zero, -sy], [zero, one, zero], [sy, zero, cy]])
    return position + rotation @ eye.offset, rotation @ about_y @ about_x @ about_z


def develop(image: jax.Array, eye: Eye, turning: jax.Array, key: jax.Array, step: jax.Array) -> jax.Array:
    """Image (H, W, 3) uint8 as the camera sends it.

    Args:
        image: (H, W, 3) uint8, the root of linear light.
        eye: the camera.
        turning: () pixels by which the image moves sideways while the shutter is open.
        key: random key of the noise.
        step: () frames since the start; the exposure control hunts by it.
    """
    height, width, _ = image.shape
    pixels = image.astype(jnp.float32) * (1.0 / 255.0)
    mean = jnp.maximum(jnp.mean(pixels), 0.02)
    row = (jnp.arange(height) + 0.5) / height - 0.5
    column = (jnp.arange(width) + 0.5) / width - 0.5
    shade = 1.0 - eye.vignetting * 2.0 * (row[:, None] ** 2 + column**2)
    gain = (eye.key / mean) ** eye.control * (1.0 + eye.flicker * jnp.sin(0.9 * step + 40.0 * eye.key))
    pixels = pixels * (jnp.clip(gain, 0.4, 3.0) * shade)[..., None] * eye.white
    grey = jnp.mean(pixels, -1, keepdims=True)
    pixels = grey + eye.saturation * (pixels - grey)
    pixels = eye.key + eye.contrast * (pixels - eye.key)
    pixels = _soften(pixels, eye.blur[0] + jnp.clip(0.3 * jnp.abs(turning), 0.0, 0.3), 1)
    pixels = _soften(pixels, eye.blur[1], 0)
    pixels = pixels / (1.0 + 0.12 * jnp.maximum(pixels, 0.0) ** 4)  # lights saturate softly
    spread = (eye.dark_noise + (eye.noise - eye.dark_noise) * jnp.clip(pixels, 0.0, 1.0)) * (1.0 / 255.0)
    # The sum of four bytes of one random word, less its mean: nearly normal, and a quarter of the random numbers.
    word = jax.random.bits(key, image.shape, jnp.uint32)
    total = sum(((word >> (8 * i) & 255).astype(jnp.int32) for i in range(4)), jnp.zeros(image.shape, jnp.int32))
    pixels = pixels + spread * (total.astype(jnp.float32) - 510.0) * (1.0 / 147.8)
    return jnp.clip(jnp.round(pixels * 255.0), 0.0, 255.0).astype(jnp.uint8)


def _soften(pixels: jax.Array, weight: jax.Array, axis: int) -> jax.Array:
    """Mean of each pixel and its two neighbours along an axis, which have `weight` () each."""
    first = jax.lax.slice_in_dim(pixels, 0, 1, axis=axis)
    last = jax.lax.slice_in_dim(pixels, pixels.shape[axis] - 1, None, axis=axis)
    before = jnp.concatenate([first, jax.lax.slice_in_dim(pixels, 0, -1, axis=axis)], axis)
    after = jnp.concatenate([jax.lax.slice_in_dim(pixels, 1, None, axis=axis), last], axis)
    return pixels + weight * (before + after - 2.0 * pixels)
