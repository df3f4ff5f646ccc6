"""The unnamed wrench: tables over one quantity of the motion."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import DT, motion_at, quick

from whill_mjx.effects import make_effect
from whill_mjx.effects.unnamed import ACROSS, KNOTS, QUANTITIES

NUMBER = {name: number for number, name in enumerate(QUANTITIES, start=1)}


def effect(quantity, forces=(), torques=(), **more):
    """The effect over a quantity, with the first knots given."""
    values = {f"force_{k}": value for k, value in enumerate(forces, start=1)}
    values |= {f"torque_{k}": value for k, value in enumerate(torques, start=1)}
    return make_effect("unnamed", quantity=float(NUMBER[quantity]), **values, **more)


def wrench_after(one, motion, seconds):
    """Wrench after that time in a steady motion."""
    memory = one.init()
    for _ in range(round(seconds / DT)):
        memory, _ = one.force(memory, motion)
    return one.force(memory, motion)[1]


@quick
@pytest.mark.parametrize(("speed", "force"), [(-2.0, 0.0), (0.0, 0.0), (0.5, 5.0), (1.0, 10.0), (1.5, 15.0),
                                              (30.0, 110.0)])
def test_tables_are_interpolated_and_hold_beyond_their_ends(speed, force):
    one = effect("speed", [10.0 * k for k in range(KNOTS)], low=0.0, high=float(KNOTS - 1))
    np.testing.assert_allclose(one.force(one.init(), motion_at(speed))[1].fx, force, atol=1e-3)


@quick
def test_a_push_keeps_its_direction_and_a_brake_turns_with_the_motion():
    for v in (0.5, -0.5):
        push, brake = (effect("time in the drive", [-6.0] * KNOTS, with_motion=share) for share in (0.0, 1.0))
        np.testing.assert_allclose(push.force(push.init(), motion_at(v))[1].fx, -6.0, rtol=1e-5)
        np.testing.assert_allclose(brake.force(brake.init(), motion_at(v))[1].fx, -6.0 * np.sign(v), rtol=1e-3)


@quick
def test_a_brake_slows_each_side_of_a_vehicle_that_turns_on_the_spot():
    one = effect("time in the drive", [-6.0] * KNOTS, with_motion=1.0)
    wrench = one.force(one.init(), motion_at(0.0, 0.8))[1]
    np.testing.assert_allclose(wrench.fx, 0.0, atol=1e-4)
    np.testing.assert_allclose(wrench.tz, -6.0 * motion_at().track / 2, rtol=1e-3)


@quick
def test_a_table_over_a_wheel_angle_repeats_with_every_turn():
    table = np.sin(np.arange(KNOTS) * 2 * np.pi / KNOTS)
    one = effect("left wheel's angle", 8.0 * table, 2.0 * table)
    motion = motion_at(0.6)
    turn = 2 * np.pi / float(motion.spin[0])
    early, late, half = (wrench_after(one, motion, part * turn) for part in (0.2, 1.2, 0.7))
    np.testing.assert_allclose(late.fx, early.fx, atol=0.1)
    np.testing.assert_allclose(half.fx, -early.fx, atol=0.1)
    np.testing.assert_allclose(early.tz, early.fx / 4, atol=0.01)
    later = effect("left wheel's angle", 8.0 * table, start_angle=0.2 * 2 * np.pi)
    np.testing.assert_allclose(later.force(later.init(), motion)[1].fx, early.fx, atol=0.3)


@quick
def test_a_table_over_the_heading_turns_with_the_vehicle():
    one = effect("heading in the room", np.cos(np.arange(KNOTS) * 2 * np.pi / KNOTS))
    for yaw in (-np.pi / 2, 0.0, np.pi / 3, 3.0):
        np.testing.assert_allclose(one.force(one.init(), motion_at(yaw=yaw))[1].fx, np.cos(yaw), atol=0.04)


@quick
def test_time_and_distance_since_rest_begin_anew_at_rest():
    one = effect("distance since rest", [0.0])
    memory = one.init()
    for _ in range(100):
        memory, _ = one.force(memory, motion_at(0.4, 0.5))
    np.testing.assert_allclose([memory.distance, memory.moving, memory.time], [0.2, 0.5, 0.5], rtol=1e-3)
    memory, _ = one.force(memory, motion_at(0.0))
    np.testing.assert_allclose([memory.distance, memory.moving], 0.0)
    assert memory.time > 0.5


@quick
def test_yaw_rate_and_time_pick_their_own_knots():
    motion = motion_at(0.3, 0.5)
    rate = effect("yaw rate", torques=[7.0], low=0.5, high=2.0)
    np.testing.assert_allclose(rate.force(rate.init(), motion)[1].tz, 7.0, rtol=1e-3)
    time = effect("time in the drive", [0.0, 9.0], low=0.0, high=float(KNOTS - 1))
    np.testing.assert_allclose(wrench_after(time, motion, 0.5).fx, 4.5, rtol=1e-2)
    assert jnp.shape(wrench_after(time, motion, 0.0).fx) == ()


@quick
def test_a_map_of_the_room_is_interpolated_along_both_ways():
    rows = KNOTS // ACROSS
    heights = [10.0 * row + column for row in range(rows) for column in range(ACROSS)]
    one = effect("place in the room", heights, low=0.0, high=float(ACROSS - 1), low_y=-1.0, high_y=float(rows - 2))
    for x, y in ((0.0, -1.0), (1.5, 0.0), (2.25, 0.5)):
        motion = replace(motion_at(), position=jnp.array([x, y]))
        np.testing.assert_allclose(one.force(one.init(), motion)[1].fx, 10 * (y + 1) + x, rtol=1e-4, atol=1e-4)
    outside = replace(motion_at(), position=jnp.array([9.0, -9.0]))
    np.testing.assert_allclose(one.force(one.init(), outside)[1].fx, ACROSS - 1.0, rtol=1e-4)


@quick
@pytest.mark.parametrize(("quantity", "force"), [("x in the room", 3.5), ("y in the room", 7.0)])
def test_a_table_over_a_coordinate_of_the_room_does_not_know_the_other(quantity, force):
    one = effect(quantity, [float(k) for k in range(KNOTS)], low=0.0, high=float(KNOTS - 1))
    motion = replace(motion_at(yaw=1.0), position=jnp.array([3.5, 7.0]))
    np.testing.assert_allclose(one.force(one.init(), motion)[1].fx, force, rtol=1e-4)
