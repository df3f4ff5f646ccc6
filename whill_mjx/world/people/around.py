"""What people keep clear of besides one another: the nearest points of boxes, walls and posts, and the vehicle."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from whill_mjx.world.collision import from_above
from whill_mjx.world.people.law import Mover, Near, Surroundings
from whill_mjx.world.plane import Vector
from whill_mjx.world.scene import Boxes, Footprint, MapWalls, Scene
from whill_mjx.world.solids import Rounds

TALL = 1.9
"""What begins above this height is walked under [m]."""


def near_in(scene: Scene) -> Surroundings:
    """Nearest points of everything that stands in a scene without people.

    The lists of a map's walls are read where people are at first, and hold what they come near to in one step.
    """
    boxes, walls = scene.boxes, scene.walls
    if walls is not None:
        boxes = jax.tree.map(lambda leaf: leaf[: leaf.shape[0] - walls.keep], boxes)  # the rest are pictures of walls
    rounds = None if scene.solids is None else scene.solids.rounds

    def around(first: jax.Array) -> Callable[[Vector], Near]:
        listed = None if walls is None else _listed(walls, first)

        def near(place: Vector) -> Near:
            none = jnp.zeros((1, *place.x.shape))
            found = [Near(Vector(none, none), none > 0.0)]
            if boxes.mask.shape[0]:
                found.append(_on_boxes(place, boxes))
            if listed is not None:
                start, way, there = listed
                found.append(Near(_on_segments(place, start, way), there))
            if rounds is not None:
                found.append(_on_rounds(place, rounds))
            return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)

        return near

    return around


def _listed(walls: MapWalls, place: jax.Array) -> tuple[Vector, Vector, jax.Array]:
    """Start and way (M, N) [m] of the walls near each place (N, 2), and which of them (M, N) there are."""
    index = jnp.asarray(walls.near)[walls.cell(place[:, 0], place[:, 1])].T
    numbers = jnp.asarray(walls.segments).reshape(-1, 4).T
    x0, y0, x1, y1 = (part[jnp.maximum(index, 0)] for part in numbers)
    # The barrier keeps XLA from reading the lists again for each place.
    return jax.lax.optimization_barrier((Vector(x0, y0), Vector(x1 - x0, y1 - y0), index >= 0))


def _on_boxes(place: Vector, boxes: Boxes) -> Near:
    axis = Vector.at_angle(boxes.yaw[:, None])
    centre, half = (Vector(array[:, 0, None], array[:, 1, None]) for array in (boxes.centre, boxes.half))
    off = place - centre  # (P, N)
    along, across = jnp.clip(axis.dot(off), -half.x, half.x), jnp.clip(axis.cross(off), -half.y, half.y)
    point = centre + axis * along + axis.left * across
    there = boxes.mask & (boxes.centre[:, 2] - boxes.half[:, 2] < TALL)
    return Near(point, jnp.broadcast_to(there[:, None], point.x.shape))


def _on_segments(place: Vector, start: Vector, way: Vector) -> Vector:
    share = jnp.clip((place - start).dot(way) / jnp.maximum(way.dot(way), 1e-12), 0.0, 1.0)
    return start + way * share


def _on_rounds(place: Vector, rounds: Rounds) -> Near:
    seen = from_above(rounds)
    start, end = (Vector(array[:, 0, None], array[:, 1, None]) for array in (seen.start, seen.end))
    axis = _on_segments(place, start, end - start)
    away = place - axis
    point = axis + away * (jnp.minimum(seen.radius[:, None], away.length) / away.length)
    return Near(point, jnp.broadcast_to((seen.mask & (seen.low < TALL))[:, None], point.x.shape))


def mover_of(before: Footprint, after: Footprint, duration: float) -> Mover:
    """The vehicle at the beginning of a period, as people meet it."""
    c, s = jnp.cos(before.yaw), jnp.sin(before.yaw)
    turn = jnp.mod(after.yaw - before.yaw + jnp.pi, 2 * jnp.pi) - jnp.pi
    return Mover(
        centre=jnp.stack([before.x, before.y]),
        axis=jnp.stack([c, s]),
        half=jnp.stack([before.half_length, before.half_width]),
        velocity=jnp.stack([after.x - before.x, after.y - before.y]) / duration,
        yaw_rate=turn / duration,
    )
