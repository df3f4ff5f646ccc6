"""How people walk: the anticipation velocity model, with the vehicle as one more neighbour.

Source: Xu, Chraibi and Seyfried, "Anticipation in a velocity-based model for pedestrian dynamics" (2021),
Transportation Research Part C 133; equation numbers are its own. The speed follows from the room ahead and a time gap
(Tordeux, Chraibi and Seyfried 2016), so that people who follow one another keep their distance. The direction turns
aside from those whom a person is about to meet. All functions are of one instance.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.people.crowd import RADIUS, TRUNK, People
from whill_mjx.world.plane import Vector, choose, largest

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
    """Nearest point of each of M standing things to each of N people."""

    point: Vector  # (M, N) m
    mask: jax.Array  # (M, N) bool: False does not count


Surroundings = Callable[[jax.Array], Callable[[Vector], Near]]
"""What stands around: of places (N, 2), a function of places (N,) up to a step away from them."""


class Mover(NamedTuple):
    """The vehicle as people meet it: a rectangle that moves."""

    centre: jax.Array  # (2,) m
    axis: jax.Array  # (2,) unit vector ahead
    half: jax.Array  # (2,) m half length, half width
    velocity: jax.Array  # (2,) m/s of its centre
    yaw_rate: jax.Array  # () rad/s


def walk(people: People, near: Surroundings, mover: Mover | None, duration: float) -> People:
    """People after a time, with the vehicle moving on evenly.

    Args:
        people: before.
        near: what stands around.
        mover: the vehicle at the beginning; None is none.
        duration: static [s].
    """
    steps = max(1, math.ceil(duration / STEP - 1e-9))
    dt = duration / steps
    for _ in range(steps):
        people = _one_step(people, near(people.position), mover, dt)
        if mover is not None:
            mover = _later(mover, dt)
    return people


def _one_step(people: People, near: Callable[[Vector], Near], mover: Mover | None, dt: float) -> People:
    people = _next_targets(people)
    row = jnp.arange(people.speed.shape[0])
    here = Vector.of(people.position)
    to_goal = Vector.of(people.route[row, people.target]) - here
    far = to_goal.length
    desired = to_goal * (1.0 / jnp.maximum(far, 1e-6))
    looks = Vector.at_angle(people.heading)

    turned = desired + _aside_from_people(people, desired, looks)
    if mover is not None:
        turned += _aside_from_mover(people, desired, looks, mover)
    turned = turned.unit(looks)
    back = desired.dot(turned) * desired.dot(looks) < 0.0
    eased = (looks + (turned - looks) * (dt / REACTION)).unit(turned)  # Eq. 7
    way = choose(back, turned, eased)

    if mover is not None:  # to those who yield, it is a wall beside which they walk
        side = Near(_nearest_on(mover, here).at(None), people.yields[None])
        way = _along_walls(here, way, side, _berth(people))
    room = _room_among_people(people, way)
    if mover is not None:
        room = jnp.minimum(room, _room_to_mover(people, way, mover))
    speed = jnp.clip(room / people.gap, 0.0, people.speed)
    standing = near(here)
    way = _along_walls(here, way, standing, RADIUS)

    way = choose(people.scripted, desired, way)
    speed = jnp.where(people.scripted, people.speed, speed)
    last = jnp.where(people.onward, people.route.shape[1] - 1, 0)
    ends = ~people.returns & (people.target == last)
    speed = jnp.where(ends, jnp.minimum(speed, far / dt), speed) * people.there
    place = here + way * (dt * speed)
    if mover is not None:
        place = place + _short_of_walls(place, _off_mover(people, place, mover, dt), here, standing)
    place = choose(people.scripted, place, _out_of_walls(place, near))
    return moved_to(people, place.stacked(), dt, way)


def moved_to(people: People, place: jax.Array, dt: float, way: Vector | None = None) -> People:
    """People at new places (N, 2) after `dt` [s], looking along `way` (N,), with the gait that belongs to it."""
    step = place - people.position
    gone = Vector.of(step).length
    speed = gone / dt
    heading = people.heading if way is None else way.angle
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
    far = Vector.of(people.route[row, people.target] - people.position).length
    there = far < ARRIVED
    at_end = people.target == jnp.where(people.onward, last, 0)
    turns = there & at_end & people.returns
    onward = people.onward ^ turns
    goes = there & (~at_end | people.returns)
    target = jnp.clip(people.target + jnp.where(goes, jnp.where(onward, 1, -1), 0), 0, last)
    return dataclasses.replace(people, target=target, onward=onward)


def _aside_from_people(people: People, desired: Vector, looks: Vector) -> Vector:
    """(N,) sum of the influences of all others (Eqs. 1 to 5). In arrays (N, N) the person is last, the other first."""
    apart, distance, other = _others(people)
    velocity, before, own = Vector.of(people.velocity), np.s_[:, None], None
    person = Person(velocity.at(own), desired.at(own), looks.at(own))
    others = Neighbour(apart, distance, 2 * RADIUS, other, velocity.at(before), looks.at(before), apart)
    influence = _influence(person, others)
    return Vector(influence.x.sum(0), influence.y.sum(0))


def _others(people: People) -> tuple[Vector, jax.Array, jax.Array]:
    """(N, N) way [m] and distance [m] from each person (last) to each other, and whether that is one who is there."""
    here = Vector.of(people.position)
    apart = here.at(np.s_[:, None]) - here.at(None)
    other = ~jnp.eye(people.speed.shape[0], dtype=bool) & people.there[:, None]
    return apart, apart.length, other


def _aside_from_mover(people: People, desired: Vector, looks: Vector, mover: Mover) -> Vector:
    """(N,) influence of the vehicle on those who yield."""
    here, centre = Vector.of(people.position), Vector.of(mover.centre)
    nearest = _nearest_on(mover, here)
    velocity = Vector.of(mover.velocity) + (nearest - centre).left * mover.yaw_rate
    apart = nearest - here
    drives = velocity.unit(Vector.of(mover.axis))
    # Which side to pass is decided by the middle of the vehicle, for its nearest point lies straight ahead.
    vehicle = Neighbour(apart, apart.length, RADIUS, people.yields, velocity, drives, centre - here)
    return _influence(Person(Vector.of(people.velocity), desired, looks), vehicle)


class Person(NamedTuple):
    """Who is turned aside; vectors (...)."""

    velocity: Vector  # [m/s]
    desired: Vector  # direction
    looks: Vector  # direction


class Neighbour(NamedTuple):
    """Who turns a person aside: another one, or the vehicle."""

    apart: Vector  # (...) m, from the person to it
    distance: jax.Array  # (...) m
    contact: float  # distance at which both touch [m]
    counts: jax.Array  # (...) bool, whether it is one for this person
    velocity: Vector  # (...) m/s
    looks: Vector  # (...) direction
    beside: Vector  # (...) m, from the person to the point that is passed on one side


def _influence(person: Person, neighbour: Neighbour) -> Vector:
    """(...) the direction square to the desired one in which a neighbour turns a person, times its strength."""
    desired = person.desired
    towards = neighbour.apart * (1.0 / jnp.maximum(neighbour.distance, 1e-6))
    perceived = (desired.dot(towards) >= 0.0) | (person.looks.dot(towards) >= 0.0)  # Eq. 1
    closing = (person.velocity - neighbour.velocity).dot(towards) * ANTICIPATION
    gap = jnp.maximum(neighbour.distance - neighbour.contact - closing, 0.0)  # Eq. 2
    strength = STRENGTH * (1.0 + ALIGNMENT * (1.0 - desired.dot(neighbour.looks))) * jnp.exp(-gap / REACH)
    later = neighbour.beside + neighbour.velocity * ANTICIPATION
    side = jnp.where(desired.left.dot(later) >= 0.0, -1.0, 1.0)  # Eq. 5; to the right where it does not matter
    return desired.left * jnp.where(perceived & neighbour.counts, strength * side, 0.0)


def _room_among_people(people: People, way: Vector) -> jax.Array:
    """(N,) m: free length ahead of each person up to the next one (Eq. 8)."""
    apart, distance, other = _others(people)
    ahead, aside = apart.dot(way), way.cross(apart)
    meets = (ahead >= 0.0) & (jnp.abs(aside) <= SQUEEZE) & other
    return jnp.min(jnp.where(meets, distance - (2 * RADIUS + ASIDE), jnp.inf), 0, initial=jnp.inf)


def _room_to_mover(people: People, way: Vector, mover: Mover) -> jax.Array:
    """(N,) m: free length ahead up to the vehicle with a person's berth around it, for those who yield."""
    here, axis, berth = Vector.of(people.position), Vector.of(mover.axis), _berth(people)
    place, go = _own_frame(mover, here), Vector(axis.dot(way), axis.cross(way))
    enter, leave = jnp.zeros(berth.shape), jnp.full(berth.shape, jnp.inf)
    for at, by, half in ((place.x, go.x, mover.half[0]), (place.y, go.y, mover.half[1])):
        by = jnp.where(jnp.abs(by) < 1e-6, 1e-6, by)
        one, other = (-(half + berth) - at) / by, (half + berth - at) / by
        enter, leave = jnp.maximum(enter, jnp.minimum(one, other)), jnp.minimum(leave, jnp.maximum(one, other))
    inwards = (_nearest_on(mover, here) - here).dot(way) > 0.0
    meets = (enter <= leave) & inwards & people.yields
    return jnp.where(meets, enter, jnp.inf)


