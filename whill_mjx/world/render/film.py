"""What camera and motion do to an image: exposure, white balance, vignetting, noise, motion blur. On request."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Film:
    """Camera of one instance; `plain_film()` changes nothing."""

    exposure: jax.Array  # () factor on all channels
    white_balance: jax.Array  # (3,) factors on red, green and blue
    vignetting: jax.Array  # () share of the light that is lost in the corners
    noise: jax.Array  # () standard deviation of the noise [grey levels of 255]


def plain_film() -> Film:
    """The film that leaves an image as it is."""
    return Film(jnp.ones(()), jnp.ones(3), jnp.zeros(()), jnp.zeros(()))


def develop(image: jax.Array, film: Film, key: jax.Array | None = None) -> jax.Array:
    """Image (H, W, 3) uint8 as the camera gives it.

    Args:
        image: (H, W, 3) uint8.
        film: what the camera does.
        key: random key of the noise; None: no noise.
    """
    height, width, _ = image.shape
    row = (jnp.arange(height) + 0.5) / height - 0.5
    column = (jnp.arange(width) + 0.5) / width - 0.5
    from_middle = 2.0 * (row[:, None] ** 2 + column**2)  # 1 in the corners
    light = film.exposure * (1.0 - film.vignetting * from_middle)
    pixels = image.astype(jnp.float32) * light[..., None] * film.white_balance
    if key is not None:
        pixels = pixels + film.noise * jax.random.normal(key, image.shape)
    return jnp.clip(jnp.round(pixels), 0.0, 255.0).astype(jnp.uint8)


def motion_blur(
    draw: Callable[[jax.Array, jax.Array], jax.Array],
    start: tuple[jax.Array, jax.Array],
    end: tuple[jax.Array, jax.Array],
    samples: int = 4,
) -> jax.Array:
    """Mean image (H, W, 3) uint8 of a camera that moves while the shutter is open.

    Args:
        draw: position (3,) and rotation (3, 3) -> image (H, W, 3) uint8, for example `render` with its other arguments.
        start, end: position and rotation when the shutter opens and closes; turned by less than a quarter turn.
        samples: images that are averaged.
    """
    share = (jnp.arange(samples) + 0.5) / samples

    def one(part):
        position = start[0] + part * (end[0] - start[0])
        return draw(position, _orthonormal(start[1] + part * (end[1] - start[1]))).astype(jnp.float32)

    return jnp.round(jnp.mean(jax.lax.map(one, share), 0)).astype(jnp.uint8)


def _orthonormal(matrix: jax.Array) -> jax.Array:
    """The rotation near a matrix (3, 3), by Gram-Schmidt on its columns."""
    first = matrix[:, 0] / jnp.linalg.norm(matrix[:, 0])
    second = matrix[:, 1] - jnp.dot(first, matrix[:, 1]) * first
    second = second / jnp.linalg.norm(second)
    return jnp.stack([first, second, jnp.cross(first, second)], 1)
