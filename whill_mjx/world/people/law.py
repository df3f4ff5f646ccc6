"""How people walk: the anticipation velocity model, with the vehicle as one more neighbour.

Source: Xu, Chraibi and Seyfried, "Anticipation in a velocity-based model for pedestrian dynamics" (2021),
Transportation Research Part C 133; equation numbers are its own. The speed follows from the room ahead and a time gap
(Tordeux, Chraibi and Seyfried 2016), so that people who follow one another keep their distance. The direction turns
aside from those whom a person is about to meet. All functions are of one instance.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from whill_mjx.world.people.crowd import RADIUS, TRUNK, People

STRENGTH, REACH = 3.0, 0.1
"""Strength [-] and range [m] of the repulsion between people (k and D of Eq. 3)."""
ANTICIPATION, REACTION = 1.0, 0.3
"""Time over which people look ahead, and in which they turn [s] (t_a and tau)."""
ALIGNMENT = 0.5
"""How much more those who come towards a person count (Eq. 4)."""
BUFFER = 0.1
"""Distance from a wall at which people walk along it [m]."""
PUSH = 0.3
"""Share of the direction that then leads away from the wall."""
ASIDE = 0.02
"""Least play between people who stand one behind the other [m]."""
SQUEEZE = 0.2
"""Least distance sideways at which people pass one another: they turn their shoulders [m]."""
STEP = 0.1
"""Longest step of the model [s]."""
ARRIVED = 0.5
"""Distance from a point of the route at which the next one counts [m]."""


class Near(NamedTuple):
    """Nearest point of each of M standing things to each person."""

    point: jax.Array  # (N, M, 2) m
    mask: jax.Array  # (N, M) bool: False does not count


class Mover(NamedTuple):
    """The vehicle as people meet it: a rectangle that moves."""

    centre: jax.Array  # (2,) m
    axis: jax.Array  # (2,) unit vector ahead
    half: jax.Array  # (2,) m half length, half width
    velocity: jax.Array  # (2,) m/s of its centre
    yaw_rate: jax.Array  # () rad/s


def walk(people: People, near, mover: Mover | None, duration: float) -> People:
    """People after a time, with the vehicle moving on evenly.

    Args:
        people: before.
        near: (N, 2) places -> `Near`; what stands around.
        mover: the vehicle at the beginning; None is none.
        duration: static [s].
    """
    steps = max(1, math.ceil(duration / STEP - 1e-9))
    dt = duration / steps
    for _ in range(steps):
        people = _one_step(people, near, mover, dt)
        if mover is not None:
            mover = _later(mover, dt)
    return people


def _one_step(people: People, near, mover: Mover | None, dt: float) -> People:
    people = _next_targets(people)
    row = jnp.arange(people.speed.shape[0])
    goal = people.route[row, people.target]
    to_goal = goal - people.position
    far = _length(to_goal)
    desired = to_goal / jnp.maximum(far, 1e-6)[:, None]
    looks = jnp.stack([jnp.cos(people.heading), jnp.sin(people.heading)], -1)

    turned = desired + _aside_from_people(people, desired, looks)
    if mover is not None:
        turned += _aside_from_mover(people, desired, looks, mover)
    turned = _unit(turned, looks)
    back = _dot(desired, turned) * _dot(desired, looks) < 0.0
    eased = _unit(looks + (turned - looks) * (dt / REACTION), turned)  # Eq. 7
    way = jnp.where(back[:, None], turned, eased)

    if mover is not None:  # to those who yield, it is a wall beside which they walk
        side = Near(nearest_on(mover, people.position)[:, None], people.yields[:, None])
        way = _along_walls(people.position, way, side, _berth(people))
    room = _room_among_people(people, way)
    if mover is not None:
        room = jnp.minimum(room, _room_to_mover(people, way, mover))
    speed = jnp.clip(room / people.gap, 0.0, people.speed)
    standing = near(people.position)
    way = _along_walls(people.position, way, standing, RADIUS)

    scripted = people.scripted[:, None]
    way = jnp.where(scripted, desired, way)
    speed = jnp.where(people.scripted, people.speed, speed)
    last = jnp.where(people.onward, people.route.shape[1] - 1, 0)
    ends = ~people.returns & (people.target == last)
    speed = jnp.where(ends, jnp.minimum(speed, far / dt), speed) * people.there
    place = people.position + dt * speed[:, None] * way
    if mover is not None:
        place = place + _short_of_walls(place, _off_mover(people, place, mover, dt), people.position, standing)
    place = jnp.where(scripted, place, _out_of_walls(place, near))
    return moved_to(people, place, dt, way)


def moved_to(people: People, place: jax.Array, dt: float, way: jax.Array | None = None) -> People:
    """People at new places (N, 2) after `dt` [s], looking along `way` (N, 2), with the gait that belongs to it."""
    step = place - people.position
    gone = _length(step)
    speed = gone / dt
    heading = people.heading if way is None else jnp.arctan2(way[:, 1], way[:, 0])
    phase = people.phase + jnp.pi * gone / jnp.maximum(step_length(speed), 0.1)
    return dataclasses.replace(
        people, position=place, velocity=step / dt, heading=heading, phase=jnp.mod(phase, 2 * jnp.pi)
    )


def step_length(speed: jax.Array) -> jax.Array:
    """Length of a step [m] at a speed [m/s].

    Length and cadence are in a fixed proportion of 0.0065 m per step/min (Sekiya and Nagasaki 1998).
    """
    return jnp.sqrt(0.0065 * 60.0 * jnp.maximum(speed, 0.0))


def _next_targets(people: People) -> People:
    row = jnp.arange(people.speed.shape[0])
    last = people.route.shape[1] - 1
    far = _length(people.route[row, people.target] - people.position)
    there = far < ARRIVED
    at_end = people.target == jnp.where(people.onward, last, 0)
    turns = there & at_end & people.returns
    onward = people.onward ^ turns
    goes = there & (~at_end | people.returns)
    target = jnp.clip(people.target + jnp.where(goes, jnp.where(onward, 1, -1), 0), 0, last)
    return dataclasses.replace(people, target=target, onward=onward)


def _aside_from_people(people: People, desired: jax.Array, looks: jax.Array) -> jax.Array:
    """(N, 2) sum of the influences of all others (Eqs. 1 to 5)."""
    apart = people.position[None] - people.position[:, None]  # (N, N, 2): from each one to each other
    distance = _length(apart)
    other = ~jnp.eye(distance.shape[0], dtype=bool) & people.there
    own, theirs = people.velocity[:, None], people.velocity[None]
    person = Person(own, desired[:, None], looks[:, None])
    return _influence(person, Neighbour(apart, distance, 2 * RADIUS, other, theirs, looks[None], apart)).sum(1)


def _aside_from_mover(people: People, desired: jax.Array, looks: jax.Array, mover: Mover) -> jax.Array:
    """(N, 2) influence of the vehicle on those who yield."""
    nearest = nearest_on(mover, people.position)
    arm = nearest - mover.centre
    velocity = mover.velocity + mover.yaw_rate * jnp.stack([-arm[:, 1], arm[:, 0]], -1)
    apart = nearest - people.position
    drives = _unit(velocity, jnp.broadcast_to(mover.axis, velocity.shape))
    # Which side to pass is decided by the middle of the vehicle, for its nearest point lies straight ahead.
    vehicle = Neighbour(apart, _length(apart), RADIUS, people.yields, velocity, drives, mover.centre - people.position)
    return _influence(Person(people.velocity, desired, looks), vehicle)


class Person(NamedTuple):
    """Who is turned aside; vectors (..., 2)."""

    velocity: jax.Array  # [m/s]
    desired: jax.Array  # direction
    looks: jax.Array  # direction


class Neighbour(NamedTuple):
    """Who turns a person aside: another one, or the vehicle."""

    apart: jax.Array  # (..., 2) m, from the person to it
    distance: jax.Array  # (...) m
    contact: float  # distance at which both touch [m]
    counts: jax.Array  # (...) bool, whether it is one for this person
    velocity: jax.Array  # (..., 2) m/s
    looks: jax.Array  # (..., 2) direction
    beside: jax.Array  # (..., 2) m, from the person to the point that is passed on one side


def _influence(person: Person, neighbour: Neighbour) -> jax.Array:
    """(..., 2) the direction square to the desired one in which a neighbour turns a person, times its strength."""
    desired = person.desired
    towards = neighbour.apart / jnp.maximum(neighbour.distance, 1e-6)[..., None]
    perceived = (_dot(desired, towards) >= 0.0) | (_dot(person.looks, towards) >= 0.0)  # Eq. 1
    closing = _dot(person.velocity - neighbour.velocity, towards) * ANTICIPATION
    gap = jnp.maximum(neighbour.distance - neighbour.contact - closing, 0.0)  # Eq. 2
    strength = STRENGTH * (1.0 + ALIGNMENT * (1.0 - _dot(desired, neighbour.looks))) * jnp.exp(-gap / REACH)
    later = neighbour.beside + neighbour.velocity * ANTICIPATION
    left = jnp.stack([-desired[..., 1], desired[..., 0]], -1)
    side = jnp.where(_dot(left, later) >= 0.0, -1.0, 1.0)  # Eq. 5; to the right where it does not matter
    return jnp.where(perceived & neighbour.counts, strength * side, 0.0)[..., None] * left


def _room_among_people(people: People, way: jax.Array) -> jax.Array:
    """(N,) m: free length ahead of each person up to the next one (Eq. 8)."""
    apart = people.position[None] - people.position[:, None]
    contact = 2 * RADIUS + ASIDE
    ahead = _dot(apart, way[:, None])
    aside = apart[..., 1] * way[:, None, 0] - apart[..., 0] * way[:, None, 1]
    meets = (ahead >= 0.0) & (jnp.abs(aside) <= SQUEEZE) & people.there & ~jnp.eye(ahead.shape[0], dtype=bool)
    return jnp.min(jnp.where(meets, _length(apart) - contact, jnp.inf), -1, initial=jnp.inf)


def _room_to_mover(people: People, way: jax.Array, mover: Mover) -> jax.Array:
    """(N,) m: free length ahead up to the vehicle with a person's berth around it, for those who yield."""
    along, across = _own_frame(mover, people.position)
    ahead, aside = _own_frame(mover, mover.centre + way)
    enter, leave, berth = jnp.zeros(ahead.shape), jnp.full(ahead.shape, jnp.inf), _berth(people)
    for place, go, reach in ((along, ahead, mover.half[0] + berth), (across, aside, mover.half[1] + berth)):
        go = jnp.where(jnp.abs(go) < 1e-6, 1e-6, go)
        one, other = (-reach - place) / go, (reach - place) / go
        enter, leave = jnp.maximum(enter, jnp.minimum(one, other)), jnp.minimum(leave, jnp.maximum(one, other))
    inwards = _dot(nearest_on(mover, people.position) - people.position, way) > 0.0
    meets = (enter <= leave) & inwards & people.yields
    return jnp.where(meets, enter, jnp.inf)