def _off_mover(people: People, place: Vector, mover: Mover, dt: float) -> Vector:
    """(N,) m: a step off the vehicle for those who yield, from a place that is nearer after `dt` than their berth."""
    away = place - _nearest_on(_later(mover, dt), place)
    lacking = jnp.maximum(_berth(people) - away.length, 0.0)
    off = jnp.minimum(lacking, dt * people.speed) * (people.yields & people.there)
    return away.unit(away * 0.0) * off


def stepped_back(people: People, near: Surroundings, mover: Mover, time: jax.Array) -> jax.Array:
    """(N, 2) m by which people step straight off the vehicle in a time (N,) [s], as far as walls behind them let."""
    here = Vector.of(people.position)
    away = here - _nearest_on(mover, here)
    step = away.unit(away * 0.0) * (time * people.speed)
    return _short_of_walls(here, step, here, near(people.position)(here)).stacked()


def _short_of_walls(place: Vector, step: Vector, seen_from: Vector, near: Near) -> Vector:
    """(N,) m: what of a step from a place leads no nearer to walls than the radius of a person, if it was farther.

    A thin wall has no inside from which a person could be pushed back, so nobody may come to its other side. Whatever
    stands is convex: it lies behind the line through its nearest point `near`, square to the way to `seen_from`.
    """
    away = seen_from - near.point
    normal = away * (1.0 / away.length)
    free = jnp.maximum((place - near.point).dot(normal) - RADIUS, 0.0)
    for _ in range(2):
        into = jnp.where(near.mask, -step.dot(normal) - free, 0.0)  # (M, N) m
        most, outward = largest(into, normal)
        step = step + outward * jnp.maximum(most, 0.0)
    return step


