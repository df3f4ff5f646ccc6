"""Contact of the vehicle with what stands around it, exact on the ground plane and over the whole of a step.

The vehicle is an oriented rectangle. It is tested against boxes (separating axes), and against stadiums: the points
within a radius of a segment, which a wall of a map (radius 0), an upright cylinder, a capsule and a person are from
above. A distance field is met by points of the rectangle's border, `SPACING` apart. What starts above the vehicle's
height is driven under.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.maps.field import DistanceField, distance_at
from whill_mjx.world.scene import Boxes, Footprint, Scene, clearance, overlaps
from whill_mjx.world.solids import Rounds

DEPTH = 0.01
"""Distance that any point of the vehicle moves at most between two tested poses [m]."""
HALVINGS = 4
"""Bisections between the last free pose and the first that touches: DEPTH / 16 remains."""
SPACING = 0.02
"""Distance of the border's points that meet a distance field [m]."""


@struct.dataclass
class Stadiums:
    """M sets of points within a radius of a segment on the ground plane."""

    start: jax.Array  # (M, 2) m
    end: jax.Array  # (M, 2) m
    radius: jax.Array  # (M,) m
    low: jax.Array  # (M,) m: height at which it begins
    mask: jax.Array  # (M,) bool


@struct.dataclass
class Obstacles:
    """What the vehicle can run into."""

    boxes: Boxes
    stadiums: Stadiums
    field: DistanceField | None = None
    walls: Stadiums | None = None  # of radius 0, whose contact costs far less


def obstacles_of(scene: Scene, x, y) -> Obstacles:
    """Everything near (x, y) that a vehicle can run into: boxes, the walls of a map, cylinders, capsules and people."""
    boxes, walls, parts = scene.boxes, None, []
    if scene.walls is not None:
        fixed = boxes.mask.shape[0] - scene.walls.keep  # the rest are pictures of walls
        boxes = jax.tree.map(lambda leaf: leaf[:fixed], boxes)
        walls = near_walls(scene.walls, x, y)
    if scene.solids is not None and scene.solids.rounds is not None:
        parts.append(from_above(scene.solids.rounds))
    none = Stadiums(jnp.zeros((0, 2)), jnp.zeros((0, 2)), jnp.zeros(0), jnp.zeros(0), jnp.zeros(0, bool))
    return Obstacles(boxes, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), none, *parts), walls=walls)


def near_walls(walls, x, y) -> Stadiums:
    """The walls of a map that a vehicle at (x, y) can meet in one step."""
    index = jnp.asarray(walls.near)[walls.cell(x, y)]  # (M,)
    segments = jnp.asarray(walls.segments)[jnp.maximum(index, 0)]
    zero = jnp.zeros(index.shape)
    return Stadiums(segments[:, 0], segments[:, 1], zero, zero, index >= 0)


def from_above(rounds: Rounds) -> Stadiums:
    """Cylinders and capsules seen from above. A cylinder that lies down has round ends here: it is too long by them."""
    reach = rounds.half[:, None] * rounds.axis
    start, end = rounds.centre - reach, rounds.centre + reach
    flat = jnp.sqrt(jnp.maximum(1.0 - rounds.axis[:, 2] ** 2, 0.0))  # how far a flat end hangs below its centre
    below = jnp.where(rounds.capsule, rounds.radius, rounds.radius * flat)
    return Stadiums(start[:, :2], end[:, :2], rounds.radius, jnp.minimum(start[:, 2], end[:, 2]) - below, rounds.mask)


def distances(vehicle: Footprint, stadiums: Stadiums) -> jax.Array:
    """(M,) m: distance from the vehicle to each stadium, negative by how far it reaches over a border of the vehicle.

    Two disjoint convex shapes without round parts are closest at a corner of one of them.
    """
    (x0, y0), (x1, y1), crosses = _in_frame(vehicle, stadiums)
    a, b = vehicle.half_length, vehicle.half_width
    way_x, way_y = x1 - x0, y1 - y0
    square = jnp.maximum(way_x**2 + way_y**2, 1e-12)
    least = jnp.minimum(*(_square(*(jnp.maximum(jnp.abs(one) - half, 0.0) for one, half in ((x, a), (y, b))))
                          for x, y in ((x0, y0), (x1, y1))))  # fmt: skip
    for x, y in ((a, b), (a, -b), (-a, b), (-a, -b)):  # the corners
        x, y = x - x0, y - y0
        share = jnp.clip((x * way_x + y * way_y) / square, 0.0, 1.0)
        least = jnp.minimum(least, _square(x - share * way_x, y - share * way_y))
    return jnp.where(crosses, 0.0, jnp.sqrt(least)) - stadiums.radius


def _square(x: jax.Array, y: jax.Array) -> jax.Array:
    return x * x + y * y


Point = tuple[jax.Array, jax.Array]
"""x and y (M,) [m], apart: XLA computes arrays whose last axis has two entries one number at a time on a processor."""


