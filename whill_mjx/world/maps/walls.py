"""Walls that stand around a vehicle: which of them a ray meets, which a camera sees, and boxes to draw them.

All are pure functions of one instance in JAX. A wall is a segment with the free space to the left of its way; it counts
as high as the camera looks.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.render.camera import Intrinsics
from whill_mjx.world.scene import Boxes, MapWalls, Scene

SHOWN = 40
"""Walls that an image shows at most: in four real maps, 0.05 % of the columns of 64 see others."""
SQUARE, NEAR = 0.5, 1.2
"""Edge of the squares that have lists of their walls, and how near a wall has to be: a wheelchair and a step [m]."""
THICKNESS = 0.002
"""Depth of a drawn wall, behind its face [m]."""


def cast(segments: jax.Array, x, y, angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance (R,) [m] to the first of the walls (S, 2, 2) along each ray, inf without one, and its index (R,).

    The rays begin at one place x, y, or each at its own, (R, 1).
    """
    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    along, across = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]  # (R, 1)
    px, py = start[:, 0] - x, start[:, 1] - y
    turn = along * way[:, 1] - across * way[:, 0]  # (R, S)
    turn = jnp.where(jnp.abs(turn) < 1e-9, 1e-9, turn)
    distance = (px * way[:, 1] - py * way[:, 0]) / turn
    share = (px * across - py * along) / turn
    met = (share >= -1e-5) & (share <= 1.0 + 1e-5) & (distance >= 0.0)  # no ray slips through a corner
    distance = jnp.where(met, distance, jnp.inf)
    index = jnp.argmin(distance, -1)
    return jnp.min(distance, -1), index


def most_seen(index: jax.Array, keep: int) -> tuple[jax.Array, jax.Array]:
    """The `keep` numbers that occur most often among (R,) ones, each once, and which of them (keep,) are such."""
    ordered = jnp.sort(index)
    first = jnp.concatenate([jnp.ones(1, bool), ordered[1:] != ordered[:-1]])
    count = jnp.sum(ordered[:, None] == ordered, -1)
    keep_now = min(keep, index.shape[0])
    seen, place = jax.lax.top_k(jnp.where(first, count, 0), keep_now)
    rest = keep - keep_now
    return jnp.pad(ordered[place], (0, rest)), jnp.pad(seen > 0, (0, rest))


def wall_boxes(segments: jax.Array, index: jax.Array, mask: jax.Array, height, colour) -> Boxes:
    """Walls `index` (K,) of (S, 2, 2) as thin boxes behind their faces; each has a shade of its own."""
    start, end = segments[index, 0], segments[index, 1]
    way = end - start
    length = jnp.maximum(jnp.linalg.norm(way, axis=-1), 1e-6)
    direction = way / length[:, None]
    right = jnp.stack([direction[:, 1], -direction[:, 0]], -1)
    middle = (start + end) / 2 + right * THICKNESS / 2
    count = index.shape[0]
    shade = 0.88 + 0.12 * ((index * 40503) % 64) / 63.0
    return Boxes(
        centre=jnp.concatenate([middle, jnp.full((count, 1), height / 2)], -1),
        half=jnp.stack([length / 2, jnp.full(count, THICKNESS / 2), jnp.full(count, height / 2)], -1),
        yaw=jnp.arctan2(direction[:, 1], direction[:, 0]),
        colour=shade[:, None] * jnp.asarray(colour, jnp.float32),
        mask=mask,
    )


def nearest_walls(segments: jax.Array, x, y, count: int, height: float = 2.0, colour=(0.78, 0.76, 0.72)) -> Boxes:
    """The `count` walls (S, 2, 2) nearest to a point as boxes; fewer than `count` leave unused boxes."""
    used = min(count, segments.shape[0])
    _, index = jax.lax.top_k(-distances_to(segments, x, y), used)
    index = jnp.pad(index, (0, count - used))
    return wall_boxes(segments, index, jnp.arange(count) < used, height, colour)


