"""Contact over a whole step: known distances, an independent dense test, and nothing that gets in deeper than 1 cm."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.collision import (
    Obstacles,
    Stadiums,
    distances,
    first_contact,
    from_above,
    poses_between,
    touches,
)
from whill_mjx.world.maps import FREE, OCCUPIED, GridMap, distance_field
from whill_mjx.world.scene import Footprint, box, no_boxes, stack_boxes
from whill_mjx.world.solids import person, post, rod, stack_rounds

pytestmark = pytest.mark.quick
HALF_LENGTH, HALF_WIDTH = 0.4925, 0.277
SPEED, YAW_RATE, PERIOD = 1.67, 1.0, 0.1
POSES = poses_between(SPEED, YAW_RATE, PERIOD, HALF_LENGTH, HALF_WIDTH)
one = partial(jnp.asarray, dtype=jnp.float32)


def chair(x, y, yaw):
    return Footprint(one(x), one(y), one(yaw), one(HALF_LENGTH), one(HALF_WIDTH), one(0.9))


def stadiums(start, end, radius):
    start, end = jnp.atleast_2d(one(start)), jnp.atleast_2d(one(end))
    count = start.shape[0]
    return Stadiums(start, end, jnp.broadcast_to(one(radius), count), jnp.zeros(count), jnp.ones(count, bool))


NOTHING = stadiums(np.zeros((0, 2)), np.zeros((0, 2)), 0.0)


@pytest.mark.parametrize(("start", "end", "radius", "expected"), [
    ((1.0, -1.0), (1.0, 1.0), 0.0, 1.0 - HALF_LENGTH),  # a wall ahead
    ((-3.0, 0.5), (3.0, 0.5), 0.0, 0.5 - HALF_WIDTH),  # beside
    ((-3.0, 0.1), (3.0, 0.1), 0.0, 0.0),  # through the middle, both ends outside
    ((1.0, 1.0), (1.0, 1.0), 0.2, np.hypot(1.0 - HALF_LENGTH, 1.0 - HALF_WIDTH) - 0.2),  # a post off a corner
    ((0.8, 0.0), (0.8, 0.0), 0.25, 0.8 - HALF_LENGTH - 0.25), ((0.7, 0.0), (0.7, 0.0), 0.25, -0.0425),
    ((0.9, 0.0), (0.0, 0.9), 0.0, abs(HALF_LENGTH + HALF_WIDTH - 0.9) / np.sqrt(2)),  # across a corner
])  # fmt: skip
def test_distances_have_their_known_values(start, end, radius, expected):
    for yaw in (0.0, 0.7, -2.5):  # the whole picture turned and moved
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        shape = stadiums(turn @ start + [2.0, -1.0], turn @ end + [2.0, -1.0], radius)
        assert float(distances(chair(2.0, -1.0, yaw), shape)[0]) == pytest.approx(expected, abs=2e-6)


def test_what_stands_above_the_vehicle_is_driven_under():
    bar = from_above(rod((0.0, -2.0, 1.4), (0.0, 2.0, 1.4), 0.1, (0.5, 0.5, 0.5)))
    low = from_above(rod((0.0, -2.0, 0.9), (0.0, 2.0, 0.9), 0.1, (0.5, 0.5, 0.5)))
    assert not bool(touches(chair(0.0, 0.0, 0.0), Obstacles(no_boxes(1), bar)))
    assert bool(touches(chair(0.0, 0.0, 0.0), Obstacles(no_boxes(1), low)))


def test_a_person_and_a_post_are_hit_at_their_radius():
    shapes = from_above(stack_rounds([person(1.0, 0.0, 1.7), post(-1.0, 0.0, 1.0, 0.06, (0.9, 0.7, 0.1))]))
    gap = distances(chair(0.0, 0.0, 0.0), shapes)
    assert float(gap[1]) == pytest.approx(1.0 - HALF_LENGTH - 0.125 * 1.7, abs=1e-5)  # the trunk
    assert float(gap[3]) == pytest.approx(1.0 - HALF_LENGTH - 0.06, abs=1e-5)


def field_of_a_block(size=0.05):
    """Distance field of a room of 4 x 4 m with a block from (2, 1.8) to (2.2, 2.2)."""
    cells = np.full((80, 80), FREE, np.uint8)
    cells[36:44, 40:44] = OCCUPIED
    return distance_field(GridMap(cells, size, (0.0, 0.0, 0.0)))


def obstacle(kind):
    """A thing near (2, 2), and the shape of which the depth is measured exactly."""
    if kind == "thin wall":
        return Obstacles(stack_boxes([box(2.0, 2.0, 0.005, 3.0, 1.0, (0.5, 0.5, 0.5))]), NOTHING)
    if kind == "box corner":
        return Obstacles(stack_boxes([box(2.0, 2.0, 0.5, 0.5, 1.0, (0.5, 0.5, 0.5), 0.6)]), NOTHING)
    if kind == "person":
        return Obstacles(no_boxes(1), from_above(person(2.0, 2.0)))
    if kind == "map wall":
        return Obstacles(no_boxes(1), stadiums((2.0, 0.5), (2.1, 3.5), 0.0))
    return Obstacles(no_boxes(1), NOTHING, field_of_a_block())


def tries(kind, count, key=0):
    """Starts that touch nothing, and where a step at full speed leads from them."""
    keys = jax.random.split(jax.random.key(key), 3)
    angle = jax.random.uniform(keys[0], (count,), minval=-np.pi, maxval=np.pi)
    far = jax.random.uniform(keys[1], (count,), minval=0.6, maxval=1.0)  # not around it
    yaw, speed, turn = jax.random.uniform(keys[2], (3, count), minval=-1.0)
    x, y, yaw = 2.0 + far * jnp.cos(angle), 2.0 + far * jnp.sin(angle), np.pi * yaw
    speed = SPEED * jnp.sign(speed)
    before = jax.vmap(chair)(x, y, yaw)
    middle, reach = yaw + turn * YAW_RATE * PERIOD / 2, speed * PERIOD
    after = jax.vmap(chair)(x + reach * jnp.cos(middle), y + reach * jnp.sin(middle), yaw + turn * YAW_RATE * PERIOD)
    free = ~jax.vmap(touches, in_axes=(0, None))(before, obstacle(kind))
    return before, after, free


def depth(kind, pose):
    """() m: least way out, at least, of the thing: how far the vehicle can shrink on all sides until it is free."""
    def touching(shrink):
        smaller = dataclasses.replace(pose, half_length=pose.half_length - shrink, half_width=pose.half_width - shrink)
        return touches(smaller, obstacle(kind))

    amounts = jnp.linspace(0.0, 0.015, 16)
    return jnp.sum(jax.vmap(touching)(amounts)) * 0.001


@pytest.mark.parametrize("kind", ["thin wall", "box corner", "person", "map wall", "field"])
def test_nothing_gets_in_deeper_than_a_centimetre_at_full_speed(kind):
    before, after, free = tries(kind, 300)

    @jax.jit
    @jax.vmap
    def drive(before, after):
        hit, share = first_contact(before, after, obstacle(kind), POSES)
        turn = after.yaw - before.yaw

        def at(share):
            return dataclasses.replace(after, x=before.x + share * (after.x - before.x),
                                       y=before.y + share * (after.y - before.y), yaw=before.yaw + share * turn)

        on_the_way = jax.lax.map(lambda s: depth(kind, at(s)), jnp.linspace(0.0, 1.0, 16) * share)
        return hit, share, jnp.max(on_the_way), touches(after, obstacle(kind))

    hit, share, deepest, ends_inside = (np.asarray(value)[np.asarray(free)] for value in drive(before, after))
    assert hit.sum() > 5 and (~hit).sum() > 5 and (share[~hit] == 1.0).all()
    assert (hit >= ends_inside).all()  # no contact at the end of a step goes unseen
    assert deepest.max() <= 0.01
    assert (share[hit] > 0.0).all() and deepest[hit].max() > 0.0
