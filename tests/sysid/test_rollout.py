"""Replays of drives: commands in force, poses at the measurements' times, starts in motion, late odometry."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import TRUTH, unicycle_plant

from sysid.log import Command, OdometryStream, PoseStream, Start, Trial
from sysid.rollout import Replay, make_batch, predictions


def test_the_replay_holds_commands_and_interpolates_at_the_measurements_times():
    t = np.array([0.03, 0.55, 1.013, 2.5])
    command = Command(np.array([0.5]), np.array([0.4]), np.array([0.0]))
    trial = Trial("a_1", "a", command, None, PoseStream(t, 0 * t, 0 * t, 0 * t), Start(1.0, 2.0, np.pi / 2))
    plant = unicycle_plant(dt=0.01)
    batch, _ = make_batch((trial,), plant.dt)
    simulated = Replay(plant, batch, lambda values: values).simulate(np.array([[0.01, 0.01, 1.0]]))  # lag of one step
    truth = predictions((trial,), dataclasses.replace(simulated, pose=simulated.pose[0]))[0].ground_truth
    np.testing.assert_allclose(truth.y, 2.0 + 0.4 * np.maximum(t - 0.5, 0.0), atol=0.005)
    np.testing.assert_allclose(truth.x, 1.0, atol=1e-5)


def test_yaw_is_unwrapped_over_several_turns_from_any_start():
    t = np.arange(0.0, 12.0, 0.1)
    command = Command(np.array([0.0]), np.array([0.0]), np.array([2.0]))
    yaw = 9.0 + 2.0 * t  # the measurement counts its turns from elsewhere
    trial = Trial("a_1", "a", command, None, PoseStream(t, 0 * t, 0 * t, yaw), Start(yaw=9.0, omega=2.0))
    plant = unicycle_plant()
    batch, _ = make_batch((trial,), plant.dt)
    simulated = Replay(plant, batch, lambda values: values).simulate(np.array([[0.1, 0.1, 1.0]]))
    np.testing.assert_allclose(simulated.pose[0, 0, : len(t), 2], yaw, atol=1e-3)


def test_a_vehicle_that_starts_in_motion_is_under_way_at_the_start_pose():
    """A vehicle with a delay and a slow integral would otherwise begin with a stumble."""
    from sysid.rollout import vehicle_plant
    from whill_mjx.config import VehicleConfig
    from whill_mjx.presets import preset_params
    from whill_mjx.specs import WHILL_CR

    t = np.arange(0.0, 0.8, 0.05)
    command = Command(np.array([0.0]), np.array([0.5]), np.array([0.4]))
    start = Start(3.0, -2.0, 2.0, v=0.5, omega=0.4)
    trial = Trial("a_1", "a", command, None, PoseStream(t, 0 * t, 0 * t, 0 * t), start)
    plant = vehicle_plant(WHILL_CR, VehicleConfig(physics_dt=0.01))
    batch, _ = make_batch((trial,), plant.dt)
    params = preset_params(WHILL_CR, "physical")
    simulated = Replay(plant, batch, lambda values: params).simulate(np.zeros((1, 1)))
    pose = simulated.pose[0, 0]
    np.testing.assert_allclose(pose[0], [3.0, -2.0, 2.0], atol=1e-4)
    speed = np.hypot(*np.diff(pose[:, :2], axis=0).T) / 0.05
    np.testing.assert_allclose(speed, 0.5, rtol=0.05)
    np.testing.assert_allclose(np.diff(pose[:, 2]) / 0.05, (pose[-1, 2] - pose[0, 2]) / t[-1], rtol=0.15)


def test_a_drive_that_starts_in_motion_is_settled_by_the_quick_way_of_many_steps():
    """One step after the other, each put together from single elements, takes sixty times as long."""
    plain = unicycle_plant()
    t = np.arange(0.0, 0.8, 0.05)
    pose = PoseStream(t, 0 * t, 0 * t, 0 * t)
    trial = Trial("a_1", "a", Command(np.array([0.0]), np.array([0.5]), np.array([0.4])), None, pose,
                  Start(3.0, -2.0, 2.0, v=0.3, omega=0.2))
    batch, _ = make_batch((trial,), plain.dt)
    called = []

    def substeps(params, state, commands):
        called.append(len(commands))
        for command in commands:
            state = plain.substep(params, state, command)
        return state

    def refused(params, state, command):
        raise AssertionError("a single step was asked for")

    quick = dataclasses.replace(plain, substep=refused, substeps=substeps)
    found, expected = (Replay(plant, batch, lambda values: values).simulate(TRUTH[None]).pose
                       for plant in (quick, plain))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert batch.warm_up > 0 and set(called) == {batch.command.shape[2]}


@pytest.mark.parametrize("speeds", [(0.0, 0.0), (0.5, 0.4)])
def test_a_replay_reads_late_odometry_off_the_path(speeds):
    """As the odometry without latency was that long before; counted from where the vehicle starts, as a log is."""
    from sysid.rollout import vehicle_plant
    from whill_mjx.config import VehicleConfig
    from whill_mjx.effects import make_effect
    from whill_mjx.presets import preset_params
    from whill_mjx.specs import WHILL_CR

    t = np.arange(0.0, 1.2, 0.025)
    command = Command(np.array([0.0, 0.2]), np.array([speeds[0], 0.7]), np.array([speeds[1], -0.3]))
    trial = Trial("a_1", "a", command, OdometryStream(t, 0 * t, 0 * t, 0 * t, 0 * t, 0 * t), None,
                  Start(v=speeds[0], omega=speeds[1]))
    plant = vehicle_plant(WHILL_CR, VehicleConfig(physics_dt=0.0125))
    batch, _ = make_batch((trial,), plant.dt)
    params = preset_params(WHILL_CR, "physical")

    def driven(late):
        vehicle = params.replace(effects=(*params.effects, make_effect("sensor_delay", delay=late)))
        return Replay(plant, batch, lambda values: vehicle).simulate(np.zeros((1, 1))).odometry[0, 0]

    now, late = driven(0.0), driven(0.05)  # two records
    np.testing.assert_allclose(late[2:, 3:], now[:-2, 3:], atol=1e-5)
    np.testing.assert_allclose(np.diff(late[2:, 2]), np.diff(now[:-2, 2]), atol=1e-5)
    step = lambda path: np.hypot(*np.diff(path[:, :2], axis=0).T)  # noqa: E731
    np.testing.assert_allclose(step(late[2:]), step(now[:-2]), atol=1e-5)
    np.testing.assert_allclose(late[0, :3], 0.0, atol=1e-6)
