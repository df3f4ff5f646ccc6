"""Rewards by hand, settings of the two tasks, and their worlds."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.tasks.docking import Docking
from whill_mjx.tasks.point_goal import PointGoal
from whill_mjx.tasks.tasks import (
    Corridor,
    ObstacleCourse,
    goal_position,
    make_task,
    reward_terms,
    sample_world,
    scale_action,
)
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.vehicle.types import Body, VehicleParams
from whill_mjx.world.randomize import randomize_looks, randomize_params
from whill_mjx.world.scene import clearance, collides, footprint

pytestmark = pytest.mark.quick
YES, NO = jnp.array(True), jnp.array(False)


@lru_cache
def worlds(task, count=400):
    """Worlds of a task; cached, since compiling takes longer than all the rest."""
    return jax.jit(jax.vmap(lambda key: sample_world(task, key)))(jax.random.split(jax.random.key(0), count))


def at_start(world):
    return footprint(WHILL_CR, world.start[0], world.start[1], world.start[2])


def reward(task, progress=0.0, omega_change=0.0, reached=NO, collided=NO):
    return float(sum(reward_terms(task, jnp.asarray(progress), jnp.asarray(omega_change), reached, collided).values()))


def test_reward_terms_of_the_obstacle_course():
    course = ObstacleCourse()
    assert reward(course) == pytest.approx(-0.05)
    assert reward(course, progress=0.1) == pytest.approx(3.0 - 0.05)
    assert reward(course, omega_change=-0.4) == pytest.approx(-0.4 - 0.05)
    assert reward(course, reached=YES) == pytest.approx(100.0 - 0.05)
    assert reward(course, collided=YES) == pytest.approx(-50.0 - 0.05)
    assert reward(course, reached=YES, collided=YES) == pytest.approx(-50.0 - 0.05)


def test_corridor_has_the_papers_limits_and_no_smoothness_term():
    corridor = Corridor()
    assert reward(corridor, omega_change=1.0) == pytest.approx(-0.05)
    assert corridor.max_steps == 300 and corridor.goal_radius == 1.0
    np.testing.assert_allclose(scale_action(corridor, jnp.array([-1.0, -1.0])), [0.0, -0.6], atol=1e-7)
    np.testing.assert_allclose(scale_action(corridor, jnp.array([1.0, 1.0])), [0.3, 0.6], atol=1e-7)
    np.testing.assert_allclose(scale_action(corridor, jnp.array([0.0, 0.0])), [0.15, 0.0], atol=1e-7)


def test_course_actions_cover_one_metre_per_second_both_ways_and_bad_ones_are_tamed():
    course = ObstacleCourse()
    np.testing.assert_allclose(scale_action(course, jnp.array([-3.0, 2.0])), [-1.0, 1.0])
    for bad in ([jnp.nan, 0.5], [0.5, jnp.nan], [jnp.inf, -jnp.inf]):
        np.testing.assert_allclose(scale_action(course, jnp.array(bad)), [0.0, 0.0])
        np.testing.assert_allclose(scale_action(Corridor(), jnp.array(bad)), [0.0, 0.0])


@pytest.mark.parametrize(("field", "value"), [("v_max", float("nan")), ("omega_max", "x"), ("max_steps", 1.5),
                                              ("gate_x", (1.0,)), ("goal_radius", -1.0)])
def test_a_task_refuses_fields_that_are_no_numbers_or_out_of_range(field, value):
    with pytest.raises(ValueError, match=f"task: {field} is "):
        ObstacleCourse(**{field: value})


def test_corridor_randomisation_spans_the_papers_ranges():
    world = worlds(Corridor())
    start, box = np.asarray(world.start), np.asarray(world.scene.boxes.centre[:, 3])
    for values, bound in ((start[:, 0], 0.3), (start[:, 1], 0.3), (np.rad2deg(start[:, 2]), 15.0), (box[:, 1], 0.5)):
        assert 0.9 * bound < np.abs(values).max() <= bound + 1e-4
    assert 1.5 <= box[:, 0].min() < 1.7 and 3.3 < box[:, 0].max() <= 3.5
    np.testing.assert_allclose(goal_position(jax.tree.map(lambda leaf: leaf[0], world.scene)), [4.5, 0.0])
    np.testing.assert_allclose(world.scene.marker.half[0, 1:] * 2, 0.5)


def test_fixed_layouts_do_not_depend_on_the_key():
    for name in ("obstacle_course", "corridor"):
        task = make_task(name, layout="fixed")
        one, other = (sample_world(task, jax.random.key(seed)) for seed in (0, 1))
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_corridor_box_can_be_put_at_two_and_three_metres():
    for distance in (2.0, 3.0):
        world = sample_world(Corridor(layout="fixed", box_x=distance), jax.random.key(0))
        np.testing.assert_allclose(world.scene.boxes.centre[3, :2], [distance, 0.0])


@pytest.mark.parametrize("name", ["obstacle_course", "corridor"])
def test_every_start_is_free(name):
    world = worlds(make_task(name))
    free = jax.jit(jax.vmap(lambda one: clearance(at_start(one), one.scene.boxes)))(world)
    assert float(free.min()) > 0.1


def test_straight_driving_never_gets_through_the_first_gate():
    def passes(world):
        heading = world.start[2]

        def hit(s):
            vehicle = footprint(WHILL_CR, s * jnp.cos(heading), s * jnp.sin(heading), heading)
            return collides(vehicle, world.scene.boxes)

        return ~jnp.any(jax.vmap(hit)(jnp.linspace(0.0, 2.5, 26)))

    assert not jax.jit(jax.vmap(passes))(worlds(ObstacleCourse())).any()
    assert not bool(passes(sample_world(ObstacleCourse(layout="fixed"), jax.random.key(0))))


def test_goal_of_the_course_is_about_five_metres_away_and_gates_are_lower_than_the_camera():
    world = worlds(ObstacleCourse())
    distance = np.linalg.norm(np.asarray(world.scene.marker.position[:, :2]), axis=1)
    assert 5.29 < distance.min() and distance.max() < 5.36
    assert float(world.scene.boxes.half[:, 3:, 2].max()) * 2 < 0.68 < float(world.scene.marker.position[0, 2]) - 0.3


def test_one_gate_leaves_out_the_second():
    assert sample_world(ObstacleCourse(gates=1), jax.random.key(0)).scene.boxes.mask.shape == (5,)


@pytest.mark.parametrize("farthest", [2.5, 3.5, 9.0])
def test_every_point_goal_lies_within_the_walls(farthest):
    """A goal behind a wall would be one that nobody reaches."""
    task = PointGoal(farthest=farthest)
    found = worlds(task)
    inner = float(found.scene.boxes.centre[0, 0, 1] - found.scene.boxes.half[0, 0, 1])  # of the wall to the left
    goals = np.asarray(found.scene.marker.position)[:, :2]
    assert inner - np.abs(goals).max() >= task.goal_radius - 1e-5
    assert inner == pytest.approx(max(4.0, farthest + 0.5))


@pytest.mark.parametrize(("twist", "docked"), [((0.03, 0.0), True), ((0.0, 0.05), True), ((0.0, 0.8), False),
                                               ((0.06, 0.0), False), ((0.03, -0.06), False)])  # fmt: skip
def test_a_vehicle_has_docked_where_it_neither_drives_nor_turns(twist, docked):
    """The chair's farthest corner is 0.8 m from its driven axle: it moves at 0.05 m/s where it turns at 0.06 rad/s."""
    task = Docking(layout="fixed")
    scene = sample_world(task, jax.random.key(0)).scene
    x, y, yaw = *goal_position(scene), scene.marker.yaw
    zero = jnp.zeros(())
    moment = Moment(
        scene, jnp.stack([x, y, yaw]), jnp.array(twist), footprint(WHILL_CR, x, y, yaw), jnp.zeros(2), jnp.zeros(2),
        zero, zero, NO, YES, NO, zero,
    )  # fmt: skip
    assert bool(task.docked(moment)) is docked
    assert bool(task.endings(moment)["success"]) is docked
    assert (float(task.rewards(moment)["goal"]) > 0) is docked


