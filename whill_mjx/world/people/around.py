"""What people keep clear of besides one another: the nearest points of boxes, walls and posts, and the vehicle."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from whill_mjx.world.collision import from_above
from whill_mjx.world.people.law import Mover, Near
from whill_mjx.world.scene import Boxes, Footprint, Scene
from whill_mjx.world.solids import Rounds

TALL = 1.9
"""What begins above this height is walked under [m]."""


def near_in(scene: Scene):
    """Function of places (N, 2) that gives the nearest points of everything that stands in a scene without people."""
    boxes, walls = scene.boxes, scene.walls
    if walls is not None:
        boxes = jax.tree.map(lambda leaf: leaf[: leaf.shape[0] - walls.keep], boxes)  # the rest are pictures of walls
    rounds = None if scene.solids is None else scene.solids.rounds

    def near(place: jax.Array) -> Near:
        found = [Near(jnp.zeros((place.shape[0], 1, 2)), jnp.zeros((place.shape[0], 1), bool))]
        if boxes.mask.shape[0]:
            found.append(_on_boxes(place, boxes))
        if walls is not None:
            index = jnp.asarray(walls.near)[walls.cell(place[:, 0], place[:, 1])]  # (N, M)
            segment = jnp.asarray(walls.segments)[jnp.maximum(index, 0)]
            found.append(Near(_on_segments(place, segment[:, :, 0], segment[:, :, 1]), index >= 0))
        if rounds is not None:
            found.append(_on_rounds(place, rounds))
        return Near(*(jnp.concatenate(parts, 1) for parts in zip(*found, strict=True)))

    return near


def _on_boxes(place: jax.Array, boxes: Boxes) -> Near:
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    dx, dy = place[:, None, 0] - boxes.centre[:, 0], place[:, None, 1] - boxes.centre[:, 1]  # (N, P)
    along = jnp.clip(dx * c + dy * s, -boxes.half[:, 0], boxes.half[:, 0])
    across = jnp.clip(dy * c - dx * s, -boxes.half[:, 1], boxes.half[:, 1])
    point = jnp.stack([along * c - across * s, along * s + across * c], -1) + boxes.centre[:, :2]
    there = boxes.mask & (boxes.centre[:, 2] - boxes.half[:, 2] < TALL)
    return Near(point, jnp.broadcast_to(there, point.shape[:2]))


def _on_segments(place: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    way = end - start
    square = jnp.maximum(jnp.sum(way**2, -1), 1e-12)
    share = jnp.clip(jnp.sum((place[:, None] - start) * way, -1) / square, 0.0, 1.0)
    return start + share[..., None] * way


def _on_rounds(place: jax.Array, rounds: Rounds) -> Near:
    seen = from_above(rounds)
    axis = _on_segments(place, seen.start[None], seen.end[None])
    away = place[:, None] - axis
    far = jnp.sqrt(jnp.sum(away**2, -1) + 1e-12)
    point = axis + away * (jnp.minimum(seen.radius, far) / far)[..., None]
    return Near(point, jnp.broadcast_to(seen.mask & (seen.low < TALL), point.shape[:2]))


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
