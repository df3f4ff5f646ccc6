"""Frame conventions of the reference paper's table: right-handed base frame, centre of mass, control, evaluation."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.vehicle.dynamics import drive, mass_distribution, measure, nominal_world, place
from whill_mjx.vehicle.kinematics import body_twist, camera_pose, reference_pose, rotation_from_quaternion
from whill_mjx.vehicle.model import build_model, mujoco_model
from whill_mjx.vehicle.presets import preset


@lru_cache
def chair():
    spec, params = preset("whill_cr_physical")
    model = build_model(spec)
    return model, params, jax.jit(lambda state, command: drive(model, params, state, command))


def after(command, periods=8, start=(0.0, 0.0, 0.0)):
    model, params, period = chair()
    state = place(model, params, *start)
    for _ in range(periods):
        state = period(state, jnp.array(command))
    return model, state


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_positive_v_drives_along_plus_x_of_the_base_frame(yaw):
    model, state = after((0.5, 0.0), start=(0.0, 0.0, yaw))
    x, y, _ = (float(value) for value in reference_pose(model, state.qpos))
    assert np.cos(yaw) * x + np.sin(yaw) * y > 0.2
    assert abs(-np.sin(yaw) * x + np.cos(yaw) * y) < 0.01


def test_positive_omega_turns_left_about_plus_z():
    model, state = after((0.0, 0.6))
    assert reference_pose(model, state.qpos)[2] > 0.2
    assert body_twist(model, state.qpos, state.qvel)[1] > 0.4
    assert state.qvel[7] > 0 > state.qvel[6]  # the right wheel forward, the left one backward
    assert state.odometry.yaw > 0.2 and state.odometry.gyro > 0.4


def test_the_base_frame_is_right_handed_with_x_forward_y_left_and_z_up():
    model, params, _ = chair()
    state = place(model, params, 0.0, 0.0, 0.3)
    rotation = np.asarray(rotation_from_quaternion(state.qpos[3:7]))
    np.testing.assert_allclose(np.cross(rotation[:, 0], rotation[:, 1]), rotation[:, 2], atol=1e-6)
    np.testing.assert_allclose(rotation[:2, 0], [np.cos(0.3), np.sin(0.3)], atol=0.01)
    assert rotation[2, 2] > 0.99
    geometry = nominal_world(model).geometry  # rear left, rear right, front left, front right
    np.testing.assert_array_equal(np.sign(geometry.contact_y), [1, -1, 1, -1])
    assert (np.asarray(geometry.contact_x[2:]) > np.asarray(geometry.contact_x[:2])).all()
    position, axes = camera_pose(model, state.qpos)
    forward = np.asarray(axes[:, 2])
    assert forward @ rotation[:, 0] > 0.9 and (np.asarray(position) - np.asarray(state.qpos[:3])) @ rotation[:, 0] > 0


def test_offsets_of_the_centre_of_mass_are_from_the_model_origin_forward_left_and_up():
    model, params, _ = chair()
    offsets = np.array([0.11, 0.02, 0.3])
    body = params.body.replace(**dict(zip(("com_x", "com_y", "com_z"), map(jnp.asarray, offsets), strict=True)))
    moved = params.replace(body=body)
    np.testing.assert_allclose(mass_distribution(model, moved, nominal_world(model))[2], offsets, rtol=1e-6)
    np.testing.assert_allclose(mujoco_model(model.spec, body=body).body("chassis").ipos, offsets, rtol=1e-6)
    load = np.asarray(measure(model, moved, nominal_world(model), place(model, moved, 0.0, 0.0, 0.0)).normal_force)
    fore = load[2:].sum() / load.sum() * model.spec.wheelbase + model.spec.rear_x
    left = (load[0] + load[2] - load[1] - load[3]) / load.sum() * model.spec.track / 2
    np.testing.assert_allclose([fore, left], offsets[:2], atol=0.01)  # where the ground carries the weight


def test_commands_and_the_evaluated_pose_are_of_the_rear_axle_centre():
    model, params, _ = chair()
    state = place(model, params, 1.0, 2.0, np.pi / 2, (0.0, 1.0))  # turning on the spot about the axle's centre
    np.testing.assert_allclose(reference_pose(model, state.qpos), [1.0, 2.0, np.pi / 2], atol=1e-5)
    np.testing.assert_allclose(state.qpos[:2], [1.0, 2.0 - model.spec.rear_x], atol=0.01)  # the origin is ahead of it
    np.testing.assert_allclose(state.qvel[:2], [model.spec.rear_x, 0.0], atol=1e-5)


def test_the_odometry_starts_at_its_own_origin():
    _, state = after((0.5, 0.0), start=(3.0, -2.0, 1.0))
    assert 0.2 < state.odometry.x < 0.4 and abs(state.odometry.y) < 0.01 and abs(state.odometry.yaw) < 0.02