def _off_mover(people: People, place: jax.Array, mover: Mover, dt: float) -> jax.Array:
    """(N, 2) m: a step off the vehicle for those who yield, from a place that is nearer after `dt` than their berth."""
    away = place - nearest_on(_later(mover, dt), place)
    lacking = jnp.maximum(_berth(people) - _length(away), 0.0)
    off = jnp.minimum(lacking, dt * people.speed) * (people.yields & people.there)
    return off[:, None] * _unit(away, jnp.zeros(away.shape))


def stepped_back(people: People, near, mover: Mover, time: jax.Array) -> jax.Array:
    """(N, 2) m by which people step straight off the vehicle in a time (N,) [s], as far as walls behind them let."""
    away = people.position - nearest_on(mover, people.position)
    step = (time * people.speed)[:, None] * _unit(away, jnp.zeros(away.shape))
    return _short_of_walls(people.position, step, people.position, near(people.position))


def _short_of_walls(place: jax.Array, step: jax.Array, seen_from: jax.Array, near: Near) -> jax.Array:
    """(N, 2) m: what of a step from a place leads no nearer to walls than the radius of a person, if it was farther.

    A thin wall has no inside from which a person could be pushed back, so nobody may come to its other side. Whatever
    stands is convex: it lies behind the line through its nearest point `near`, square to the way to `seen_from`.
    """
    away = seen_from[:, None] - near.point
    normal = away / _length(away)[..., None]
    free = jnp.maximum(_dot(place[:, None] - near.point, normal) - RADIUS, 0.0)
    for _ in range(2):
        into = jnp.where(near.mask, -_dot(step[:, None], normal) - free, 0.0)  # (N, M) m
        worst = jnp.argmax(into, -1)[:, None]
        outward = jnp.take_along_axis(normal, worst[..., None], 1)[:, 0]
        step = step + jnp.maximum(jnp.take_along_axis(into, worst, 1), 0.0) * outward
    return step


