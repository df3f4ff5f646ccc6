"""Contact of the vehicle with people while both move, and whose it is.

A person who walks into a vehicle that stands is stopped by it, counted (`People.bumped`), and steps back from it, legs
together, for the rest of the period; the episode goes on. A contact is a collision of the vehicle where its own border
moves towards the person.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from whill_mjx.world.collision import HALVINGS, Stadiums, distances
from whill_mjx.world.people import body
from whill_mjx.world.people.around import mover_of, near_in
from whill_mjx.world.people.crowd import People, join
from whill_mjx.world.people.law import stepped_back, walk
from whill_mjx.world.scene import Footprint, Scene

Ends = tuple[jax.Array, jax.Array]
"""Both ends (N, PARTS, 3) [m] of the axes of people's capsules."""
Axes = tuple[jax.Array, ...]
"""x, y, z of one end and x, y, z of the other (N, TOUCHING) [m], of those that a vehicle can meet."""
STANDING = 0.05
"""Speed towards a person below which the vehicle stands, as far as contact is concerned [m/s]."""
FASTEST_FOOT = 4.8
"""Speed of a swinging foot at 1.9 m/s, the fastest walk of people by default [m/s]."""
DEPTH = 0.025
"""Way of any two points relative to each other between two tested poses [m].

A corner that grazes a leg of 7.6 cm radius between two of them gets DEPTH^2 / (8 r) = 1 mm deep unseen.
"""


def scene_without_people(scene: Scene) -> Scene:
    """What stands: the scene without its people."""
    if scene.people is None:
        return scene
    return dataclasses.replace(scene, solids=body.removed(scene.solids, scene.people), people=None)  # type: ignore[arg-type]


def scene_with_people(scene: Scene, people: People, key: jax.Array) -> Scene:
    """A scene with people in it, seen, scanned and hit; those that it has already stay."""
    added = people.speed.shape[0]
    if scene.people is not None:
        people = join(scene.people, people)
        scene = scene_without_people(scene)
    finish = scene.finish
    if finish is not None:  # people have no texture
        labels = (0, added * body.PARTS)
        finish = dataclasses.replace(
            finish, texture=jnp.pad(finish.texture, labels), scale=jnp.pad(finish.scale, labels, constant_values=1.0)
        )
    solids = body.added(scene.solids, people, key)
    return dataclasses.replace(scene, solids=solids, people=people, finish=finish)


def poses_among_people(speed: float, yaw_rate: float, duration: float, half_length: float, half_width: float) -> int:
    """Poses to test in one step, so that vehicle and people move at most `DEPTH` towards each other between two."""
    fastest = abs(speed) + abs(yaw_rate) * math.hypot(half_length, half_width) + FASTEST_FOOT
    return max(1, math.ceil(duration * fastest / DEPTH))


class Capsules(NamedTuple):
    """Those of N people over a period, in which the ends of their axes move evenly."""

    height: jax.Array  # (N,) m, of the people
    there: jax.Array  # (N,) bool
    first: Axes
    last: Axes


def _touching(ends: Ends) -> Axes:
    return tuple(end[:, : body.TOUCHING, axis] for end in ends for axis in range(3))


def _distances(capsules: Capsules, vehicle: Footprint, share: jax.Array) -> jax.Array:
    """(N,) m from a vehicle to each person at a share () of the period."""
    x0, y0, z0, x1, y1, z1 = (a + share * (b - a) for a, b in zip(capsules.first, capsules.last, strict=True))
    radius = capsules.height[:, None] * jnp.array(body.RADII)[: body.TOUCHING]
    low = jnp.minimum(z0, z1) - radius
    there = jnp.broadcast_to(capsules.there[:, None], low.shape)
    parts = (jnp.stack([x0, y0], -1), jnp.stack([x1, y1], -1), radius, low, there)
    stadiums = Stadiums(*(part.reshape(-1, *part.shape[2:]) for part in parts))
    far = distances(vehicle, stadiums)
    met = stadiums.mask & (stadiums.low < vehicle.height)
    return jnp.where(met, far, jnp.inf).reshape(-1, body.TOUCHING).min(-1)


class Touches(NamedTuple):
    """Where the vehicle first touches each person on its way."""

    touched: jax.Array  # (N,) bool
    low: jax.Array  # (N,) share of the way at which it does not yet
    high: jax.Array  # (N,) share at which it does
    nearer: jax.Array  # (N,) m by which it is then nearer than a whole period earlier, had the person stood there


