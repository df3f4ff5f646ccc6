"""Pieces of worlds: random numbers, walls, markers and colours."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.world.scene import BLUE as BLUE
from whill_mjx.world.scene import CARDBOARD as CARDBOARD
from whill_mjx.world.scene import WALL as WALL
from whill_mjx.world.scene import Boxes, Marker, box, stack_boxes

OBSTACLES = ((0.78, 0.20, 0.16), (0.88, 0.58, 0.14), (0.26, 0.55, 0.24), (0.66, 0.46, 0.28))


AT_ONCE = 32
"""Numbers that are drawn together: one by one, each would be a hundred operations to compile."""


class Draws:
    """Uniform numbers from one key, each from its own; without a key every draw gives its fixed value."""

    def __init__(self, key: jax.Array | None):
        self.key, self.count = key, 0
        self.numbers = jnp.zeros(0)

    def __call__(self, low: float, high: float, fixed: float) -> jax.Array:
        if self.key is None:
            return jnp.asarray(fixed, float)
        if self.count % AT_ONCE == 0:
            key, places = self.key, jnp.arange(self.count + 1, self.count + 1 + AT_ONCE)
            self.numbers = jax.vmap(lambda place: jax.random.uniform(jax.random.fold_in(key, place)))(places)
        number = self.numbers[self.count % AT_ONCE]
        self.count += 1
        return low + (high - low) * number

    def sign(self) -> jax.Array:
        """-1 or 1; 1 when fixed."""
        return jnp.where(self(0.0, 1.0, fixed=1.0) < 0.5, -1.0, 1.0)


def lane(half_width: jax.Array, end_x: float) -> tuple[Boxes, Boxes, Boxes]:
    """Left, right and far wall of a lane that begins 2 m behind the start."""
    thickness, height, begin_x = 0.2, 2.0, -2.0
    middle, length = (begin_x + end_x) / 2, end_x - begin_x
    aside = half_width + thickness / 2
    colour, dark = jnp.array(WALL), 0.85 * jnp.array(WALL)
    return (
        box(middle, aside, length, thickness, height, colour),
        box(middle, -aside, length, thickness, height, colour),
        box(end_x, 0.0, thickness, 2 * half_width + 2 * thickness, height, dark),
    )


def room(half: float, height: float = 2.0) -> Boxes:
    """Four walls around a square of 2 `half` m, centred at the origin."""
    thickness, colour, dark = 0.2, jnp.array(WALL), 0.85 * jnp.array(WALL)
    aside, length = half + thickness / 2, 2 * half + 2 * thickness
    return stack_boxes([
        box(0.0, aside, length, thickness, height, colour),
        box(0.0, -aside, length, thickness, height, colour),
        box(aside, 0.0, thickness, length, height, dark),
        box(-aside, 0.0, thickness, length, height, dark),
    ])


def make_marker(x: Any, y: Any, size: float, height: Any, yaw: Any = None) -> Marker:
    """Blue square of edge `size`, its centre `height` above the ground; it faces -x at yaw 0."""
    position = jnp.stack([jnp.asarray(value, float) for value in (x, y, height)])
    yaw = jnp.zeros(()) if yaw is None else jnp.asarray(yaw, float)
    return Marker(position, jnp.array([0.02, size / 2, size / 2]), yaw, jnp.array(BLUE))
