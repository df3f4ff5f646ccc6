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

from whill_mjx.render.camera import pixel_rays
from whill_mjx.render.shading import View
from whill_mjx.scene import Boxes
from whill_mjx.solids import Blocks, Rounds

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


def upright_corners(boxes: Boxes) -> jax.Array:
    """(P, 8, 3) corners of upright boxes in the world."""
    c, s = jnp.cos(boxes.yaw)[:, None], jnp.sin(boxes.yaw)[:, None]
    x, y, z = (boxes.half[:, axis, None] * SIGNS[:, axis] for axis in range(3))
    return boxes.centre[:, None] + jnp.stack([c * x - s * y, s * x + c * y, z], -1)


def block_corners(blocks: Blocks) -> jax.Array:
    """(K, 8, 3) corners of blocks in the world."""
    own = blocks.half[:, None] * SIGNS
    return blocks.centre[:, None] + jnp.einsum("kij,kcj->kci", blocks.rotation, own, precision="highest")


def round_corners(rounds: Rounds) -> jax.Array:
    """(K, 8, 3) corners of the box around each round: square to the axis, as long as the round with its ends."""
    axis = rounds.axis
    helper = jnp.where(jnp.abs(axis[:, :1]) < 0.9, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    one = jnp.cross(axis, helper)
    one = one / jnp.linalg.norm(one, axis=1, keepdims=True)
    long = rounds.half + jnp.where(rounds.capsule, rounds.radius, 0.0)
    ways = jnp.stack([one, jnp.cross(axis, one), axis], 2)  # (K, 3, way)
    own = jnp.stack([rounds.radius, rounds.radius, long], 1)[:, None] * SIGNS
    return rounds.centre[:, None] + jnp.einsum("kij,kcj->kci", ways, own, precision="highest")


def upright_bounds(view: View, boxes: Boxes) -> Bounds:
    """Rectangles of upright boxes."""
    return bounds(view, upright_corners(boxes), boxes.mask, EDGES)


def shadow_corners(corners: jax.Array, sun: jax.Array) -> jax.Array:
    """(P, 16, 3): the corners, and where the sun throws them on the ground; their hull holds the shadowed space."""
    height = jnp.maximum(corners[..., 2:], 0.0)
    fall = height / jnp.maximum(sun[2], LOWEST_SUN)
    return jnp.concatenate([corners, corners - fall * sun], 1)


def bounds(view: View, corners: jax.Array, mask: jax.Array, edges: np.ndarray) -> Bounds:
    """Rectangles of convex bodies given by `corners` (P, n, 3) in the world and `edges` (m, 2) between them."""
    camera = jnp.matmul(corners - view.position, view.rotation, precision="highest")
    one, other = camera[:, edges[:, 0]], camera[:, edges[:, 1]]
    rise = other[..., 2] - one[..., 2]
    share = (NEAREST - one[..., 2]) / jnp.where(jnp.abs(rise) < 1e-9, 1e-9, rise)
    crossing = (one[..., 2] - NEAREST) * (other[..., 2] - NEAREST) < 0
    cut = one + jnp.clip(share, 0.0, 1.0)[..., None] * (other - one)
    points = jnp.concatenate([camera, cut], 1)
    used = jnp.concatenate([camera[..., 2] >= NEAREST, crossing], 1) & mask[:, None]
    depth = jnp.maximum(points[..., 2], NEAREST)
    margin = 1e-5  # rounding
    low, high = [], []
    for axis in range(2):
        place = points[..., axis] / depth
        slack = margin * (1.0 + jnp.abs(place))
        low.append(jnp.min(jnp.where(used, place - slack, NOTHING), 1))
        high.append(jnp.max(jnp.where(used, place + slack, -NOTHING), 1))
    behind = jnp.any(camera[..., 2] < NEAREST, 1)
    near = jnp.min(jnp.where(used, points[..., 2], NOTHING), 1)
    near = jnp.where(behind & (near < NOTHING), 0.0, near * (1.0 - 1e-5))
    return Bounds(low[0], high[0], low[1], high[1], near)


def field_of_view(view: View, height: int, width: int) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Smallest and largest u, then v, of an image, from the pixels of its border."""
    rows, columns = jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32)
    rim_row = jnp.concatenate([jnp.zeros(width), jnp.full(width, height - 1.0), rows, rows])
    rim_column = jnp.concatenate([columns, columns, jnp.zeros(height), jnp.full(height, width - 1.0)])
    points = [pixel_rays(view.intrinsics, rim_row, rim_column, shift) for shift in ((0, 0), (0, 1), (1, 0), (1, 1))]
    u, v = (jnp.concatenate(values) for values in zip(*points, strict=True))
    return u.min(), u.max(), v.min(), v.max()


def strip_lists(boxes: Bounds, view: View, width: int, strips: int, keep: int) -> jax.Array:
    """(strips, keep) int32: the nearest boxes that each upright strip of the image can show; -1 is none.

    With a distorting lens the whole image is one strip.
    """
    size = -(-width // strips)
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
