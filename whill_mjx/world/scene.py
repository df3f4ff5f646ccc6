"""The world of one instance as arrays of fixed size: solid boxes, goal marker and looks; collision and clearance.

World frame: x forward along the course, y left, z up, ground at z = 0. Lengths in m, angles in rad, colours in [0, 1].
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.materials import Finish
from whill_mjx.world.people.crowd import People
from whill_mjx.world.solids import Solids, check_sizes

BLUE = (0.04, 0.16, 0.90)
"""Of every goal marker."""
WALL = (0.78, 0.76, 0.72)
CARDBOARD = (0.62, 0.44, 0.26)


@struct.dataclass
class Boxes:
    """P upright boxes, turned about the vertical. Unused ones have mask False: neither seen nor hit."""

    centre: jax.Array  # (P, 3) m
    half: jax.Array  # (P, 3) half sizes along the box's own axes [m]
    yaw: jax.Array  # (P,) rad
    colour: jax.Array  # (P, 3)
    mask: jax.Array  # (P,) bool


@struct.dataclass
class Marker:
    """The goal: a thin upright square whose face looks along -x at yaw 0. It is seen, but nothing collides with it."""

    position: jax.Array  # (3,) its centre; the goal centre is (x, y)
    half: jax.Array  # (3,) half thickness, width, height [m]
    yaw: jax.Array  # () rad
    colour: jax.Array  # (3,)


@struct.dataclass
class Looks:
    """What changes the picture but not the motion."""

    sun: jax.Array  # (3,) unit vector towards the sun
    ambient: jax.Array  # () light on a face turned away from the sun
    diffuse: jax.Array  # () light added on a face that looks into the sun
    sky_horizon: jax.Array  # (3,)
    sky_zenith: jax.Array  # (3,)
    ground: jax.Array  # (2, 3) the two colours of the tiles
    tile: jax.Array  # () edge of a tile [m]
    tile_offset: jax.Array  # (2,) where the tiling starts [m]
    noise: jax.Array  # () relative brightness noise of the ground, in cells of a tenth of a tile
    grain: jax.Array  # () relative brightness noise of the boxes, in cells of 0.1 m
    seed: jax.Array  # () uint32, of noise and grain


@dataclass(frozen=True, eq=False)
class MapWalls:
    """Walls of a map. Static, and shared by all instances: a map of thousands of walls is stored once.

    Walls with the same content are equal: a state that was copied, or read from a file, stays one of the same map.
    """

    segments: np.ndarray
    """(S, 2, 2) float32: both ends of each wall, x and y [m]; the free space lies to the left of its way."""
    keep: int
    """Walls that an image shows at most: the scene's last boxes are theirs."""
    height: float
    """Height of all walls [m]."""
    near: np.ndarray
    """(rows * columns, M) int32: the walls within reach of each square of a coarse grid; -1 is none."""
    corner: tuple[float, float]
    """x, y of the coarse grid's lower left corner [m]."""
    square: float
    """Edge of its squares [m]."""
    shape: tuple[int, int]
    """Its rows and columns."""
    within: float
    """How far from any place of a square the walls are listed [m]."""

    @cached_property
    def content(self) -> str:
        """Checksum of all fields."""
        found = hashlib.sha256()
        for one in fields(self):
            value = np.asarray(getattr(self, one.name))
            found.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
        return found.hexdigest()

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, MapWalls) and self.content == other.content)

    def __hash__(self) -> int:
        return hash(self.content)

    def cell(self, x: jax.Array, y: jax.Array) -> jax.Array:
        """Line of `near` for a place; the nearest square for one outside."""
        column = jnp.clip(jnp.floor((x - self.corner[0]) / self.square), 0, self.shape[1] - 1)
        row = jnp.clip(jnp.floor((y - self.corner[1]) / self.square), 0, self.shape[0] - 1)
        return (row * self.shape[1] + column).astype(jnp.int32)