@pytest.mark.parametrize("wrong", [{"layout": "maze"}, {"v_min": 1.0}, {"action_repeat": 0}])
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValueError):
        ObstacleCourse(**wrong)
    with pytest.raises(ValueError, match="known"):
        make_task("slalom")


def test_random_parameters_keep_signs_and_zeros():
    params = VehicleParams(Body(*(jnp.asarray(value) for value in (52.0, 5.0, -0.2, 0.0, 0.1))), (jnp.array(3),))
    drawn = jax.vmap(lambda key: randomize_params(key, params, 0.1))(jax.random.split(jax.random.key(0), 200))
    assert 0.07 < float(jnp.std(jnp.log(drawn.body.mass))) < 0.11
    assert float(drawn.body.com_x.max()) < 0 and not drawn.body.com_y.any() and (drawn.effects[0] == 3).all()
    same = randomize_params(jax.random.key(0), params, 0.0)
    np.testing.assert_allclose(same.body.mass, 52.0)


def test_random_looks_change_colours_only_and_no_box_is_as_blue_as_the_marker():
    world = worlds(ObstacleCourse())
    looks = jax.jit(jax.vmap(randomize_looks))(jax.random.split(jax.random.key(1), 400), world.scene)
    np.testing.assert_array_equal(looks.boxes.centre, world.scene.boxes.centre)
    assert not jnp.allclose(looks.boxes.colour, world.scene.boxes.colour)
    blueness = looks.boxes.colour[..., 2] - looks.boxes.colour[..., :2].max(-1)
    marker_blueness = looks.marker.colour[..., 2] - looks.marker.colour[..., :2].max(-1)
    assert float(blueness.max()) <= 0.0 and float(marker_blueness.min()) > 0.25