def _in_frame(vehicle: Footprint, stadiums: Stadiums) -> tuple[Point, Point, jax.Array]:
    """Both ends of each axis in the vehicle's frame, and whether the axis meets the rectangle (M,)."""
    c, s = jnp.cos(vehicle.yaw), jnp.sin(vehicle.yaw)

    def own(points):
        dx, dy = points[:, 0] - vehicle.x, points[:, 1] - vehicle.y
        return dx * c + dy * s, dy * c - dx * s

    start, end = own(stadiums.start), own(stadiums.end)
    x, y = ((one + other) / 2 for one, other in zip(start, end, strict=True))  # of the middle
    half_x, half_y = ((other - one) / 2 for one, other in zip(start, end, strict=True))
    a, b = vehicle.half_length, vehicle.half_width
    crosses = (jnp.abs(x) <= a + jnp.abs(half_x)) & (jnp.abs(y) <= b + jnp.abs(half_y))
    return start, end, crosses & (jnp.abs(x * half_y - y * half_x) <= a * jnp.abs(half_y) + b * jnp.abs(half_x))


def touches(vehicle: Footprint, obstacles: Obstacles) -> jax.Array:
    """() bool: does the vehicle touch anything?"""
    hit = jnp.any(overlaps(vehicle, obstacles.boxes))
    stadiums = obstacles.stadiums
    if stadiums.mask.shape[0]:
        met = (distances(vehicle, stadiums) <= 0.0) & stadiums.mask & (stadiums.low < vehicle.height)
        hit |= jnp.any(met)
    walls = obstacles.walls
    if walls is not None:
        hit |= jnp.any(_in_frame(vehicle, walls)[2] & walls.mask & (walls.low < vehicle.height))
    if obstacles.field is not None:
        hit |= jnp.any(distance_at(obstacles.field, border(vehicle)) <= 0.0)
    return hit


def border(vehicle: Footprint) -> jax.Array:
    """(B, 2) m: points on the border of the vehicle, `SPACING` apart at most for vehicles up to 2 x 1 m."""
    along, across = (np.linspace(-1.0, 1.0, math.ceil(size / SPACING) + 1) for size in (2.0, 1.0))
    sides = [np.stack([along, np.full_like(along, side)], -1) for side in (-1.0, 1.0)]
    sides += [np.stack([np.full_like(across, side), across], -1) for side in (-1.0, 1.0)]
    unit = np.concatenate(sides)
    a, b = unit[:, 0] * vehicle.half_length, unit[:, 1] * vehicle.half_width
    c, s = jnp.cos(vehicle.yaw), jnp.sin(vehicle.yaw)
    return jnp.stack([vehicle.x + a * c - b * s, vehicle.y + a * s + b * c], -1)


def poses_between(speed: float, yaw_rate: float, duration: float, half_length: float, half_width: float) -> int:
    """Poses to test in one step, so that no point of the vehicle moves more than `DEPTH` from one to the next."""
    farthest = duration * (abs(speed) + abs(yaw_rate) * math.hypot(half_length, half_width))
    return max(1, math.ceil(farthest / DEPTH))


def first_contact(before: Footprint, after: Footprint, obstacles: Obstacles, poses: int) -> tuple[jax.Array, jax.Array]:
    """Whether the vehicle touches anything on its way, and the share () of the way that it gets before.

    Args:
        before, after: the vehicle at both ends of the step; between them place and heading change evenly.
        obstacles: standing still, or where they are at the end.
        poses: static, from `poses_between`; the last is `after`.
    """
    turn = jnp.mod(after.yaw - before.yaw + jnp.pi, 2 * jnp.pi) - jnp.pi

    def hit(share):
        x = before.x + share * (after.x - before.x)
        y = before.y + share * (after.y - before.y)
        pose = dataclasses.replace(after, x=x, y=y, yaw=before.yaw + share * turn)
        return touches(pose, obstacles)

    shares = jnp.arange(1, poses + 1) / poses
    hits = jax.vmap(hit)(shares)
    collided = jnp.any(hits)
    first = jnp.argmax(hits)
    low, high = first / poses, (first + 1) / poses
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        there = hit(middle)
        low, high = jnp.where(there, low, middle), jnp.where(there, middle, high)
    return collided, jnp.where(collided, high, 1.0)


def free_distance(vehicle: Footprint, scene: Scene) -> jax.Array:
    """() m: distance from the vehicle to the nearest thing on the ground plane, 0 when touching.

    Inf without any; of a map, walls within reach count (`near_walls`).
    """
    obstacles = obstacles_of(scene, vehicle.x, vehicle.y)
    least = clearance(vehicle, obstacles.boxes)
    for stadiums in (obstacles.stadiums, obstacles.walls):
        if stadiums is not None and stadiums.mask.shape[0]:
            there = stadiums.mask & (stadiums.low < vehicle.height)
            apart = jnp.where(there, jnp.maximum(distances(vehicle, stadiums), 0.0), jnp.inf)
            least = jnp.minimum(least, jnp.min(apart))
    return least
