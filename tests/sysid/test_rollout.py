"""Replays of drives: commands in force, poses at the measurements' times, starts in motion, late odometry."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import TRUTH, unicycle_plant

from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from sysid.replay.rollout import Replay, make_batch, predictions


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
    from sysid.replay.rollout import vehicle_plant
    from whill_mjx.vehicle.config import VehicleConfig
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import WHILL_CR

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


@pytest.mark.parametrize("first", [True, False])
def test_a_delay_of_the_commands_acts_as_in_the_simulator(first):
    """As the vehicle itself drives, also where another effect changes the commands before they are delayed."""
    import jax
    import jax.numpy as jnp

    from sysid.replay.one_drive import Commanded, path_of
    from sysid.replay.rollout import vehicle_plant
    from whill_mjx.effects import make_effect
    from whill_mjx.vehicle.config import VehicleConfig
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import WHILL_CR

    plant = vehicle_plant(WHILL_CR, VehicleConfig(physics_dt=0.005))
    params = preset_params(WHILL_CR, "physical")
    changed = (*params.effects[1:-1], make_effect("command_delay", delay=0.033))  # no low-pass after it
    scale = make_effect("command_scale", linear=0.5)
    params = params.replace(effects=changed if first else (scale, *changed))
    command = jnp.asarray(np.repeat(np.random.default_rng(0).normal(0, 0.5, (20, 1, 2)), 4, axis=0), jnp.float32)
    start = jnp.zeros(5)

    def driven(command):
        def after(state, commands):
            state = plant.substeps(params, state, commands)
            return state, plant.observe(state)
        return jax.lax.scan(after, plant.place(params, start), command)[1]

    found = jax.jit(lambda command: path_of(plant, params, Commanded(command, start), few=True))(command)
    assert np.abs(found).max() > 0.05
    np.testing.assert_allclose(found[1:], jax.jit(driven)(command), atol=1e-5)


@pytest.mark.long
def test_many_drives_side_by_side_are_those_of_a_few_and_so_are_their_derivatives():
    """Few are computed by one function, which XLA cannot compile for many."""
    from sysid.replay.one_drive import IN_ONE
    from sysid.replay.rollout import vehicle_plant
    from whill_mjx.vehicle.config import VehicleConfig
    from whill_mjx.vehicle.parameters import get_values, set_values
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import WHILL_CR

    t = np.arange(0.0, 0.2, 0.05)
    trial = Trial("a_1", "a", Command(np.array([0.0]), np.array([0.5]), np.array([0.4])), None,
                  PoseStream(t, 0 * t, 0 * t, 0 * t), Start(0.0, 0.0, 0.0))
    params, names = preset_params(WHILL_CR, "physical"), ("body.mass", "torque_drive.kp")
    plant = vehicle_plant(WHILL_CR, VehicleConfig(physics_dt=0.005))
    batch, _ = make_batch((trial,), plant.dt)
    few, many = (Replay(plant, batch, lambda values: set_values(params, names, values)) for _ in range(2))
    values = np.array(get_values(params, names)) * np.linspace(0.9, 1.1, 8 * IN_ONE)[:, None]
    chosen = [0, 2 * IN_ONE, 8 * IN_ONE - 1]
    expected = few.simulate(values[chosen]).pose
    assert np.ptp(expected[:, 0, -1, 0]) > 1e-3
    np.testing.assert_allclose(many.simulate(values).pose[chosen], expected, atol=1e-6)
    slopes = [one.jacobian(rows)[1].pose for one, rows in ((few, values[chosen]), (many, values))]
    np.testing.assert_allclose(slopes[1][chosen], slopes[0], atol=1e-5)


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
    from sysid.replay.rollout import vehicle_plant
    from whill_mjx.effects import make_effect
    from whill_mjx.vehicle.config import VehicleConfig
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import WHILL_CR

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


def path_under_way(effect, command, start):
    """Path of a vehicle that moves as its command says, and starts in motion."""
    import jax
    import jax.numpy as jnp

    from sysid.replay.models import with_surroundings
    from sysid.replay.one_drive import WARM_UP, Commanded, path_of
    from sysid.replay.records import Plant
    from whill_mjx.effects import make_effect
    from whill_mjx.vehicle.types import VehicleParams

    def moved(params, state, command):
        v, omega = command
        turn = 0.01 * jnp.stack([v * jnp.cos(state[2]), v * jnp.sin(state[2]), omega])
        return jnp.concatenate([state[:3] + turn, command])

    plant = with_surroundings(Plant(lambda params, start: start, moved, lambda state: state, 0.01,
                                    lambda state, start: state.at[:3].set(start[:3])))
    params = VehicleParams(None, (make_effect(effect[0], **effect[1]),))
    warm_up = round(WARM_UP / plant.dt)
    return np.asarray(jax.jit(lambda start: path_of(plant, params, Commanded(jnp.asarray(command), start, warm_up)))(
        jnp.asarray(start)))


@pytest.mark.parametrize("effect", [("turn_lag", {"time_constant": 2.0}), ("jerk_limit", {"angular": 0.05}),
                                    ("acceleration_limit", {"linear": 0.1, "angular": 0.05})])
def test_a_slow_effect_on_commands_has_been_under_way_for_long_where_a_drive_starts_in_motion(effect):
    """A window of a longer drive: what lags by seconds does not begin with a command on the way from 0."""
    command = np.broadcast_to([0.5, 0.4], (100, 1, 2)).copy()
    command[50:] = 0.0
    speeds = path_under_way(effect, command, [1.0, 2.0, 0.3, 0.5, 0.4])[:, 6:8]
    np.testing.assert_allclose(speeds[:51], np.broadcast_to([0.5, 0.4], (51, 2)), atol=1e-3)
    assert 0.3 < speeds[60, 1] < 0.4  # only now it slows down, by the law of the effect


def test_a_drive_that_starts_in_motion_is_late_by_the_whole_delay_however_often_its_command_changes():
    """A ramp changes in every step: more changes are under way than a vehicle's memory holds."""
    command = np.linspace([0.5, 0.4], [0.9, -0.4], 80)[:, None]
    speeds = path_under_way(("command_delay", {"delay": 0.2}), command, [1.0, 2.0, 0.3, 0.5, 0.4])[:, 6:8]
    np.testing.assert_allclose(speeds[:21], np.broadcast_to([0.5, 0.4], (21, 2)), atol=1e-3)
    np.testing.assert_allclose(speeds[21:], command[:-20, 0], atol=1e-3)