def distances_to(segments: jax.Array, x, y) -> jax.Array:
    """(S,) m: distance of a point from each wall (S, 2, 2)."""
    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    square = jnp.maximum(jnp.sum(way**2, -1), 1e-12)
    share = jnp.clip(((x - start[:, 0]) * way[:, 0] + (y - start[:, 1]) * way[:, 1]) / square, 0.0, 1.0)
    return jnp.hypot(start[:, 0] + share * way[:, 0] - x, start[:, 1] + share * way[:, 1] - y)


def column_angles(rotation: jax.Array, intrinsics: Intrinsics, width: int) -> jax.Array:
    """(width,) rad: bearing in the world of the horizon's point in each column of an image, without lens distortion."""
    u = (jnp.arange(width) + 0.5 - intrinsics.cx) / intrinsics.fx
    # On the horizon a ray has no height: z = R[2,0] u + R[2,1] v + R[2,2] = 0.
    down = jnp.where(jnp.abs(rotation[2, 1]) < 1e-6, 1e-6, rotation[2, 1])
    v = -(rotation[2, 0] * u + rotation[2, 2]) / down
    x, y = (rotation[row, 0] * u + rotation[row, 1] * v + rotation[row, 2] for row in range(2))
    return jnp.arctan2(y, x)


def shown(scene: Scene, position: jax.Array, rotation: jax.Array, intrinsics: Intrinsics, width: int) -> Scene:
    """The scene with the walls of its map that this camera sees, in place of its last `keep` boxes.

    One ray per image column, along the horizon, finds the nearest wall; a scene without a map stays as it is.
    """
    walls = scene.walls
    if walls is None:
        return scene
    segments = jnp.asarray(walls.segments)
    _, index = cast(segments, position[0], position[1], column_angles(rotation, intrinsics, width))
    index, mask = most_seen(index, walls.keep)
    fixed = scene.boxes.mask.shape[0] - walls.keep
    drawn = wall_boxes(segments, index, mask, walls.height, scene.boxes.colour[fixed])
    boxes = jax.tree.map(lambda all_of, new: all_of.at[fixed:].set(new), scene.boxes, drawn)
    return dataclasses.replace(scene, boxes=boxes)


def map_walls(segments: np.ndarray, keep: int = SHOWN, height: float = 2.2) -> MapWalls:
    """Walls (S, 2, 2) [m] of a map, of which an image shows `keep` at most, with the lists of those within reach.

    A list holds every wall within `NEAR` of any place in its square; the lists are as long as the longest of them.
    """
    segments = np.asarray(segments, np.float32)
    low = segments.reshape(-1, 2).min(0) - NEAR
    columns, rows = np.ceil((segments.reshape(-1, 2).max(0) + NEAR - low) / SQUARE).astype(int)
    lists: list[list[int]] = [[] for _ in range(rows * columns)]
    corner = SQUARE * np.array([[0.5, 0.5]])
    reach = NEAR + SQUARE * 0.5**0.5
    for number, (start, end) in enumerate(segments.astype(float)):
        first = np.maximum(np.floor((np.minimum(start, end) - low - NEAR) / SQUARE).astype(int), 0)
        last = np.minimum(np.floor((np.maximum(start, end) - low + NEAR) / SQUARE).astype(int), [columns - 1, rows - 1])
        spans = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
        column, row = (axis.ravel() for axis in np.meshgrid(*spans))
        centre = low + np.column_stack([column, row]) * SQUARE + corner
        way = end - start
        share = np.clip(((centre - start) @ way) / max(way @ way, 1e-12), 0.0, 1.0)
        close = np.hypot(*(start + share[:, None] * way - centre).T) <= reach
        for place in (row * columns + column)[close]:
            lists[place].append(number)
    near = np.full((len(lists), max(map(len, lists))), -1, np.int32)
    for place, numbers in enumerate(lists):
        near[place, : len(numbers)] = numbers
    return MapWalls(segments, keep, height, near, (float(low[0]), float(low[1])), SQUARE, (int(rows), int(columns)))
