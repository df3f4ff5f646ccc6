"""Rays of a scanner in three dimensions, exact against everything that a level scan meets, and the ground.

`whill_mjx.sensors.lidar3d` makes a sensor of them. Each ray also gets the cosine of its angle of incidence and the
brightness of what it meets, from which an intensity follows.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from whill_mjx.world.lidar import round_hits
from whill_mjx.world.maps.walls import cast
from whill_mjx.world.scene import Boxes, MapWalls, Scene
from whill_mjx.world.solids import Rounds


class Returns(NamedTuple):
    """What R rays meet first."""

    distance: jax.Array  # (R,) m along each ray, inf without anything
    cosine: jax.Array  # (R,) of the angle of incidence
    albedo: jax.Array  # (R,) mean of the colour, 0 to 1


def first_returns(scene: Scene, origin: jax.Array, way: jax.Array) -> Returns:
    """What each ray meets first: the plane z = 0, boxes, rounds and the walls of a map; not the goal's marker.

    Args:
        scene: surfaces on the ground, ghosts and blocks do not count.
        origin: (R, 3) m; in a map below the upper edge of the walls.
        way: (R, 3) unit vectors.
    """
    boxes, walls, found = scene.boxes, scene.walls, [_ground(scene, origin, way)]
    if walls is not None:
        fixed = boxes.mask.shape[0] - walls.keep  # the rest are pictures of walls
        found.append(_walls(walls, boxes.colour[fixed].mean(), origin, way))
        boxes = jax.tree.map(lambda leaf: leaf[:fixed], boxes)
    if boxes.mask.shape[0]:
        found.append(_boxes(boxes, origin, way))
    if scene.solids is not None and scene.solids.rounds is not None:
        found.append(_rounds(scene.solids.rounds, origin, way))
    every = Returns(*(jnp.stack(leaves) for leaves in zip(*found, strict=True)))
    nearest = jnp.argmin(every.distance, 0)[None]
    return Returns(*(jnp.take_along_axis(leaf, nearest, 0)[0] for leaf in every))


def _ground(scene: Scene, origin: jax.Array, way: jax.Array) -> Returns:
    down = jnp.maximum(-way[:, 2], 1e-9)
    far = jnp.where(way[:, 2] < -1e-6, origin[:, 2] / down, jnp.inf)
    return Returns(far, down, jnp.broadcast_to(scene.looks.ground.mean(), far.shape))


def _walls(walls: MapWalls, albedo: jax.Array, origin: jax.Array, way: jax.Array) -> Returns:
    segments = jnp.asarray(walls.segments)
    level = jnp.sqrt(jnp.maximum(1.0 - way[:, 2] ** 2, 1e-12))
    far, index = cast(segments, origin[:, :1], origin[:, 1:2], jnp.arctan2(way[:, 1], way[:, 0]))
    far = far / level
    met = origin[:, 2] + far * way[:, 2] <= walls.height  # a ray that rises over the nearest wall rises over all
    along = segments[index, 1] - segments[index, 0]
    along = along / jnp.maximum(jnp.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    cosine = jnp.abs(way[:, 0] * along[:, 1] - way[:, 1] * along[:, 0])
    return Returns(jnp.where(met, far, jnp.inf), cosine, jnp.broadcast_to(albedo, far.shape))


def _boxes(boxes: Boxes, origin: jax.Array, way: jax.Array) -> Returns:
    """By the slab test in each box's frame; the slab that is entered last is the face."""
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    off = origin[:, None] - boxes.centre  # (R, P, 3)
    starts = (off[..., 0] * c + off[..., 1] * s, off[..., 1] * c - off[..., 0] * s, off[..., 2])
    ways = (way[:, :1] * c + way[:, 1:2] * s, way[:, 1:2] * c - way[:, :1] * s, way[:, 2:] + 0.0 * c)
    enter, leave = jnp.zeros(off.shape[:2]), jnp.full(off.shape[:2], jnp.inf)
    cosine = jnp.ones(off.shape[:2])
    for axis, (place, along) in enumerate(zip(starts, ways, strict=True)):
        safe = jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
        one, other = (-boxes.half[:, axis] - place) / safe, (boxes.half[:, axis] - place) / safe
        first = jnp.minimum(one, other)
        cosine = jnp.where(first > enter, jnp.abs(along), cosine)
        enter, leave = jnp.maximum(enter, first), jnp.minimum(leave, jnp.maximum(one, other))
    far = jnp.where((enter <= leave) & boxes.mask, enter, jnp.inf)
    return _chosen(far, cosine, boxes.colour.mean(-1))


def _rounds(rounds: Rounds, origin: jax.Array, way: jax.Array) -> Returns:
    far = round_hits(rounds, origin, way)  # (R, K)
    point = (origin[:, None] - rounds.centre) + jnp.where(jnp.isfinite(far), far, 0.0)[..., None] * way[:, None]
    along = jnp.sum(point * rounds.axis, -1)
    flat = ~rounds.capsule & (jnp.abs(along) > rounds.half - 1e-3)
    normal = point - jnp.clip(along, -rounds.half, rounds.half)[..., None] * rounds.axis
    normal = jnp.where(flat[..., None], rounds.axis, normal)
    cosine = jnp.abs(jnp.sum(normal * way[:, None], -1)) / jnp.maximum(jnp.linalg.norm(normal, axis=-1), 1e-9)
    return _chosen(far, cosine, rounds.colour.mean(-1))


def _chosen(far: jax.Array, cosine: jax.Array, albedo: jax.Array) -> Returns:
    """The nearest of P things (R, P) for each ray; `albedo` is (P,)."""
    index = jnp.argmin(far, -1)[:, None]
    near, cosine = (jnp.take_along_axis(leaf, index, -1)[:, 0] for leaf in (far, cosine))
    return Returns(near, cosine, albedo[index[:, 0]])
