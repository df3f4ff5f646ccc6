"""The paper's photometric randomisation of camera images: drawn once per episode, the noise anew in each frame."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


@dataclass(frozen=True)
class AugmentRanges:
    """Ranges of the reference paper's domain randomisation."""

    brightness: tuple[float, float] = (0.8, 1.3)
    """Factor on all channels."""
    contrast: tuple[float, float] = (0.8, 1.2)
    """Factor on the difference from the mean grey level of the image."""
    hue: tuple[float, float] = (-0.1, 0.1)
    """Turn of the hue [full turns]."""
    saturation: tuple[float, float] = (0.8, 1.2)
    """Factor on the difference from the pixel's own grey level."""
    noise: tuple[float, float] = (0.0, 5.0)
    """Standard deviation of the Gaussian noise [grey levels of 255]."""


@struct.dataclass
class Photometry:
    """Photometric change of one episode; `neutral()` changes nothing."""

    brightness: jax.Array  # ()
    contrast: jax.Array  # ()
    hue: jax.Array  # () full turns
    saturation: jax.Array  # ()
    noise: jax.Array  # () grey levels


def neutral() -> Photometry:
    """The change that leaves an image as it is."""
    one, zero = jnp.ones(()), jnp.zeros(())
    return Photometry(one, one, zero, one, zero)


def draw_photometry(key: jax.Array, ranges: AugmentRanges | None = None) -> Photometry:
    """Change of one episode, each value uniform in its range."""
    ranges = ranges or AugmentRanges()
    names = ("brightness", "contrast", "hue", "saturation", "noise")
    low, high = jnp.array([getattr(ranges, name) for name in names], float).T
    numbers = jax.vmap(jax.random.uniform)(jax.random.split(key, len(names)))
    return Photometry(*(low + (high - low) * numbers))


def augment(image: jax.Array, change: Photometry, key: jax.Array) -> jax.Array:
    """Image (H, W, 3) uint8 after brightness, contrast, saturation, hue and noise, in this order.

    The hue is turned about the grey axis in YIQ space: linear, so that it needs no branch per pixel.
    """
    pixels = image.astype(jnp.float32) * change.brightness
    mean = jnp.mean(pixels @ GREY)
    pixels = mean + change.contrast * (pixels - mean)
    pixels = pixels @ colour_matrix(change).T
    pixels = pixels + change.noise * jax.random.normal(key, image.shape)
    return jnp.clip(jnp.round(pixels), 0.0, 255.0).astype(jnp.uint8)


GREY = np.array([0.299, 0.587, 0.114], np.float32)
TO_YIQ = np.array([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]], np.float32)


def colour_matrix(change: Photometry) -> jax.Array:
    """(3, 3) matrix on RGB that turns the hue and scales the saturation; greys stay as they are."""
    angle = 2.0 * jnp.pi * change.hue
    c, s = change.saturation * jnp.cos(angle), change.saturation * jnp.sin(angle)
    zero, one = jnp.zeros(()), jnp.ones(())
    turn = jnp.stack([jnp.stack([one, zero, zero]), jnp.stack([zero, c, -s]), jnp.stack([zero, s, c])])
    return jnp.asarray(np.linalg.inv(TO_YIQ)) @ turn @ TO_YIQ
