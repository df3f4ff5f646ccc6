"""Conditions of an evaluation in furnished rooms: the camera, the start, the light and the obstacles that they name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env, observe, reset_state
from whill_mjx.evaluation.conditions import _lit, arranged, begin_under, nominal, seen_under
from whill_mjx.vehicle.kinematics import camera_pose, rotation_from_quaternion
from whill_mjx.world.gallery import gallery
from whill_mjx.world.rich import OBSTACLE, THINGS, furnish, roles_of

LABELS = 3
"""Labels of the floor and the marker, before those of the boxes."""


@pytest.fixture(scope="module")
def room():
    """The environment, one furnished room as it is drawn, and (changes) -> it under a condition, with its picture."""
    env, params = make_env("corridor", looks="rich", height=16, width=16)
    key = jax.random.key(4)

    def under(condition):
        state = begin_under(condition, env, params, reset_state(arranged(condition, env), params, key))
        return state, observe(env, seen_under(condition, env, state))

    compiled = jax.jit(under)

    def change(**changes):
        values = {name: jnp.asarray(value, float) for name, value in changes.items()}
        state, image = compiled(dataclasses.replace(nominal(), **values))
        return state, np.asarray(image, float)

    return env, jax.jit(lambda: reset_state(env, params, key))(), change


def test_the_nominal_condition_changes_nothing_of_a_furnished_room(room):
    _, drawn, change = room
    state, _ = change()
    assert jax.tree.structure(state) == jax.tree.structure(drawn)
    for here, there in zip(jax.tree.leaves(state), jax.tree.leaves(drawn), strict=True):
        if not jnp.issubdtype(here.dtype, jax.dtypes.prng_key):
            np.testing.assert_allclose(here, there, atol=1e-4)  # the start goes through a pose on the ground


@pytest.mark.parametrize("name, value", [
    ("camera_x", 0.4), ("camera_y", 0.3), ("camera_z", 0.3), ("camera_pitch_deg", 12.0), ("camera_yaw_deg", 15.0),
    ("start_x", 0.5), ("start_y", 0.3), ("start_yaw_deg", 15.0), ("light", 0.25), ("light", 4.0), ("obstacle_x", 1.6),
    ("obstacle_y", 0.5), ("obstacle_shift_y", 0.5),
])  # fmt: skip
def test_every_condition_changes_the_first_picture_of_a_furnished_room(room, name, value):
    _, _, change = room
    assert np.abs(change(**{name: value})[1] - change()[1]).mean() > 2.0


def test_every_pose_that_a_late_camera_looks_from_is_moved(room):
    env, drawn, _ = room
    trail = drawn.trail.at[:, 0].add(jnp.linspace(0.0, -0.4, len(drawn.trail)))
    state = dataclasses.replace(drawn, trail=trail)
    condition = dataclasses.replace(nominal(), camera_y=jnp.array(0.2), camera_yaw_deg=jnp.array(90.0))
    moved = seen_under(condition, env, state)
    np.testing.assert_array_equal(moved.trail[0], moved.vehicle.qpos[:7])
    for before, after in zip(trail, moved.trail, strict=True):
        (was, looked), (now, looks) = camera_pose(env.model, before), camera_pose(env.model, after)
        chassis = rotation_from_quaternion(before[3:7])
        np.testing.assert_allclose(chassis.T @ (now - was), [0.0, 0.2, 0.0], atol=1e-5)
        ahead, was_ahead = chassis.T @ looks[:, 2], chassis.T @ looked[:, 2]
        np.testing.assert_allclose(ahead, [0.0, was_ahead[0], was_ahead[2]], atol=1e-5)


def test_a_shifted_start_has_no_older_pose(room):
    _, drawn, change = room
    state, _ = change(start_x=0.5, start_yaw_deg=15.0)
    assert float(state.trail[0, 0] - drawn.trail[0, 0]) == pytest.approx(0.5, abs=0.1)
    np.testing.assert_array_equal(state.trail, np.broadcast_to(state.vehicle.qpos[:7], state.trail.shape))


def test_less_light_makes_darker_pictures_although_the_camera_meters(room):
    _, _, change = room
    means = [change(light=light)[1].mean() for light in (0.1, 0.4, 1.0)]
    assert means[0] < 0.6 * means[2] and means[0] < 0.8 * means[1] < means[2]


def test_only_the_obstacle_moves_with_its_shadow(room):
    _, drawn, change = room
    state, _ = change(obstacle_x=3.0, obstacle_y=-0.6)
    roles = roles_of(state.scene)[LABELS:][: len(state.scene.boxes.yaw)]
    centre, before = np.asarray(state.scene.boxes.centre), np.asarray(drawn.scene.boxes.centre)
    carton = np.flatnonzero(roles == OBSTACLE)
    np.testing.assert_allclose(centre[carton, :2], [[3.0, -0.6]], atol=1e-6)
    np.testing.assert_allclose(centre[roles != OBSTACLE], before[roles != OBSTACLE], atol=1e-6)
    np.testing.assert_allclose(state.scene.ghosts.centre, drawn.scene.ghosts.centre, atol=1e-6)
    np.testing.assert_allclose(state.scene.rich.lights.caster[0, :2], [3.0, -0.6], atol=1e-6)


def test_things_leave_a_passage_beside_an_obstacle_that_was_moved(room):
    env, _, _ = room
    condition = dataclasses.replace(nominal(), obstacle_x=jnp.array(1.5), obstacle_y=jnp.array(-0.6))
    task = arranged(condition, env).task

    def furnished(key):
        return furnish(key, task.sample_world(key).scene, lone=True).boxes

    boxes = jax.tree.map(np.asarray, jax.jit(jax.vmap(furnished))(jax.random.split(jax.random.key(0), 100)))
    turned = [np.abs(np.cos(boxes.yaw)), np.abs(np.sin(boxes.yaw))]
    reach_x = boxes.half[..., 0] * turned[0] + boxes.half[..., 1] * turned[1]
    reach_y = boxes.half[..., 0] * turned[1] + boxes.half[..., 1] * turned[0]
    carton, things = 3, slice(5, 5 + THINGS)  # behind three walls, and the back one
    apart = np.abs(boxes.centre[:, things, 0] - boxes.centre[:, [carton], 0])
    beside = boxes.mask[:, things] & (apart < reach_x[:, things] + reach_x[:, [carton]])
    gap = (boxes.centre[..., 1] - reach_y)[:, things] - (boxes.centre[..., 1] + reach_y)[:, [carton]]
    left = beside & (boxes.centre[:, things, 1] > 0)
    assert left.sum() > 5 and gap[left].min() > 0.9


def test_less_light_dims_lamps_and_fog_too():
    scene = gallery()
    dim = _lit(dataclasses.replace(nominal(), light=jnp.array(0.5)), scene)
    np.testing.assert_allclose(dim.finish.lamp_colour, 0.5 * scene.finish.lamp_colour)
    np.testing.assert_allclose(dim.finish.fog_colour, 0.5 * scene.finish.fog_colour)
    assert float(dim.looks.ambient) == 0.5 * float(scene.looks.ambient) and dim.finish.fog == scene.finish.fog
