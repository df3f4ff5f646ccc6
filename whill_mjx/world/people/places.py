"""Where people of an episode begin and where they walk, in any scene: between points that are in sight of each other.

Maps have ways of their own (`whill_mjx.world.maps.ways`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from whill_mjx.world.lidar import first_hits
from whill_mjx.world.people.crowd import Crowd, People, people_on
from whill_mjx.world.scene import Scene

TRIES = 4
"""Places drawn for each person."""
RAYS = 8
"""Directions of which a person takes the one that leads farthest."""
MARGIN = 0.4
"""Distance from whatever ends a way [m]."""
APART = 0.7
"""Least distance of two people at the start [m]."""
HEIGHT = 0.3
"""At which the sight is free [m]."""


def in_sight(key: jax.Array, scene: Scene, start: jax.Array, crowd: Crowd) -> People:
    """People who walk to and fro between two points in sight, the first of which the vehicle sees at the start.

    Args:
        key: random key.
        scene: without people.
        start: (3,) or (2,) of the vehicle [m].
        crowd: how many, how far away, and what they are like. Those who find no place are not there.
    """
    angle_key, far_key, way_key, key = jax.random.split(key, 4)
    tried = TRIES * crowd.count
    angle = jax.random.uniform(angle_key, (tried,), maxval=2 * jnp.pi)
    free = jnp.minimum(first_hits(scene, start[0], start[1], angle, HEIGHT) - MARGIN, crowd.within)
    far = free * jnp.sqrt(jax.random.uniform(far_key, (tried,)))
    place = start[:2] + far[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    chosen = chosen_apart(place, far >= crowd.clear, crowd.count)
    begin, there = place[chosen[0]], chosen[1]

    angles = jax.random.uniform(way_key, (crowd.count, RAYS), maxval=2 * jnp.pi)
    x, y = (jnp.repeat(begin[:, axis], RAYS) for axis in range(2))
    reach = jnp.minimum(first_hits(scene, x, y, angles.ravel(), HEIGHT) - MARGIN, crowd.within).reshape(-1, RAYS)
    best = jnp.argmax(reach, -1)[:, None]
    angle, length = (jnp.take_along_axis(leaf, best, 1)[:, 0] for leaf in (angles, reach))
    end = begin + jnp.maximum(length, 0.0)[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    return people_on(key, crowd, jnp.stack([begin, end], 1), jnp.zeros(crowd.count, jnp.int32), there)


def chosen_apart(place: jax.Array, fits: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """The first `count` of (C, 2) places that fit (C,) and are no nearer than `APART` to an earlier one that fits.

    Returns:
        Their indices (count,), and which of them (count,) are such.
    """
    apart = jnp.sqrt(jnp.sum((place[:, None] - place[None]) ** 2, -1))
    earlier = jnp.tril(jnp.ones(apart.shape, bool), -1) & fits[None]
    good = fits & ~jnp.any(earlier & (apart < APART), -1)
    order = jnp.argsort(~good, stable=True)[:count]
    return order, good[order]
