"""People of one instance: where they are, where they walk to, and what differs between them."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.io.fields import Field, check_fields

RADIUS = 0.16
"""Radius of a person on the ground plane, as others keep clear of it [m]. Source: Xu, Chraibi and Seyfried (2021)."""
TRUNK = 0.115
"""Radius of a person's trunk, as a share of the height: nothing of a person who stands is wider."""
SPEED, SPEED_SPREAD = 1.34, 0.26
"""Mean and standard deviation of the speed at which people walk freely [m/s]. Source: Weidmann (1993)."""
GAP = 0.5
"""Mean time gap that people keep to whom they follow [s]; `benchmarks.people` compares it with recorded corridors."""


@struct.dataclass
class People:
    """N people. Places and velocities change from step to step; the rest is drawn once for an episode."""

    position: jax.Array  # (N, 2) m
    velocity: jax.Array  # (N, 2) m/s
    heading: jax.Array  # (N,) rad, where they look and lean
    phase: jax.Array  # (N,) rad of the gait; pi is one step
    target: jax.Array  # (N,) int32, the point of the route that they walk to
    onward: jax.Array  # (N,) bool: along the route, else back
    route: jax.Array  # (N, W, 2) m, points of the way
    speed: jax.Array  # (N,) m/s, free walking speed
    gap: jax.Array  # (N,) s, time gap to whom they follow
    height: jax.Array  # (N,) m
    yields: jax.Array  # (N,) bool: makes way for the vehicle
    scripted: jax.Array  # (N,) bool: follows the route at its speed, whoever stands in the way
    returns: jax.Array  # (N,) bool: walks to and fro; else stops at the route's end
    there: jax.Array  # (N,) bool: False is neither seen nor met
    held: jax.Array  # (N,) bool: has walked into the vehicle, which did not move towards them, in this episode
    bumped: jax.Array  # (N,) bool: did so for the first time in the last step


@dataclass(frozen=True)
class Crowd:
    """What people of an episode are like."""

    count: int = 8
    within: float = 10.0
    """Greatest distance from the vehicle's start [m]."""
    clear: float = 1.5
    """Least distance from it [m]."""
    yielding: float = 0.5
    """Share of people who make way for the vehicle; the others walk as if it were not there, until they touch it."""
    speed: float = SPEED
    speed_spread: float = SPEED_SPREAD
    gap: float = GAP

    def __post_init__(self) -> None:
        check_fields("crowd", FIELDS, self)


FIELDS = (
    Field("count", kind="whole", low=0, high=200),
    Field("within", "m", 0.5, 1e3),
    Field("clear", "m", 0.0, 1e3),
    Field("yielding", "-", 0.0, 1.0),
    Field("speed", "m/s", 0.05, 5.0),
    Field("speed_spread", "m/s", 0.0, 2.0),
    Field("gap", "s", 0.05, 10.0),
)


def people_on(key: jax.Array, crowd: Crowd, route: jax.Array, start: jax.Array, there: jax.Array) -> People:
    """People on given routes, who differ in speed, time gap, height and whether they yield.

    Args:
        key: random key.
        crowd: their distributions.
        route: (N, W, 2) points of each way [m]; they walk to and fro.
        start: (N,) int32, the point at which each one begins; they first walk to the next.
        there: (N,) bool.
    """
    count, points = route.shape[:2]
    speed_key, height_key, yield_key, gait_key, way_key = jax.random.split(key, 5)
    onward = jax.random.bernoulli(way_key, 0.5, (count,))
    target = jnp.where(onward, start + 1, start - 1)
    onward = jnp.where((target < 0) | (target >= points), ~onward, onward)
    target = jnp.clip(jnp.where(onward, start + 1, start - 1), 0, points - 1)
    row = jnp.arange(count)
    position = route[row, start]
    ahead = route[row, target] - position
    deviation = jnp.clip(jax.random.normal(speed_key, (count,)), -2.0, 2.0)
    speed = jnp.maximum(crowd.speed + crowd.speed_spread * deviation, 0.3 * crowd.speed)
    heading = jnp.arctan2(ahead[:, 1], ahead[:, 0])
    return People(
        position=position,
        velocity=speed[:, None] * jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1),
        heading=heading,
        phase=jax.random.uniform(gait_key, (count,), maxval=2 * jnp.pi),
        target=target.astype(jnp.int32),
        onward=onward,
        route=route,
        speed=speed,
        gap=jnp.full(count, crowd.gap),
        height=1.7 + 0.09 * jnp.clip(jax.random.normal(height_key, (count,)), -2.0, 2.0),
        yields=jax.random.uniform(yield_key, (count,)) < crowd.yielding,
        scripted=jnp.zeros(count, bool),
        returns=jnp.ones(count, bool),
        there=there,
        held=jnp.zeros(count, bool),
        bumped=jnp.zeros(count, bool),
    )


def scripted(route: jax.Array, speed: float | jax.Array, returns: bool = False, height: float = 1.7) -> People:
    """People who walk along given routes (N, W, 2) [m] at a given speed [m/s], whoever stands in their way."""
    route = jnp.asarray(route, jnp.float32)
    count = route.shape[0]
    ahead = route[:, 1] - route[:, 0]
    heading = jnp.arctan2(ahead[:, 1], ahead[:, 0])
    speed = jnp.broadcast_to(jnp.asarray(speed, jnp.float32), (count,))
    yes, no = jnp.ones(count, bool), jnp.zeros(count, bool)
    return People(
        position=route[:, 0],
        velocity=speed[:, None] * jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1),
        heading=heading,
        phase=jnp.zeros(count),
        target=jnp.ones(count, jnp.int32),
        onward=yes,
        route=route,
        speed=speed,
        gap=jnp.full(count, GAP),
        height=jnp.full(count, height),
        yields=no,
        scripted=yes,
        returns=jnp.full(count, returns),
        there=yes,
        held=no,
        bumped=no,
    )


def join(*groups: People) -> People:
    """Several groups as one; shorter routes stand still at their last point."""
    longest = max(group.route.shape[1] for group in groups)

    def padded(group: People) -> People:
        rest = longest - group.route.shape[1]
        return group.replace(route=jnp.pad(group.route, ((0, 0), (0, rest), (0, 0)), mode="edge"))  # type: ignore[attr-defined]

    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *map(padded, groups))