@struct.dataclass
class Scene:
    """Everything around the vehicle."""

    boxes: Boxes
    marker: Marker
    looks: Looks
    solids: Solids | None = None  # seen; rounds collide, blocks do not
    finish: Finish | None = None  # textures, lamps and fog
    walls: MapWalls | None = struct.field(pytree_node=False, default=None)  # of a map: seen and hit
    ghosts: Boxes | None = None  # upright boxes that are seen, but nothing collides with them
    hidden: jax.Array | None = None  # (P,) bool: boxes that are hit but not seen, for something else shows them
    ground: tuple = ()  # surfaces on it (`whill_mjx.effects.base.Surface`) that lift the vehicle; `solids` show them
    people: People | None = None  # who walk; `solids` has their shapes, behind all other rounds
    rich: Any = None  # materials, lights and film of `whill_mjx.world.rich`; they replace colours, looks and finish


def default_looks() -> Looks:
    """Indoor daylight: grey tiled floor, pale walls and sky."""
    return Looks(
        sun=jnp.array([-0.48, 0.36, 0.80]),
        ambient=jnp.array(0.55, float),
        diffuse=jnp.array(0.55, float),
        sky_horizon=jnp.array([0.80, 0.86, 0.92]),
        sky_zenith=jnp.array([0.45, 0.62, 0.85]),
        ground=jnp.array([[0.50, 0.50, 0.48], [0.42, 0.42, 0.41]]),
        tile=jnp.array(0.5, float),
        tile_offset=jnp.zeros(2),
        noise=jnp.array(0.06, float),
        grain=jnp.array(0.04, float),
        seed=jnp.array(0, jnp.uint32),
    )


def no_boxes(count: int) -> Boxes:
    """`count` unused boxes."""
    zeros = jnp.zeros((count, 3))
    return Boxes(zeros, zeros, jnp.zeros(count), zeros, jnp.zeros(count, bool))


