"""Maps of real buildings: a ROS occupancy grid (YAML with PGM or PNG) as walls and as a distance field.

World frame: that of the map's YAML, x and y in m. The origin's yaw turns the grid about its lower left corner, as
map_server defines it. Reading is the host's work (numpy); `distance_at`, `map_clearance` and `nearest_walls` are pure
functions of one instance in JAX.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.io.fields import MAP, check_table
from whill_mjx.io.reading import MB, read_bytes, read_text
from whill_mjx.world.scene import Boxes, Footprint

FREE, UNKNOWN, OCCUPIED = 0, 1, 2
YAML_BYTES, IMAGE_BYTES, HEADER_BYTES = MB // 10, 100 * MB, 10_000
MAX_CELLS, LONGEST_SIDE = 50 * MB, 50_000
IMAGE = "is missing or no PGM or PNG of 8 bits per colour. Put the map's image there."


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
    table = check_table(str(path), MAP, _read_yaml(path))
    occupied, free = table["occupied_thresh"], table["free_thresh"]
    if not free < occupied:
        raise ValueError(f"{path}: free_thresh is {free:g} and occupied_thresh {occupied:g}; the first must be less. "
                         "Correct the file.")
    levels, grey = _read_grey(path.parent / table["image"])
    darkness = levels if table["negate"] else 1.0 - levels
    kinds = np.full(darkness.shape, UNKNOWN, np.uint8)  # of each level
    kinds[darkness > occupied] = OCCUPIED
    kinds[darkness < free] = FREE
    x, y, yaw = table["origin"]
    return GridMap(kinds[grey][::-1].copy(), table["resolution"], (x, y, yaw))


def _read_yaml(path: Path) -> dict[str, Any]:
    """The flat `key: value` lines of a map file that `MAP` knows, numbers as such."""
    try:
        text = read_text(path, YAML_BYTES, "does not exist. Give the YAML file of a map.")
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    kinds = {field.name: field.kind for field in MAP}
    table: dict[str, Any] = {}
    for line in text.split("\n"):
        key, colon, value = line.partition("#")[0].partition(":")
        key, value = key.strip(), value.strip().strip("'\"")
        if colon and value and key in kinds:
            if key in table:
                raise ValueError(f"{path}: {key} is there twice. Remove one of the lines.")
            parts = [_number(one) for one in value.strip("[]").split(",")]
            kind = kinds[key]
            table[key] = value if kind == "text" else parts if kind == "numbers" else parts[0] if len(
                parts) == 1 else value
    if isinstance(table.get("negate"), float) and table["negate"] in (0.0, 1.0):
        table["negate"] = int(table["negate"])
    return table


def _number(text: str) -> float | str:
    """The number that a text is, or the text."""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def _read_grey(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Share of white (L,) of each level, and the levels (rows, columns) of an image.

    A level is the sum of the pixel's colours, whose mean map_server takes.
    """
    import cv2

    try:
        data = read_bytes(path, IMAGE_BYTES, IMAGE)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    size = _image_size(data)
    if size is not None and (max(size) > LONGEST_SIDE or size[0] * size[1] > MAX_CELLS):
        raise ValueError(f"{path}: is {size[0]} x {size[1]} pixels; at most {MAX_CELLS} pixels, {LONGEST_SIDE} a side, "
                         "are read. Cut the map.")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if size else None
    except (cv2.error, MemoryError):
        image = None
    if image is None or image.dtype != np.uint8 or not image.size:
        raise ValueError(f"{path}: {IMAGE}")
    if image.ndim == 2:
        return np.arange(256) / 255.0, image
    colours = image[..., :3]
    sums = colours.sum(-1, dtype=np.uint16)
    return np.arange(255 * colours.shape[-1] + 1) / colours.shape[-1] / 255.0, sums


def _image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of a PGM or PNG states; None of anything else."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    header = re.match(rb"P[2356]\s(?:\s|#[^\n]*\n)*(\d{1,9})\s(?:\s|#[^\n]*\n)*(\d{1,9})\s", data[:HEADER_BYTES])
    return (int(header[1]), int(header[2])) if header else None


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
