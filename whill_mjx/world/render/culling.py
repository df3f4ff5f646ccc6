"""Which primitives a part of the image can show: rectangles on the normalised image plane that hold each primitive.

The rectangles are conservative also for primitives that reach behind the camera, and they are taken before the lens
distorts, so that they hold for every lens.
"""

from __future__ import annotations

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.render.shading import View
from whill_mjx.world.scene import Boxes
from whill_mjx.world.solids import Blocks, Rounds, across

NEAREST = 1e-3
"""Depth at which primitives that reach behind the camera are cut off [m]."""
NOTHING = 1e9
"""Edge of an empty rectangle, and depth of what cannot be seen."""
LOWEST_SUN = 0.05
"""Shadows on the ground are as long as those of a sun this high at least (sine of its height)."""


@struct.dataclass
class Bounds:
    """Rectangles of P primitives, arrays (P,); one that cannot be seen is empty and at depth NOTHING."""

    low_u: jax.Array
    high_u: jax.Array
    low_v: jax.Array
    high_v: jax.Array
    near: jax.Array  # m: no point of it has less depth


WIDER = (jnp.minimum, jnp.maximum) * 2
"""Of two rectangles' sides, in the order of `Bounds`."""

Corners = tuple[jax.Array, jax.Array, jax.Array]
"""World x, y and z of the corners of P bodies, each (2, ..., 2, P): corners whose places differ in one of the axes of
size 2 are joined by an edge."""


def upright_corners(boxes: Boxes) -> Corners:
    """Eight corners of upright boxes."""
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    zero = jnp.zeros_like(c)
    ways = [(c, s, zero), (-s, c, zero), (zero, zero, zero + 1.0)]
    return _corners(boxes.centre, ways, [boxes.half[:, axis] for axis in range(3)])


def block_corners(blocks: Blocks) -> Corners:
    """Eight corners of blocks."""
    ways = [tuple(blocks.rotation[:, row, axis] for row in range(3)) for axis in range(3)]
    return _corners(blocks.centre, ways, [blocks.half[:, axis] for axis in range(3)])


def round_corners(rounds: Rounds) -> Corners:
    """Eight corners of the box around each round: square to the axis, as long as the round with its ends."""
    axis, one = rounds.axis, across(rounds.axis)
    other = jnp.cross(axis, one)
    long = rounds.half + jnp.where(rounds.capsule, rounds.radius, 0.0)
    ways = [tuple(way[:, row] for row in range(3)) for way in (one, other, axis)]
    return _corners(rounds.centre, ways, [rounds.radius, rounds.radius, long])


def _corners(centre, ways, half) -> Corners:
    signs = [np.array([-1.0, 1.0], np.float32).reshape(shape) for shape in ((2, 1, 1, 1), (2, 1, 1), (2, 1))]

    def along(row: int) -> jax.Array:
        reach = [sign * size * way[row] for sign, size, way in zip(signs, half, ways, strict=True)]
        return centre[:, row] + reach[0] + reach[1] + reach[2]

    return along(0), along(1), along(2)


def upright_bounds(view: View, boxes: Boxes) -> Bounds:
    """Rectangles of upright boxes."""
    return bounds(view, upright_corners(boxes), boxes.mask)


def shadow_corners(corners: Corners, sun: jax.Array) -> Corners:
    """The corners, and where the sun throws them on the ground; their hull holds the shadowed space."""
    x, y, z = corners
    thrown = np.array([0.0, 1.0], np.float32).reshape(2, *[1] * z.ndim)
    fall = thrown * jnp.maximum(z, 0.0) * (1.0 / jnp.maximum(sun[2], LOWEST_SUN))
    return x - fall * sun[0], y - fall * sun[1], z - fall * sun[2]


def bounds(view: View, corners: Corners, mask: jax.Array) -> Bounds:
    """Rectangles of convex bodies with these `corners`; `mask` (P,).

    Corners are axes of arrays, reduced in loops. Written out one by one, they became one kernel of two minutes to
    compile.
    """
    way = [place - origin for place, origin in zip(corners, view.position, strict=True)]
    x, y, z = (sum(way[row] * view.rotation[row, axis] for row in range(3)) for axis in range(3))
    ways = tuple(range(z.ndim - 1))
    inverse, before = 1.0 / jnp.maximum(z, NEAREST), z >= NEAREST
    sides = [_sides(x * inverse, y * inverse, before)]
    cut_through = jnp.zeros_like(mask)
    for axis in ways:
        (x1, x2), (y1, y2), (z1, z2) = (_ends(place, axis) for place in (x, y, z))
        rise = z2 - z1
        share = jnp.clip((NEAREST - z1) / jnp.where(jnp.abs(rise) < 1e-9, 1e-9, rise), 0.0, 1.0)
        crosses = (z1 >= NEAREST) != (z2 >= NEAREST)
        u, v = ((one + share * (other - one)) * (1.0 / NEAREST) for one, other in ((x1, x2), (y1, y2)))
        sides.append(_sides(u, v, crosses))
        cut_through = cut_through | crosses.any(ways[:-1])
    near = jnp.where(before, z, NOTHING).min(ways)
    near = jnp.where(cut_through, 0.0, near * (1.0 - 1e-5))
    shown = mask & (near < 0.5 * NOTHING)
    empty = (NOTHING, -NOTHING, NOTHING, -NOTHING, NOTHING)
    widest = [reduce(pick, every) for pick, every in zip(WIDER, zip(*sides, strict=True), strict=True)]
    return Bounds(*(jnp.where(shown, value, nothing) for value, nothing in zip([*widest, near], empty, strict=True)))


def _ends(places: jax.Array, axis: int) -> tuple[jax.Array, jax.Array]:
    """Both ends of the edges along an axis of size 2."""
    return jax.lax.index_in_dim(places, 0, axis, False), jax.lax.index_in_dim(places, 1, axis, False)


def _sides(u: jax.Array, v: jax.Array, used: jax.Array) -> tuple[jax.Array, ...]:
    """Smallest and largest u, then v, of the used ones of places (2, ..., 2, P), with some room for rounding."""
    sides = []
    for place in (u, v):
        slack = 1e-5 * (1.0 + jnp.abs(place))
        sides.append(jnp.where(used, place - slack, NOTHING).min(range(place.ndim - 1)))
        sides.append(jnp.where(used, place + slack, -NOTHING).max(range(place.ndim - 1)))
    return tuple(sides)


def strip_lists(boxes: Bounds, view: View, strips: int, keep: int) -> jax.Array:
    """(strips, keep) int32: the nearest boxes that each upright strip of the image can show; -1 is none.

    With a distorting lens the whole image is one strip.
    """
    size = -(-view.intrinsics.width // strips)
    edges = jnp.arange(strips + 1) * float(size)
    left, right = edges[:-1], edges[1:]
    intrinsics = view.intrinsics
    low, high = ((edge - intrinsics.cx) / intrinsics.fx for edge in (left, right))
    if intrinsics.distortion is not None:
        low, high = jnp.full_like(low, -NOTHING), jnp.full_like(high, NOTHING)
    shown = (boxes.low_u <= high[:, None]) & (boxes.high_u >= low[:, None]) & (boxes.near < NOTHING)
    near = jnp.where(shown, boxes.near, NOTHING)  # (strips, P)
    value, place = jax.lax.top_k(-near, keep)
    return jnp.where(value > -NOTHING, place, -1)
