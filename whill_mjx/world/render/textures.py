"""Procedural textures: factors on the colour of a surface at (s, t). Elementwise, shared by both renderers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from whill_mjx.world.materials import ATLAS, TEXTURES
from whill_mjx.world.render.visibility import bits_to_float

ALONG, ACROSS, ABOVE = np.uint32(73856093), np.uint32(19349663), np.uint32(83492791)
"""Multipliers of a cell's three numbers, before their bits are mixed."""


def texture(number, s, t, fine, seed, picture=None) -> list:
    """Factors (3 arrays) on red, green and blue.

    Args:
        number: place in TEXTURES, or ATLAS + picture.
        s, t: point of the surface in repeats of the texture; t points up.
        fine: 1 where a repeat is large in the image, towards 0 where a pixel holds much of it; details fade by it.
        seed: uint32 of the instance.
        picture: function (number, s, t) -> three arrays in [0, 1], or None without an atlas.
    """
    column, row = jnp.floor(s), jnp.floor(t)
    x, y = s - column, t - row
    blotch = smooth_noise(s * 2.3, t * 2.3, seed) - 0.5
    grain = smooth_noise(s * 23.0, t * 23.0, seed) - 0.5
    own = random_cell(column, row, 0.0, seed) - 0.5

    flutes = jnp.abs(_wave(t * 26.0)) * 0.10 - 0.05
    tape = jnp.where(jnp.abs(x - 0.5) < 0.06, 0.16, 0.0)
    cardboard = 1.0 + 0.14 * blotch + fine * (flutes + 0.10 * grain) + tape
    grout = _line(x, 0.025) + _line(y, 0.025)
    tiles = 1.0 + 0.10 * own + 0.05 * fine * grain - 0.35 * fine * jnp.minimum(grout, 1.0)
    plank = jnp.floor(t * 5.0)
    tone = random_cell(plank, jnp.floor(s * 0.7 + 0.37 * plank), 3.0, seed) - 0.5
    veins = smooth_noise(s * 2.0 + 7.0 * tone, t * 36.0, seed) - 0.5
    wood = 1.0 + 0.30 * tone + fine * (0.35 * veins - 0.35 * _line(t * 5.0 - plank, 0.05))
    speckle = random_cell(jnp.floor(s * 60.0), jnp.floor(t * 60.0), 1.0, seed) - 0.5
    asphalt = 1.0 + 0.25 * blotch + fine * (0.45 * speckle + 0.2 * grain)
    stain = smooth_noise(s * 0.9, t * 0.9, seed) - 0.5
    joint = jnp.minimum(_line(x, 0.008) + _line(y, 0.008), 1.0)
    concrete = 1.0 + 0.22 * stain + 0.14 * blotch + fine * (0.10 * grain - 0.30 * joint)
    course = jnp.floor(t * 8.0)
    shifted = s * 4.0 + 0.5 * (course - 2.0 * jnp.floor(course * 0.5))
    mortar = jnp.minimum(_line(shifted - jnp.floor(shifted), 0.05) + _line(t * 8.0 - course, 0.10), 1.0)
    burnt = random_cell(jnp.floor(shifted), course, 2.0, seed) - 0.5
    brick = 1.0 + fine * (0.30 * burnt + 0.15 * grain + 0.35 * mortar)

    factor = jnp.ones_like(s)
    patterns = {"cardboard": cardboard, "tiles": tiles, "wood": wood, "asphalt": asphalt, "concrete": concrete,
                "brick": brick}
    for name, pattern in patterns.items():
        factor = jnp.where(number == TEXTURES.index(name), pattern, factor)
    if picture is None:
        return [factor] * 3
    return [jnp.where(number >= ATLAS, value, factor) for value in picture(number - ATLAS, x, y)]


def _wave(x):
    """Triangle wave of period 1 between -1 and 1."""
    return 4.0 * jnp.abs(x - jnp.floor(x) - 0.5) - 1.0


def _line(x, width):
    """1 on a line of half `width` around whole numbers of x in [0, 1]."""
    return jnp.where(jnp.abs(x - 0.5) > 0.5 - width, 1.0, 0.0)


def whole(x):
    """Largest integer not above x, as int32."""
    return jnp.floor(jnp.asarray(x)).astype(jnp.int32)


class Rounding(NamedTuple):
    """How numbers are rounded down: `floor` to a float, `whole` to int32. A GPU has faster ways."""

    floor: Callable
    whole: Callable


EXACT = Rounding(jnp.floor, whole)


def smooth_noise(x, y, seed, how: Any = EXACT):
    """Random number in [0, 1) that varies smoothly from one lattice point to the next; `how` rounds down."""
    a, b = x - how.floor(x), y - how.floor(y)
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    left, under, own = how.whole(x).astype(jnp.uint32) * ALONG, how.whole(y).astype(jnp.uint32) * ACROSS, 5 * ABOVE
    right, over, own = left + ALONG, under + ACROSS, own ^ seed
    low = _between(_random(left ^ under ^ own), _random(right ^ under ^ own), a)
    return _between(low, _between(_random(left ^ over ^ own), _random(right ^ over ^ own), a), b)


def _between(low, high, share):
    return low + share * (high - low)


def random_cell(x, y, z, seed, whole=whole):
    """Random number in [0, 1) of the unit cell around a point; `seed` is uint32, `whole` rounds down to int32."""
    a, b, c = (whole(value).astype(jnp.uint32) for value in (x, y, z))
    return _random((a * ALONG) ^ (b * ACROSS) ^ (c * ABOVE) ^ seed)


def _random(mixed):
    """Number in [0, 1) of a uint32: its mixed bits are the mantissa of a float in [1, 2), which no conversion slows."""
    mixed = (mixed ^ (mixed >> 15)) * np.uint32(0x9E3779B1)
    mixed = (mixed ^ (mixed >> 13)) * np.uint32(0x85EBCA6B)
    return bits_to_float((mixed >> 9).astype(jnp.int32) | np.int32(0x3F800000)) - 1.0