def stack_boxes(boxes: list[Boxes]) -> Boxes:
    """The boxes of a list, one after the other."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *boxes)


def box(x, y, length, width, height, colour, yaw=0.0, mask=True) -> Boxes:
    """One box standing on the ground, centred at (x, y); `length` runs along its own x. A `Boxes` with P = 1.

    Raises:
        ValueError: a size that is no number above 0; sizes that are traced are taken as they come.
    """
    if mask is not False:  # what is not there may have no size
        check_sizes(length=length, width=width, height=height)
    centre = jnp.stack([jnp.asarray(value, jnp.float32) for value in (x, y, height / 2)])
    half = jnp.stack([jnp.asarray(value, jnp.float32) / 2 for value in (length, width, height)])
    return Boxes(
        centre[None],
        half[None],
        jnp.asarray(yaw, jnp.float32)[None],
        jnp.asarray(colour, jnp.float32)[None],
        jnp.asarray(mask)[None],
    )


@struct.dataclass
class Footprint:
    """The vehicle as an oriented rectangle on the ground, centred at its chassis origin.

    The driven-axle centre, which the tasks measure from, lies `spec.reference_x` (negative: behind) along the heading.
    """

    x: jax.Array  # () centre [m]
    y: jax.Array  # () m
    yaw: jax.Array  # () rad
    half_length: jax.Array  # () m
    half_width: jax.Array  # () m
    height: jax.Array  # () boxes that start above this height are driven under [m]


def footprint(spec, x, y, yaw) -> Footprint:
    """Footprint of a vehicle whose driven-axle centre is at (x, y) with heading `yaw`."""
    ahead = -spec.reference_x
    return Footprint(
        x + ahead * jnp.cos(yaw),
        y + ahead * jnp.sin(yaw),
        yaw,
        jnp.asarray(spec.body_length / 2),
        jnp.asarray(spec.body_width / 2),
        jnp.asarray(spec.body_height),
    )


def overlaps(vehicle: Footprint, boxes: Boxes) -> jax.Array:
    """(P,) bool: which boxes the vehicle touches, by the separating-axis test on the two axes of either rectangle."""
    dx, dy = boxes.centre[:, 0] - vehicle.x, boxes.centre[:, 1] - vehicle.y
    hx, hy = boxes.half[:, 0], boxes.half[:, 1]
    c, s = jnp.cos(vehicle.yaw), jnp.sin(vehicle.yaw)
    cb, sb = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    cos, sin = jnp.abs(c * cb + s * sb), jnp.abs(c * sb - s * cb)  # of the angle between the rectangles
    length, width = vehicle.half_length, vehicle.half_width
    along = jnp.abs(dx * c + dy * s) <= length + hx * cos + hy * sin
    across = jnp.abs(dy * c - dx * s) <= width + hx * sin + hy * cos
    box_along = jnp.abs(dx * cb + dy * sb) <= hx + length * cos + width * sin
    box_across = jnp.abs(dy * cb - dx * sb) <= hy + length * sin + width * cos
    return along & across & box_along & box_across & _reachable(vehicle, boxes)


def collides(vehicle: Footprint, boxes: Boxes) -> jax.Array:
    """() bool: does the vehicle touch any box?"""
    return jnp.any(overlaps(vehicle, boxes))


def clearance(vehicle: Footprint, boxes: Boxes) -> jax.Array:
    """() m: distance from the vehicle to the nearest box on the ground plane, 0 when touching, inf without boxes.

    Two disjoint rectangles are closest at a corner of one of them, so eight point-to-rectangle distances suffice.
    """
    signs = jnp.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    own = _corners(vehicle.x, vehicle.y, vehicle.yaw, vehicle.half_length, vehicle.half_width, signs)  # (4, 2)
    others = jax.vmap(_corners, in_axes=(0, 0, 0, 0, 0, None))(
        boxes.centre[:, 0], boxes.centre[:, 1], boxes.yaw, boxes.half[:, 0], boxes.half[:, 1], signs
    )  # (P, 4, 2)
    to_boxes = jax.vmap(_point_distance, in_axes=(None, 0, 0, 0, 0, 0))(
        own, boxes.centre[:, 0], boxes.centre[:, 1], boxes.yaw, boxes.half[:, 0], boxes.half[:, 1]
    )  # (P, 4)
    to_vehicle = _point_distance(others, vehicle.x, vehicle.y, vehicle.yaw, vehicle.half_length, vehicle.half_width)
    distance = jnp.minimum(to_boxes.min(-1), to_vehicle.min(-1))
    distance = jnp.where(overlaps(vehicle, boxes), 0.0, distance)
    return jnp.min(jnp.where(_reachable(vehicle, boxes), distance, jnp.inf), initial=jnp.inf)


def _reachable(vehicle: Footprint, boxes: Boxes) -> jax.Array:
    return boxes.mask & (boxes.centre[:, 2] - boxes.half[:, 2] < vehicle.height)


def _corners(x, y, yaw, half_x, half_y, signs: jax.Array) -> jax.Array:
    """(4, 2) corners of an oriented rectangle."""
    a, b = signs[:, 0] * half_x, signs[:, 1] * half_y
    return jnp.stack([x + a * jnp.cos(yaw) - b * jnp.sin(yaw), y + a * jnp.sin(yaw) + b * jnp.cos(yaw)], -1)


def _point_distance(points: jax.Array, x, y, yaw, half_x, half_y) -> jax.Array:
    """(...,) distance of points (..., 2) from an oriented rectangle, 0 inside."""
    dx, dy = points[..., 0] - x, points[..., 1] - y
    along = jnp.maximum(jnp.abs(dx * jnp.cos(yaw) + dy * jnp.sin(yaw)) - half_x, 0.0)
    across = jnp.maximum(jnp.abs(dy * jnp.cos(yaw) - dx * jnp.sin(yaw)) - half_y, 0.0)
    return jnp.sqrt(along**2 + across**2)