def _later(mover: Mover, time: float) -> Mover:
    """The vehicle after a time [s] in which it moves on evenly."""
    c, s = jnp.cos(time * mover.yaw_rate), jnp.sin(time * mover.yaw_rate)
    axis = jnp.stack([c * mover.axis[0] - s * mover.axis[1], s * mover.axis[0] + c * mover.axis[1]])
    return mover._replace(centre=mover.centre + time * mover.velocity, axis=axis)


def _berth(people: People) -> jax.Array:
    """(N,) m between the middle of a person and the vehicle's border, as those who yield keep it."""
    return TRUNK * people.height + ASIDE


def _along_walls(place: jax.Array, way: jax.Array, near: Near, radius: jax.Array | float) -> jax.Array:
    """(N, 2) direction without what leads into a wall near a person of a radius [m], the most opposed wall first."""
    away = place[:, None] - near.point
    distance = _length(away)
    normal = away / jnp.maximum(distance, 1e-6)[..., None]
    close = (distance <= jnp.expand_dims(radius, -1) + BUFFER) & near.mask
    for _ in range(2):
        into = jnp.where(close, _dot(normal, way[:, None]), 0.0)  # (N, M)
        worst = jnp.argmin(into, -1)[:, None]
        most = jnp.take_along_axis(into, worst, 1)  # (N, 1)
        outward = jnp.take_along_axis(normal, worst[..., None], 1)[:, 0]
        slid = _unit(way - most * outward + PUSH * outward, way)
        way = jnp.where(most < 0.0, slid, way)
    return way


