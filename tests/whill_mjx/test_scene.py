"""Collision and clearance of the vehicle's rectangle with boxes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.world.scene import Boxes, box, clearance, collides, footprint, no_boxes, overlaps, stack_boxes
from whill_mjx.world.solids import post

pytestmark = pytest.mark.quick
GREY = jnp.full(3, 0.5)
AHEAD = -WHILL_CR.reference_x  # chassis origin ahead of the driven axle [m]
FRONT = AHEAD + 0.985 / 2  # of the WHILL, ahead of its driven axle [m]


def whill(x=0.0, y=0.0, yaw=0.0):
    return footprint(WHILL_CR, jnp.asarray(x), jnp.asarray(y), jnp.asarray(yaw))


def test_footprint_is_centred_at_the_chassis_origin_ahead_of_the_driven_axle():
    turned = whill(1.0, 2.0, jnp.pi / 2)
    np.testing.assert_allclose([turned.x, turned.y], [1.0, 2.0 + AHEAD], atol=1e-6)


@pytest.mark.parametrize(("gap", "hit"), [(0.01, False), (-0.01, True)])
def test_vehicle_touches_a_wall_ahead_exactly_at_its_front(gap, hit):
    wall = box(FRONT + gap + 0.1, 0.0, 0.2, 3.0, 1.0, GREY)
    assert bool(collides(whill(), wall)) == hit
    np.testing.assert_allclose(clearance(whill(), wall), max(gap, 0.0), atol=1e-6)


@pytest.mark.parametrize(("gap", "hit"), [(0.01, False), (-0.01, True)])
def test_corner_of_a_turned_box_counts_and_not_its_bounding_rectangle(gap, hit):
    side = 0.554 / 2 + gap
    diamond = box(AHEAD, side + 0.5 * np.sqrt(2) / 2, 0.5, 0.5, 1.0, GREY, yaw=jnp.pi / 4)
    assert bool(collides(whill(), diamond)) == hit
    beside_corner = box(FRONT + 0.2, 0.554 / 2 + 0.2, 0.5, 0.5, 1.0, GREY, yaw=jnp.pi / 4)
    assert not bool(collides(whill(), beside_corner))  # although their axis-aligned bounds overlap


def test_clearance_between_corners_is_the_straight_distance():
    np.testing.assert_allclose(
        clearance(whill(), box(FRONT + 0.3 + 0.1, 0.554 / 2 + 0.4 + 0.1, 0.2, 0.2, 1.0, GREY)), 0.5, atol=1e-6
    )


def test_unused_and_overhead_boxes_are_not_hit():
    unused = box(0.3, 0.0, 1.0, 1.0, 1.0, GREY, mask=False)
    overhead = Boxes(jnp.array([[0.3, 0.0, 2.0]]), jnp.full((1, 3), 0.5), jnp.zeros(1), GREY[None], jnp.ones(1, bool))
    both = stack_boxes([unused, overhead])
    assert not bool(collides(whill(), both))
    assert jnp.isinf(clearance(whill(), both))
    assert jnp.isinf(clearance(whill(), no_boxes(0)))


def test_overlap_agrees_with_points_sampled_over_both_rectangles():
    keys = jax.random.split(jax.random.key(0), 3)
    count = 200
    tall = jnp.full((count, 1), 0.5)
    centre = jnp.concatenate([jax.random.uniform(keys[0], (count, 2), minval=-1.2, maxval=1.2), tall], 1)
    half = jnp.concatenate([jax.random.uniform(keys[1], (count, 2), minval=0.1, maxval=0.6), tall], 1)
    yaw = jax.random.uniform(keys[2], (count,), maxval=6.0)
    boxes = Boxes(centre, half, yaw, jnp.zeros((count, 3)), jnp.ones(count, bool))
    found = np.asarray(overlaps(whill(0.0, 0.0, 0.4), boxes))
    vehicle = whill(0.0, 0.0, 0.4)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 161), np.linspace(-1, 1, 161)), -1).reshape(-1, 2)

    def world(x, y, angle, hx, hy):
        local = grid * [hx, hy]
        c, s = np.cos(angle), np.sin(angle)
        return np.array([x, y]) + local @ np.array([[c, s], [-s, c]])

    own = world(vehicle.x, vehicle.y, 0.4, vehicle.half_length, vehicle.half_width)
    disagreements = 0
    for i in range(count):
        c, s = np.cos(yaw[i]), np.sin(yaw[i])
        local = (own - np.asarray(centre[i, :2])) @ np.array([[c, -s], [s, c]])
        sampled = bool(np.any(np.all(np.abs(local) <= np.asarray(half[i, :2]), axis=1)))
        assert found[i] or not sampled  # a common point proves the overlap
        disagreements += found[i] != sampled
    assert 20 < found.sum() < 180
    assert disagreements <= 3  # overlaps thinner than the sampling


@pytest.mark.parametrize("size", [-0.4, 0.0, float("nan"), float("inf")])
def test_a_thing_of_no_size_is_refused_with_the_name_of_the_size(size):
    with pytest.raises(ValueError, match="width is .* must be above 0"):
        box(0.0, 0.0, 1.0, size, 1.0, (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="radius is .* must be above 0"):
        post(0.0, 0.0, 1.0, size, (1.0, 0.0, 0.0))


def test_a_box_that_is_not_there_may_have_no_size():
    assert not box(0.0, 0.0, 0.0, 0.0, 0.0, GREY, mask=False).mask.any()