def _later(mover: Mover, time: float) -> Mover:
    """The vehicle after a time [s] in which it moves on evenly."""
    c, s = jnp.cos(time * mover.yaw_rate), jnp.sin(time * mover.yaw_rate)
    axis = jnp.stack([c * mover.axis[0] - s * mover.axis[1], s * mover.axis[0] + c * mover.axis[1]])
    return mover._replace(centre=mover.centre + time * mover.velocity, axis=axis)


def _berth(people: People) -> jax.Array:
    """(N,) m between the middle of a person and the vehicle's border, as those who yield keep it."""
    return TRUNK * people.height + ASIDE


def _along_walls(place: Vector, way: Vector, near: Near, radius: jax.Array | float) -> Vector:
    """(N,) direction without what leads into a wall near a person of a radius [m], the most opposed wall first."""
    away = place - near.point
    distance = away.length
    normal = away * (1.0 / jnp.maximum(distance, 1e-6))
    close = (distance <= radius + BUFFER) & near.mask
    for _ in range(2):
        most, outward = largest(jnp.where(close, -normal.dot(way), 0.0), normal)  # (N,)
        slid = (way + outward * (most + PUSH)).unit(way)
        way = choose(most > 0.0, slid, way)
    return way


def _out_of_walls(place: Vector, near: Callable[[Vector], Near]) -> Vector:
    """(N,) places at least the radius of a person away from everything that stands."""
    for _ in range(2):
        found = near(place)
        away = place - found.point
        nearness, outward = largest(jnp.where(found.mask, -away.length, -jnp.inf), away)
        far = jnp.isfinite(nearness)
        place = place + outward * (jnp.where(far, jnp.maximum(RADIUS + nearness, 0.0), 0.0)
                                   / jnp.where(far, jnp.maximum(-nearness, 1e-6), 1.0))  # fmt: skip
    return place


def _own_frame(mover: Mover, place: Vector) -> Vector:
    """Places (N,) in the vehicle's frame: ahead and to the left [m]."""
    off, axis = place - Vector.of(mover.centre), Vector.of(mover.axis)
    return Vector(axis.dot(off), axis.cross(off))


def nearest_on(mover: Mover, place: jax.Array) -> jax.Array:
    """(N, 2) m: the vehicle's nearest point to each place."""
    return _nearest_on(mover, Vector.of(place)).stacked()


def _nearest_on(mover: Mover, place: Vector) -> Vector:
    own, axis = _own_frame(mover, place), Vector.of(mover.axis)
    along, across = (jnp.clip(at, -half, half) for at, half in ((own.x, mover.half[0]), (own.y, mover.half[1])))
    return Vector.of(mover.centre) + axis * along + axis.left * across