def _out_of_walls(place: jax.Array, near) -> jax.Array:
    """(N, 2) places at least the radius of a person away from everything that stands."""
    for _ in range(2):
        found = near(place)
        away = place[:, None] - found.point
        distance = jnp.where(found.mask, _length(away), jnp.inf)
        worst = jnp.argmin(distance, -1)[:, None]
        least = jnp.take_along_axis(distance, worst, 1)
        outward = jnp.take_along_axis(away, worst[..., None], 1)[:, 0] / jnp.maximum(least, 1e-6)
        place = place + jnp.where(jnp.isfinite(least), jnp.maximum(RADIUS - least, 0.0), 0.0) * outward
    return place


def _own_frame(mover: Mover, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Places (N, 2) in the vehicle's frame: ahead (N,) and to the left (N,) [m]."""
    off = place - mover.centre
    return _dot(off, mover.axis), off[..., 1] * mover.axis[0] - off[..., 0] * mover.axis[1]


def nearest_on(mover: Mover, place: jax.Array) -> jax.Array:
    """(N, 2) m: the vehicle's nearest point to each place."""
    along, across = _own_frame(mover, place)
    along, across = jnp.clip(along, -mover.half[0], mover.half[0]), jnp.clip(across, -mover.half[1], mover.half[1])
    left = jnp.stack([-mover.axis[1], mover.axis[0]])
    return mover.centre + along[:, None] * mover.axis + across[:, None] * left


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def _length(vector: jax.Array) -> jax.Array:
    return jnp.sqrt(_dot(vector, vector) + 1e-12)


def _unit(vector: jax.Array, otherwise: jax.Array) -> jax.Array:
    length = _length(vector)[..., None]
    return jnp.where(length > 1e-5, vector / length, otherwise)
