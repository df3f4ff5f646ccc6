"""Maps of real buildings: a ROS occupancy grid (YAML with PGM or PNG) as walls and as a distance field.

World frame: that of the map's YAML, x and y in m. The origin's yaw turns the grid about its lower left corner, as
map_server defines it. Reading is the host's work (numpy); `distance_at`, `map_clearance` and `nearest_walls` are pure
functions of one instance in JAX.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.scene import Boxes, Footprint

FREE, UNKNOWN, OCCUPIED = 0, 1, 2
KEYS = ("image", "resolution", "origin", "occupied_thresh", "free_thresh", "negate")


@dataclass(frozen=True, eq=False)
class GridMap:
    """Occupancy grid."""

    cells: np.ndarray
    """(rows, columns) uint8 of FREE, UNKNOWN and OCCUPIED; row 0 is at the bottom, where y begins."""
    resolution: float
    """Edge of a cell [m]."""
    origin: tuple[float, float, float]
    """x [m], y [m], yaw [rad] of the lower left corner of the grid."""

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """World coordinates (..., 2) of points (..., 2) in the grid's own frame [m]."""
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        return points @ np.array([[cos, sin], [-sin, cos]]) + np.array([x, y])

    def free_points(self) -> np.ndarray:
        """(F, 2) world coordinates of the centres of all free cells."""
        rows, columns = np.nonzero(self.cells == FREE)
        return self.to_world((np.stack([columns, rows], -1) + 0.5) * self.resolution)


@struct.dataclass
class DistanceField:
    """Distance from each cell's centre to the border of the free space."""

    distance: jax.Array  # (rows, columns) m, negative in cells that are not free
    origin: jax.Array  # (3,) x [m], y [m], yaw [rad] of the lower left corner
    resolution: jax.Array  # () m


def load_map(path: str | Path) -> GridMap:
    """Occupancy grid of a map_server YAML file.

    Raises:
        ValueError: a field is missing or out of its range, or the image cannot be read; names file and remedy.
    """
    path = Path(path)
    table = _read_yaml(path)
    missing = [key for key in KEYS if key not in table]
    if missing:
        raise ValueError(f"{path}: no field {missing[0]!r}; map_server needs {', '.join(KEYS)}. Add it.")
    if table.get("mode", "trinary") not in ("trinary", "scale"):
        raise ValueError(f"{path}: mode is {table['mode']!r}; 'trinary' and 'scale' are read here. Save it as trinary.")
    resolution = _number(path, "resolution", table["resolution"])
    occupied, free = (_number(path, key, table[key]) for key in ("occupied_thresh", "free_thresh"))
    parts = table["origin"].strip("[]").split(",")
    if len(parts) != 3:
        raise ValueError(f"{path}: origin is {table['origin']}; it must be [x, y, yaw]. Correct it.")
    x, y, yaw = (_number(path, "origin", part) for part in parts)
    if not resolution > 0 or not 0 <= free < occupied <= 1:
        raise ValueError(f"{path}: resolution {resolution} must be positive, and 0 <= free_thresh ({free}) < "
                         f"occupied_thresh ({occupied}) <= 1. Correct the file.")
    grey = _read_grey(path.parent / table["image"])
    darkness = grey / 255.0 if int(_number(path, "negate", table["negate"])) else 1.0 - grey / 255.0
    cells = np.full(grey.shape, UNKNOWN, np.uint8)
    cells[darkness > occupied] = OCCUPIED
    cells[darkness < free] = FREE
    return GridMap(cells[::-1].copy(), resolution, (x, y, yaw))


def _read_yaml(path: Path) -> dict[str, str]:
    """The flat `key: value` lines of a map file."""
    if not path.is_file():
        raise ValueError(f"{path}: does not exist. Give the YAML file of a map.")
    table = {}
    for line in path.read_text().splitlines():
        key, colon, value = line.partition("#")[0].partition(":")
        if colon and value.strip():
            table[key.strip()] = value.strip().strip("'\"")
    return table


def _number(path: Path, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}: {key} is {text!r}; it must be a finite number. Correct it.")
    return value


def _read_grey(path: Path) -> np.ndarray:
    """(rows, columns) grey levels 0 to 255, the mean of the colours as map_server takes it."""
    import cv2

    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None or image.dtype != np.uint8:
        raise ValueError(f"{path}: is missing or no image of 8 bits per colour. Put the map's PGM or PNG there.")
    return image[..., :3].mean(-1) if image.ndim == 3 else image.astype(float)