def _first_touches(capsules: Capsules, vehicle: Callable[[jax.Array], Footprint], poses: int) -> Touches:
    """First touches of people by a vehicle, which is a function of the share () of the period."""
    shares = jnp.arange(1, poses + 1) / poses
    hits = jax.vmap(lambda share: _distances(capsules, vehicle(share), share) <= 0.0)(shares)  # (poses, N)
    touched, index = hits.any(0), jnp.argmax(hits, 0)
    low, high = index / poses, (index + 1) / poses

    @jax.vmap
    def own(capsule, share, back):
        return _distances(jax.tree.map(lambda leaf: leaf[None], capsule), vehicle(share - back), share)[0]

    now, earlier = jnp.zeros(touched.shape), jnp.ones(touched.shape)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        there = own(capsules, middle, now) <= 0.0
        low, high = jnp.where(there, low, middle), jnp.where(there, middle, high)
    # The distance is not 0 where the vehicle has crept into somebody who could not step back.
    nearer = own(capsules, high, earlier) - own(capsules, high, now)
    return Touches(touched, low, high, nearer)


def walk_around(
    scene: Scene, before: Footprint, after: Footprint, duration: float, poses: int
) -> tuple[Scene, jax.Array, jax.Array]:
    """People of a scene after a period, and what the vehicle met on its way from `before` to `after`.

    Args:
        scene: at the beginning.
        before, after: the vehicle at both ends; between them place and heading change evenly.
        duration: static [s].
        poses: static, from `poses_among_people`.

    Returns:
        The scene at the end; whether the vehicle ran into somebody (); the share () of its way until then, else 1.
    """
    people, solids = scene.people, scene.solids
    assert people is not None and solids is not None
    mover, near = mover_of(before, after, duration), near_in(scene_without_people(scene))
    walked = walk(people, near, mover, duration)
    first = body.ends_of(body.own_rounds(solids, people))
    # The barriers keep XLA from computing the walk and the contacts again for each thing that needs them.
    walked = jax.lax.optimization_barrier(walked)
    last = jax.lax.optimization_barrier(body.skeleton(walked))
    capsules = Capsules(people.height, people.there, _touching(first), _touching(last))
    turn = duration * mover.yaw_rate

    def vehicle(share):
        return dataclasses.replace(
            after,
            x=before.x + share * (after.x - before.x),
            y=before.y + share * (after.y - before.y),
            yaw=before.yaw + share * turn,
        )

    touched, low, high, nearer = _first_touches(capsules, vehicle, poses)
    ran_into = touched & (nearer > STANDING * duration)
    collided = ran_into.any()
    share = jnp.min(jnp.where(ran_into, high, 1.0), initial=1.0)
    kept = jnp.where(touched, jnp.minimum(low, share), share)  # (N,) how far each person gets
    kept, touched, ran_into = jax.lax.optimization_barrier((kept, touched, ran_into))
    stopped = touched & ~ran_into & (high <= share)  # the vehicle stops where it ran into somebody
    people_after = _between(people, walked, kept, stopped)
    start, end = (a + kept[:, None, None] * (b - a) for a, b in zip(first, last, strict=True))
    later = mover_of(vehicle(share), after, duration)
    back = stepped_back(people_after, near, later, jnp.where(stopped, (share - kept) * duration, 0.0))
    people_after = dataclasses.replace(people_after, position=people_after.position + back)
    start, end = (ends.at[..., :2].add(back[:, None]) for ends in (start, end))
    solids_after = body.moved(solids, people_after, start, end)
    return dataclasses.replace(scene, solids=solids_after, people=people_after), collided, share


def _between(before: People, after: People, share: jax.Array, stopped: jax.Array) -> People:
    """People at a share (N,) of their way; who was stopped stands, and knows of the vehicle from then on."""
    part = share[:, None]
    turn = jnp.mod(after.phase - before.phase, 2 * jnp.pi)
    return dataclasses.replace(
        after,
        position=before.position + part * (after.position - before.position),
        velocity=jnp.where(stopped[:, None], 0.0, after.velocity),
        phase=jnp.mod(before.phase + share * turn, 2 * jnp.pi),
        yields=after.yields | stopped,
        held=before.held | stopped,
        bumped=stopped & ~before.held,
    )
