"""Walls that stand around a vehicle: which of them a ray meets, which a camera sees, and boxes to draw them.

All are pure functions of one instance in JAX. A wall is a segment with the free space to the left of its way; it counts
as high as the camera looks.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.vehicle.specs import CameraMount
from whill_mjx.world.render.camera import Intrinsics
from whill_mjx.world.scene import WALL, Boxes, MapWalls, Scene

CLOSE = 1e-3
"""Depth at which a wall beside the camera is cut off [m]."""
MOST = 2048
"""Walls in one reduction; more are met in several. In a training on ten maps, which have seven thousand walls together,
XLA compiled one reduction for more than a quarter of an hour on a GPU."""
UNROLL = 16
"""Walls tested in one round of a loop."""
SHOWN = 40
"""Walls that an image shows at most: in four real maps, 0.05 % of the columns of 64 see others."""
SQUARE, NEAR = 0.5, 1.2
"""Edge of the squares that have lists of their walls, and how near a wall has to be for a wheelchair [m]; for other
vehicles `whill_mjx.world.maps.places.reach_of` says it."""
BESIDE, WIDEST = 8, 6.0
"""Rays beyond the horizon's on each side of an image, and their largest slope to the camera's heading: 80 degrees."""
THICKNESS = 0.002
"""Depth of a drawn wall, behind its face [m]."""


def cast(segments: jax.Array, x, y, angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance (R,) [m] to the first of the walls (S, 2, 2) along each ray, inf without one, and its index (R,).

    The rays begin at one place x, y, or each at its own, (R, 1).
    """
    count = segments.shape[0]
    if count <= MOST:
        return _cast(segments, x, y, angles)
    size = -(-count // -(-count // MOST))  # the last block may share walls with the one before

    def block(number: jax.Array, best: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        first = jnp.minimum(number * size, count - size)
        distance, index = _cast(jax.lax.dynamic_slice_in_dim(segments, first, size), x, y, angles)
        nearer = distance < best[0]
        return jnp.where(nearer, distance, best[0]), jnp.where(nearer, index + first, best[1])

    none = jnp.full(angles.shape, jnp.inf), jnp.zeros(angles.shape, jnp.int32)
    return jax.lax.fori_loop(0, -(-count // size), block, none)


def _cast(segments: jax.Array, x, y, angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    distance = _to_wall(segments[:, 0].T, segments[:, 1].T, x, y, (jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]))
    return jnp.min(distance, -1), jnp.argmin(distance, -1).astype(jnp.int32)


def _to_wall(start: Any, end: Any, x: Any, y: Any, ray: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Distance [m] along rays of a direction (x, y) to walls from start to end (x, y), inf where one is missed."""
    along, across = ray
    way_x, way_y, px, py = end[0] - start[0], end[1] - start[1], start[0] - x, start[1] - y
    turn = along * way_y - across * way_x
    edge = jnp.abs(turn) < 1e-9  # it is seen end on: the wall around its corner is met
    turn = jnp.where(edge, 1e-9, turn)
    distance = (px * way_y - py * way_x) / turn
    share = (px * across - py * along) / turn
    met = ~edge & (share >= -1e-5) & (share <= 1.0 + 1e-5) & (distance >= 0.0)  # no ray slips through a corner
    return jnp.where(met, distance, jnp.inf)


def to_first_wall(segments: jax.Array, x: jax.Array, y: jax.Array, angles: jax.Array) -> jax.Array:
    """Distance (R,) [m] to the first of the walls (S, 2, 2) along each ray from x, y (R,), inf without one.

    The walls are taken in rounds: with an array of rays by walls, XLA compiled 16,384 scanners of 360 rays for more
    than five minutes on a GPU.
    """
    rounds = max(2, -(-segments.shape[0] // UNROLL))  # XLA unrolls a loop of one round
    rest = jnp.zeros((rounds * UNROLL - segments.shape[0], 2, 2))  # a wall without length is never met
    table = jnp.concatenate([segments, rest])
    ray = jnp.cos(angles), jnp.sin(angles)

    def one_round(number: jax.Array, nearest: jax.Array) -> jax.Array:
        part = jax.lax.dynamic_slice_in_dim(table, number * UNROLL, UNROLL)
        for start, end in part:
            nearest = jnp.minimum(nearest, _to_wall(start, end, x, y, ray))
        return nearest

    return jax.lax.fori_loop(0, rounds, one_round, jnp.full(angles.shape, jnp.inf))


def first_walls(segments: jax.Array, x: jax.Array, y: jax.Array, angles: jax.Array) -> jax.Array:
    """Index (R,) int32 of the wall that each ray from a place x, y meets first, for the columns of an image.

    A processor takes the walls in rounds, of which XLA makes one loop, with bearings as slopes: less than half a turn
    may lie between the rays. Of two of S walls whose distances differ by less than S / 4,000,000 of them it may take
    either.
    """

    def in_rounds(segments, x, y, angles):
        facing = jnp.arctan2(jnp.sin(angles).sum(), jnp.cos(angles).sum())
        slopes = jnp.tan(angles - facing)
        bits = max(1, (segments.shape[0] - 1).bit_length())
        table = _by_slope(segments, x, y, facing)
        rounds = max(2, -(-segments.shape[0] // UNROLL))  # XLA unrolls a loop of one round
        unseen = jnp.array([jnp.inf, -jnp.inf, 0.0, 0.0, 0.0])
        rest = jnp.broadcast_to(unseen, (rounds * UNROLL - segments.shape[0], 5))
        table = jax.lax.optimization_barrier(jnp.concatenate([table, rest]))

        def one_round(number, key):
            part = jax.lax.dynamic_slice(table, (number * UNROLL, 0), (UNROLL, 5))
            for row in range(UNROLL):
                low, high, slope, near, change = part[row]
                word = jax.lax.bitcast_convert_type(near + change * (slopes - slope), jnp.int32)
                word = (word & ~((1 << bits) - 1)) | (number * UNROLL + row)
                key = jnp.maximum(key, jnp.where((slopes >= low) & (slopes <= high), word, 0))
            return key

        key = jax.lax.fori_loop(0, rounds, one_round, jnp.zeros(angles.shape, jnp.int32))
        return key & ((1 << bits) - 1)

    def at_once(segments, x, y, angles):
        return cast(segments, x, y, angles)[1].astype(jnp.int32)

    return jax.lax.platform_dependent(segments, x, y, angles, cpu=in_rounds, default=at_once)


def _by_slope(segments: jax.Array, x: jax.Array, y: jax.Array, facing: jax.Array) -> jax.Array:
    """Walls (S, 5) as a place sees them that looks along `facing`: where slopes begin and end, and inverse depth.

    The inverse depth is even in the slope, the bearing's tangent: `near + change * (its slope - slope)`.
    """
    off = segments - jnp.stack([x, y])
    c, s = jnp.cos(facing), jnp.sin(facing)
    deep, aside = off[..., 0] * c + off[..., 1] * s, off[..., 1] * c - off[..., 0] * s  # (S, 2)
    rise = deep[:, 1] - deep[:, 0]
    share = jnp.clip((CLOSE - deep[:, 0]) / jnp.where(jnp.abs(rise) < 1e-9, 1e-9, rise), 0.0, 1.0)
    cut = (aside[:, 0] + share * (aside[:, 1] - aside[:, 0]))[:, None]  # where a wall passes beside the place
    behind = deep < CLOSE
    near = 1.0 / jnp.where(behind, CLOSE, deep)
    slope = jnp.where(behind, cut, aside) * near
    seen = ~behind.all(1)
    low, high = jnp.where(seen, slope.min(1), jnp.inf), jnp.where(seen, slope.max(1), -jnp.inf)
    width = slope[:, 1] - slope[:, 0]
    edge = jnp.abs(width) < 1e-9  # it is seen end on
    change = jnp.where(edge, 0.0, (near[:, 1] - near[:, 0]) / jnp.where(edge, 1.0, width))
    return jnp.stack([low, high, slope[:, 0], near[:, 0], change], -1)


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


def nearest_walls(segments: jax.Array, x, y, count: int, height: float = 2.0, colour=WALL) -> Boxes:
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


def sees_behind(mount: CameraMount, height: int, width: int) -> bool:
    """Whether an image of this size shows what lies behind the place of a camera whose vehicle stands level.

    It does where the ray of its lowest or highest corner leans beyond the vertical.
    """
    reach = math.tan(mount.fov_y / 2) * (abs(math.cos(mount.roll)) + width / height * abs(math.sin(mount.roll)))
    return abs(math.sin(mount.pitch)) * reach > abs(math.cos(mount.pitch))


def all_around(heading: jax.Array, width: int) -> jax.Array:
    """(3, width) rad: bearings of thirds of a full turn, evenly spaced; the heading is in the middle of the first."""
    share = (jnp.arange(width) + 0.5) / width - 0.5
    return heading + 2 * jnp.pi / 3 * (jnp.array([0.0, 1.0, -1.0])[:, None] + share)


def bearings(rotation: jax.Array, intrinsics: Intrinsics) -> jax.Array:
    """(width + 2 BESIDE,) rad: bearings in the world of all that an image shows, without lens distortion.

    Those of the horizon's points, and those that lie beyond them on both sides: a camera that looks down sees more
    aside at its lower edge than on the horizon. At most `WIDEST` to either side of its heading.
    """
    level = horizon_angles(rotation, intrinsics)
    u = (jnp.array([0.0, intrinsics.width]) - intrinsics.cx) / intrinsics.fx
    v = (jnp.array([0.0, intrinsics.height]) - intrinsics.cy) / intrinsics.fy
    corner = rotation[:2, 0] * u[:, None, None] + rotation[:2, 1] * v[:, None] + rotation[:2, 2]  # (2, 2, 2)
    c, s = _heading(rotation)
    deep, aside = corner[..., 0] * c + corner[..., 1] * s, corner[..., 1] * c - corner[..., 0] * s
    slope = jnp.clip(aside / jnp.maximum(deep, 1e-6), -WIDEST, WIDEST)
    heading, share = jnp.arctan2(s, c), (jnp.arange(BESIDE) + 1.0) / BESIDE
    edges = jnp.clip(jnp.tan(level[jnp.array([0, -1])] - heading), -WIDEST, WIDEST)
    edges = jnp.stack([edges.max(), edges.min()])  # to the left, to the right
    ends = jnp.stack([jnp.maximum(slope.max(), edges[0]), jnp.minimum(slope.min(), edges[1])])
    beyond = edges[:, None] + (ends - edges)[:, None] * share
    return jnp.concatenate([level, (heading + jnp.arctan(beyond)).ravel()])


def _heading(rotation: jax.Array) -> jax.Array:
    """(2,) unit vector x, y: where a camera looks on the ground plane, whatever its roll.

    Of a level camera that is its line of sight; of one that looks straight down or up, what lies towards the horizon
    in its image. The sum of both leads from one to the other.
    """
    up = rotation[2, :2]  # of the world, in the image
    size = jnp.linalg.norm(up)
    up = jnp.where(size < 1e-6, jnp.array([0.0, -1.0]), up / jnp.maximum(size, 1e-6))
    ahead = rotation[:2, 2] - rotation[2, 2] * (rotation[:2, 0] * up[0] + rotation[:2, 1] * up[1])
    return ahead / jnp.maximum(jnp.linalg.norm(ahead), 1e-6)


def horizon_angles(rotation: jax.Array, intrinsics: Intrinsics) -> jax.Array:
    """(width,) rad: bearings in the world of points along the horizon of an image, without lens distortion.

    One for each column. The horizon of a camera on its side runs from the upper to the lower edge: as many along its
    rows.
    """
    share = (jnp.arange(intrinsics.width) + 0.5) / intrinsics.width
    column = (share * intrinsics.width - intrinsics.cx) / intrinsics.fx
    row = (share * intrinsics.height - intrinsics.cy) / intrinsics.fy
    # On the horizon a ray has no height: z = R[2,0] u + R[2,1] v + R[2,2] = 0.
    across, down, depth = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    upright = jnp.abs(down) >= jnp.abs(across)
    steep = jnp.where(upright, down, across)
    steep = jnp.where(jnp.abs(steep) < 1e-6, 1e-6, steep)
    met = -(jnp.where(upright, across * column, down * row) + depth) / steep
    u, v = jnp.where(upright, column, met), jnp.where(upright, met, row)
    x, y = (rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2] for axis in range(2))
    return jnp.arctan2(y, x)


def shown(
    scene: Scene, position: jax.Array, rotation: jax.Array, intrinsics: Intrinsics, mount: CameraMount | None = None
) -> Scene:
    """The scene with the walls of its map that this camera sees, in place of its last `keep` boxes.

    As many rays as the image has columns, along its horizon, and a few beyond it on both sides find the nearest walls.
    Where the mount lets it look so steeply down or up that it sees what is behind it, rays all around are added.
    Without a mount there are none. A scene without a map stays as it is.
    """
    walls = scene.walls
    if walls is None:
        return scene
    segments = jnp.asarray(walls.segments)
    fans = [bearings(rotation, intrinsics)]  # less than half a turn each
    if mount is not None and sees_behind(mount, intrinsics.height, intrinsics.width):
        c, s = _heading(rotation)
        fans += [*all_around(jnp.arctan2(s, c), intrinsics.width)]
    index = jnp.concatenate([first_walls(segments, position[0], position[1], fan) for fan in fans])
    index, mask = most_seen(index, walls.keep)
    fixed = scene.boxes.mask.shape[0] - walls.keep
    drawn = wall_boxes(segments, index, mask, walls.height, scene.boxes.colour[fixed])
    boxes = jax.tree.map(lambda all_of, new: all_of.at[fixed:].set(new), scene.boxes, drawn)
    return dataclasses.replace(scene, boxes=boxes)


def map_walls(segments: np.ndarray, keep: int = SHOWN, height: float = 2.2, near: float = NEAR) -> MapWalls:
    """Walls (S, 2, 2) [m] of a map, of which an image shows `keep` at most, with the lists of those within reach.

    A list holds every wall within `near` [m] of any place in its square; the lists are as long as the longest of them.
    """
    segments = np.asarray(segments, np.float32)
    low = segments.reshape(-1, 2).min(0) - near
    columns, rows = np.ceil((segments.reshape(-1, 2).max(0) + near - low) / SQUARE).astype(int)
    corner = SQUARE * np.array([[0.5, 0.5]])
    reach = near + SQUARE * 0.5**0.5
    squares, numbers = [], []
    for number, (start, end) in enumerate(segments.astype(float)):
        first = np.maximum(np.floor((np.minimum(start, end) - low - near) / SQUARE).astype(int), 0)
        last = np.minimum(np.floor((np.maximum(start, end) - low + near) / SQUARE).astype(int), [columns - 1, rows - 1])
        spans = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
        column, row = (axis.ravel() for axis in np.meshgrid(*spans))
        centre = low + np.column_stack([column, row]) * SQUARE + corner
        way = end - start
        share = np.clip(((centre - start) @ way) / max(way @ way, 1e-12), 0.0, 1.0)
        close = np.hypot(*(start + share[:, None] * way - centre).T) <= reach
        squares.append((row * columns + column)[close])
        numbers.append(np.full(close.sum(), number, np.int32))
    square, wall = np.concatenate(squares), np.concatenate(numbers)
    order = np.argsort(square, kind="stable")
    count = np.bincount(square, minlength=rows * columns)
    place = np.arange(len(square)) - (np.cumsum(count) - count)[square[order]]  # in the list of its square
    listed = np.full((rows * columns, count.max()), -1, np.int32)
    listed[square[order], place] = wall[order]
    lowest, shape = (float(low[0]), float(low[1])), (int(rows), int(columns))
    return MapWalls(segments, keep, height, listed, lowest, SQUARE, shape, near)