def wall_segments(grid: GridMap) -> np.ndarray:
    """Borders of the free space as straight segments (S, 2, 2), world coordinates [m].

    Edges between a free cell and one that is not, each run along a row or a column joined to one segment. The free
    space lies to the left of the way from a segment's first point to its second.
    """
    free = np.pad(grid.cells == FREE, 1)
    segments: list[np.ndarray] = []
    for transposed in (False, True):
        field = free.T if transposed else free
        for side in (1, -1):
            # Free cells whose neighbour in the row before (side 1) or after (side -1) is not free.
            border = field & ~np.roll(field, side, axis=0)
            starts = np.argwhere(border & ~np.roll(border, 1, axis=1))
            ends = np.argwhere(border & ~np.roll(border, -1, axis=1))
            line = starts[:, 0] - 1 + (side < 0)  # the padding of one cell taken off
            first, last = starts[:, 1] - 1, ends[:, 1]
            run = np.stack([np.stack([first, line], -1), np.stack([last, line], -1)], 1).astype(float)
            run = run[..., ::-1] if transposed else run
            segments.append(run[:, ::-1] if (side < 0) != transposed else run)
    return grid.to_world(np.concatenate(segments) * grid.resolution)


def distance_field(grid: GridMap) -> DistanceField:
    """Distance of every cell's centre to the border of the free space, negative outside of it."""
    from scipy.ndimage import distance_transform_edt

    free = np.pad(grid.cells == FREE, 1)  # what lies beyond the grid is not free
    # From centre to centre; the border lies half a cell before the other centre.
    inside, outside = (distance_transform_edt(field) - 0.5 for field in (free, ~free))
    metres = np.where(free, inside, -outside)[1:-1, 1:-1] * grid.resolution
    origin, resolution = (jnp.asarray(value, jnp.float32) for value in (grid.origin, grid.resolution))
    return DistanceField(jnp.asarray(metres, jnp.float32), origin, resolution)


def distance_at(field: DistanceField, points: jax.Array) -> jax.Array:
    """(...,) m: distance from points (..., 2) to the nearest thing, bilinear between cells, 0 outside of the grid."""
    x, y, yaw = field.origin
    dx, dy = points[..., 0] - x, points[..., 1] - y
    along = (dx * jnp.cos(yaw) + dy * jnp.sin(yaw)) / field.resolution - 0.5
    across = (dy * jnp.cos(yaw) - dx * jnp.sin(yaw)) / field.resolution - 0.5
    near = jax.scipy.ndimage.map_coordinates
    return jnp.maximum(near(field.distance, [across, along], order=1, mode="constant", cval=0.0), 0.0)


def map_clearance(field: DistanceField, vehicle: Footprint, size: tuple[int, int] = (12, 8)) -> jax.Array:
    """() m: distance from the vehicle to the nearest thing, 0 when touching; right to half the distance of samples.

    The distance is sampled on a grid of `size` points over the rectangle, so that something thin that has got inside is
    seen as well.
    """
    u, v = jnp.meshgrid(jnp.linspace(-1.0, 1.0, size[0]), jnp.linspace(-1.0, 1.0, size[1]))
    a, b = u.ravel() * vehicle.half_length, v.ravel() * vehicle.half_width
    x = vehicle.x + a * jnp.cos(vehicle.yaw) - b * jnp.sin(vehicle.yaw)
    y = vehicle.y + a * jnp.sin(vehicle.yaw) + b * jnp.cos(vehicle.yaw)
    return jnp.min(distance_at(field, jnp.stack([x, y], -1)))


def nearest_walls(segments: jax.Array, x, y, count: int, height: float = 2.0, colour=(0.78, 0.76, 0.72)) -> Boxes:
    """The `count` segments (S, 2, 2) nearest to a point, as thin boxes that can be seen and hit.

    Each box lies behind its segment, outside of the free space. Fewer than `count` segments leave unused boxes.
    """
    thickness = 0.1
    start, end = segments[:, 0], segments[:, 1]
    way = end - start
    length = jnp.linalg.norm(way, axis=-1)
    share = jnp.clip(((x - start[:, 0]) * way[:, 0] + (y - start[:, 1]) * way[:, 1]) / length**2, 0.0, 1.0)
    foot = start + share[:, None] * way
    distance = jnp.hypot(foot[:, 0] - x, foot[:, 1] - y)
    used = min(count, segments.shape[0])
    _, index = jax.lax.top_k(-distance, used)
    index = jnp.concatenate([index, jnp.zeros(count - used, index.dtype)])
    direction = way[index] / length[index][:, None]
    right = jnp.stack([direction[:, 1], -direction[:, 0]], -1)
    middle = (start[index] + end[index]) / 2 + right * thickness / 2
    return Boxes(
        centre=jnp.concatenate([middle, jnp.full((count, 1), height / 2)], -1),
        half=jnp.stack([length[index] / 2, jnp.full(count, thickness / 2), jnp.full(count, height / 2)], -1),
        yaw=jnp.arctan2(direction[:, 1], direction[:, 0]),
        colour=jnp.broadcast_to(jnp.asarray(colour, jnp.float32), (count, 3)),
        mask=jnp.arange(count) < used,
    )
