"""Which primitives a part of the image can show: rectangles on the normalised image plane that hold each primitive.

The rectangles are conservative also for primitives that reach behind the camera, and they are taken before the lens
distorts, so that they hold for every lens.
"""

from __future__ import annotations

from itertools import combinations

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
SIGNS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], np.float32)
EDGES = np.array([(a, b) for a, b in combinations(range(8), 2) if np.abs(SIGNS[a] - SIGNS[b]).sum() == 2])
SHADOW_EDGES = np.concatenate([EDGES, EDGES + 8, np.stack([np.arange(8), np.arange(8) + 8], 1)])
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


Corners = list[tuple[jax.Array, jax.Array, jax.Array]]
"""World x, y and z, each (P,), of every corner: apart, so that XLA makes one elementwise kernel of all that follows."""


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
    corners = []
    for signs in SIGNS:
        point = []
        for row in range(3):
            reach = sum(float(sign) * size * way[row] for sign, size, way in zip(signs, half, ways, strict=True))
            point.append(centre[:, row] + reach)
        corners.append(tuple(point))
    return corners


def upright_bounds(view: View, boxes: Boxes) -> Bounds:
    """Rectangles of upright boxes."""
    return bounds(view, upright_corners(boxes), boxes.mask, EDGES)


def shadow_corners(corners: Corners, sun: jax.Array) -> Corners:
    """The corners, and where the sun throws them on the ground; their hull holds the shadowed space."""
    steep = 1.0 / jnp.maximum(sun[2], LOWEST_SUN)
    thrown = []
    for x, y, z in corners:
        fall = jnp.maximum(z, 0.0) * steep
        thrown.append((x - fall * sun[0], y - fall * sun[1], z - fall * sun[2]))
    return [*corners, *thrown]


def bounds(view: View, corners: Corners, mask: jax.Array, edges: np.ndarray) -> Bounds:
    """Rectangles of convex bodies with these `corners` and `edges` (m, 2) between them; `mask` (P,)."""
    position, rotation = view.position, view.rotation
    camera = []
    for corner in corners:
        way = [corner[row] - position[row] for row in range(3)]
        camera.append([sum(way[row] * rotation[row, axis] for row in range(3)) for axis in range(3)])
    low_u = low_v = near = jnp.full_like(camera[0][2], NOTHING)
    high_u = high_v = -low_u
    for x, y, z in camera:
        inverse = 1.0 / jnp.maximum(z, NEAREST)
        before, u, v = z >= NEAREST, x * inverse, y * inverse
        low_u, high_u = _widen(low_u, high_u, u, before)
        low_v, high_v = _widen(low_v, high_v, v, before)
        near = jnp.where(before, jnp.minimum(near, z), near)
    cut_through = jnp.zeros_like(mask)
    for one, other in edges:
        (x, y, z), (x2, y2, z2) = camera[one], camera[other]
        rise = z2 - z
        share = jnp.clip((NEAREST - z) / jnp.where(jnp.abs(rise) < 1e-9, 1e-9, rise), 0.0, 1.0)
        crosses = (z >= NEAREST) != (z2 >= NEAREST)
        low_u, high_u = _widen(low_u, high_u, (x + share * (x2 - x)) * (1.0 / NEAREST), crosses)
        low_v, high_v = _widen(low_v, high_v, (y + share * (y2 - y)) * (1.0 / NEAREST), crosses)
        cut_through = cut_through | crosses
    near = jnp.where(cut_through, 0.0, near * (1.0 - 1e-5))
    shown = mask & (near < 0.5 * NOTHING)
    empty = (NOTHING, -NOTHING, NOTHING, -NOTHING, NOTHING)
    edges_of = (low_u, high_u, low_v, high_v, near)
    return Bounds(*(jnp.where(shown, value, nothing) for value, nothing in zip(edges_of, empty, strict=True)))


def _widen(low, high, place, used) -> tuple[jax.Array, jax.Array]:
    """An interval that also holds `place`, with some room for rounding."""
    slack = 1e-5 * (1.0 + jnp.abs(place))
    return (
        jnp.where(used, jnp.minimum(low, place - slack), low),
        jnp.where(used, jnp.maximum(high, place + slack), high),
    )


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
