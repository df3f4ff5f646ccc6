"""Sensors: what they measure, and when it arrives."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env, reset, reset_state, sense, step_state
from whill_mjx.evaluation.conditions import nominal
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.rollouts import CHANNELS, rollout
from whill_mjx.evaluation.rollouts import View as Seen
from whill_mjx.learning.setup import obs_shape_of
from whill_mjx.sensors.base import Reading, Sensor, View
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.commands import Commands
from whill_mjx.sensors.depth import Depth
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.imu import Imu
from whill_mjx.sensors.lidar import Lidar, distances
from whill_mjx.sensors.lidar3d import Lidar3D
from whill_mjx.sensors.odometry import Odometry
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.tasks.point_goal import PointGoal
from whill_mjx.tasks.tasks import scale_action
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec
from whill_mjx.world.scene import box, stack_boxes


@dataclass(frozen=True)
class Clock(Sensor):
    """(1,) time: a sensor that knows what it should show. Nothing but this class is needed for a new sensor."""

    def reading(self, env: Any) -> Reading:
        return Reading((1,))

    def measure(self, memory: Any, view: View, key: jax.Array) -> tuple[Any, jax.Array]:
        return memory, jnp.asarray(view.moment.time_s)[None]


CLOCKS = {
    "direct": Clock(),
    "late": Clock(latency_s=0.3),
    "slow": Clock(rate_hz=2.0),
    "both": Clock(rate_hz=5.0, latency_s=0.25),
    "lost": Clock(dropout=1.0),
    "some": Clock(dropout=0.5),
    "shaky": Clock(latency_s=0.2, jitter_s=0.15),
    "noisy": Clock(noise=0.5),
}


@pytest.fixture(scope="module")
def shown():
    """Times at which steps were taken (T,), and what each clock showed (T,) then."""
    env, params = make_env("obstacle_course", layout="fixed", observations=CLOCKS)

    def drive(key):
        state, obs = sense(env, params, reset_state(env, params, key))

        def one(state, _):
            state, _ = step_state(env, params, state, jnp.zeros(2))
            state, obs = sense(env, params, state)
            return state, obs

        _, later = jax.lax.scan(one, state, None, length=40)
        return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest])[:, 0], obs, later)

    found = jax.jit(drive)(jax.random.key(0))
    return np.arange(41) * 0.1, {name: np.asarray(value) for name, value in found.items()}


def test_latency_is_the_age_of_what_is_shown(shown):
    time, clock = shown
    np.testing.assert_allclose(clock["direct"], time, atol=1e-5)
    np.testing.assert_allclose(clock["late"], np.maximum(time - 0.3, 0.0), atol=1e-5)


def test_a_rate_holds_the_last_measurement(shown):
    time, clock = shown
    np.testing.assert_allclose(clock["slow"], np.floor(time * 2 + 1e-6) / 2, atol=1e-5)
    taken = np.floor((time - 0.25 + 1e-6) * 5) / 5  # arrives with the first step after 0.25 s
    np.testing.assert_allclose(clock["both"], np.maximum(taken, 0.0), atol=1e-5)


def test_what_is_lost_never_arrives_and_time_never_goes_back(shown):
    time, clock = shown
    assert (clock["lost"] == 0).all()
    assert 0.2 < (np.diff(clock["some"]) == 0).mean() < 0.8
    age = time - clock["shaky"]
    assert age[5:].min() >= 0.05 - 1e-4 and age[5:].max() <= 0.45 + 1e-4 and np.unique(age[5:].round(2)).size > 1
    assert all((np.diff(clock[name]) >= 0).all() for name in ("some", "shaky", "late", "slow"))


def test_noise_has_its_size(shown):
    time, clock = shown
    assert 0.3 < np.std(clock["noisy"] - time) < 0.75


@pytest.mark.quick
def test_a_scan_meets_boxes_at_its_height_and_turns_with_the_vehicle():
    boxes = stack_boxes([box(2.0, 0.0, 1.0, 1.0, 0.4, jnp.ones(3)), box(0.0, 3.0, 1.0, 1.0, 2.0, jnp.ones(3))])
    angles = jnp.array([0.0, np.pi / 2, np.pi])
    zero = jnp.zeros(())
    np.testing.assert_allclose(distances(zero, zero, angles, boxes, 9.0, (0.2, 0.2)), [1.5, 2.5, 9.0], atol=1e-5)
    np.testing.assert_allclose(distances(zero, zero, angles, boxes, 9.0, (0.5, 0.5)), [9.0, 2.5, 9.0], atol=1e-5)
    lidar = Lidar(rays=4, fov=2 * np.pi)
    np.testing.assert_allclose(np.sort(lidar.angles()), np.deg2rad([-135, -45, 45, 135]))
    np.testing.assert_allclose(lidar.mirrored(jnp.arange(4.0)), [3, 2, 1, 0])
    assert Lidar(yaw=3.1416, y=1e-16).mirrored is not None and Lidar(y=0.01).mirrored is None


@pytest.mark.quick
def test_a_scanner_beside_the_middle_has_no_mirror():
    """Its scan, turned round, is that of a scanner on the other side."""
    aside = [Lidar(y=0.2), Lidar(yaw=-0.8), Lidar(period=0.1), Lidar3D(y=-0.1), Lidar3D(period=0.1)]
    assert all(sensor.mirrored is None for sensor in aside)
    assert all(sensor.mirrored is not None for sensor in (Lidar(x=0.3, fov=2.0), Lidar(yaw=np.pi), Lidar3D(z=1.0)))


def test_the_vehicles_sensors_agree_with_its_motion():
    sensors = {"goal": Goal(), "odometry": Odometry(), "imu": Imu(), "commands": Commands(2)}
    env, params = make_env("obstacle_course", "whill_cr", layout="fixed", observations=sensors)
    state, first = jax.jit(lambda key: reset(env, params, key))(jax.random.key(0))
    np.testing.assert_allclose(first.obs["goal"], env.task.goal(state.scene), atol=2e-3)  # the start is the origin
    np.testing.assert_allclose(first.obs["imu"], [0, 0, 9.81, 0, 0, 0], atol=0.15)

    @jax.jit
    def advance(state, action):
        state, outcome = step_state(env, params, state, action)
        state, obs = sense(env, params, state)
        return state, outcome, obs

    for number in range(3):
        state, outcome, obs = advance(state, jnp.array([0.5, 0.0]))
        speed = float(outcome.metrics["v"])
        if number == 0:
            assert obs["imu"][0] == pytest.approx(speed / 0.1, rel=0.05)
    assert obs["odometry"][3] == pytest.approx(speed, abs=0.02)
    np.testing.assert_allclose(obs["commands"], [0.5, 0.0, 0.5, 0.0], atol=1e-6)


@pytest.mark.quick
def test_every_sensor_of_the_package_is_found_by_its_file():
    assert {"camera", "depth", "lidar", "odometry", "imu", "goal", "commands", "privileged"} <= set(known_sensors())


@pytest.mark.quick
@pytest.mark.parametrize(("observations", "said"), [
    (("sonar",), "unknown sensor 'sonar' .known: .*lidar"), ({"a": 3}, "no sensor"), ({"a": Lidar}, "no sensor"),
    (("lidar", "lidar"), "twice"), ({"": Lidar()}, "observation '', Lidar: has an empty name"),
])  # fmt: skip
def test_what_is_no_sensor_is_refused(observations, said):
    with pytest.raises(ValueError, match=said):
        make_env(observations=observations)


@pytest.mark.quick
def test_wrong_numbers_of_a_sensor_are_refused():
    for wrong in ({"rate_hz": 0.0}, {"latency_s": -1.0}, {"dropout": 1.5}, {"noise": float("nan")}):
        with pytest.raises(ValueError, match=f"sensor Goal: {next(iter(wrong))} is"):
            Goal(**wrong)


@pytest.mark.quick
def test_what_all_sensors_share_is_given_by_its_name_alone():
    for kind in known_sensors().values():
        shared = {one.name: one.kw_only for one in dataclasses.fields(kind)
                  if one.name in ("rate_hz", "latency_s", "jitter_s", "dropout", "noise")}
        assert len(shared) == 5 and all(shared.values()), kind
    assert Lidar(36).rays == 36


@pytest.mark.quick
def test_little_noise_flips_no_flag():
    kind = type("Flag", (Clock,), {
        "reading": lambda self, env: Reading((64,), 0, 1, bool),
        "measure": lambda self, memory, view, key: (memory, jnp.arange(64) % 2 == 1),
    })  # fmt: skip
    env, params = make_env("point_goal", observations={"flags": kind(noise=0.01)})
    _, first = jax.jit(lambda key: reset(env, params, key))(jax.random.key(0))
    np.testing.assert_array_equal(first.obs["flags"], np.arange(64) % 2 == 1)


@pytest.mark.quick
def test_a_mount_that_is_none_is_refused():
    for kind in (Camera, Depth):
        with pytest.raises(ValueError, match=f"sensor {kind.__name__}: mount: is .*'x': 1.*; it must be a CameraMount"):
            kind(mount={"x": 1})
    with pytest.raises(ValueError, match="camera of vehicle 'mine': is .*; it must be a CameraMount"):
        VehicleSpec("mine", 0.1, 0.5, 0.6, 50.0, camera={"x": 1})


@pytest.mark.parametrize("kind", [Camera, Depth])
def test_a_mounted_sensor_sees_what_the_vehicle_s_camera_would_see_there(kind):
    mount = dataclasses.replace(WHILL_CR.camera, x=-0.2, y=0.1, z=0.9, yaw=2.5)
    params = preset_params(WHILL_CR)
    usual, moved = (WHILL_CR, params), (dataclasses.replace(WHILL_CR, camera=mount), params)
    images = []
    for vehicle, sensor in ((usual, kind(16, 16, mount=mount)), (moved, kind(16, 16)), (usual, kind(16, 16))):
        env, _ = make_env("obstacle_course", vehicle=vehicle, observations={"image": sensor})
        _, first = jax.jit(lambda key, env=env: reset(env, params, key))(jax.random.key(3))
        images.append(first.obs["image"].astype(float))
    np.testing.assert_allclose(images[0], images[1], atol=1e-3)
    assert not np.allclose(images[0], images[2], atol=0.1)
    assert kind(mount=mount).mirrored is None and kind().mirrored is not None


@pytest.mark.quick
def test_a_sensor_with_an_array_in_it_is_refused_by_name():
    @dataclasses.dataclass(frozen=True)
    class Bearings(Clock):
        angles: Any = ()

    with pytest.raises(ValueError, match="observation 'b', Bearings: unhashable.*Give a tuple"):
        make_env("point_goal", observations={"b": Bearings(angles=np.zeros(2))})


@pytest.mark.quick
def test_learners_name_the_sensor_that_they_cannot_read():
    env, _ = make_env(observations={"depth": Depth(8, 8)})
    with pytest.raises(ValueError, match="'depth'.*as_bytes"):
        obs_shape_of(env)
    env, _ = make_env(observations={"depth": Depth(8, 8, as_bytes=True), "goal": Goal()})
    assert obs_shape_of(env) == {"depth": (8, 8, 1), "goal": (2,)}


@pytest.mark.quick
def test_the_image_alone_stays_an_array_without_memory():
    env, params = make_env("obstacle_course", height=8, width=8)
    state, step = jax.eval_shape(lambda key: reset(env, params, key), jax.random.key(0))
    assert step.obs.shape == (8, 8, 3) and state.sensors == ()
    assert dataclasses.replace(env).sensors == ()


@pytest.mark.quick
@pytest.mark.parametrize("kind", [Camera, Depth, Commands, Lidar, Lidar3D])
def test_no_field_of_a_sensor_takes_what_makes_no_sense(kind):
    others = ("noise", "as_bytes", "mount")
    for name in (one.name for one in dataclasses.fields(kind) if not one.kw_only and one.name not in others):
        for value in (math.nan, math.inf, 1e12, -1e12, "x", True):
            with pytest.raises(ValueError, match=f"^sensor {kind.__name__}: {name} is "):
                kind(**{name: value})


def test_late_sensors_remember_decisions_and_not_the_periods_between_them():
    """A late picture is taken in every control period; commands are remembered once a decision, as in training."""
    task = PointGoal(layout="fixed", action_repeat=2, max_steps=10)
    env, params = make_env(task, observations={"commands": Commands(3)})

    def act(count, state, shown, key):
        return count + 1, jnp.stack([0.2 * count - 0.5, shown["commands"][4]])  # the speed three decisions ago

    driver = Driver("counter", lambda state, key: jnp.zeros(()), act, period=2)
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], params)
    late = jax.tree.map(lambda leaf: leaf[None], dataclasses.replace(nominal(), latency=jnp.ones(())))
    keys = jax.random.split(jax.random.key(0), 1)
    driven = jax.jit(lambda p: rollout(env, p, keys, driver, late, view=Seen(max_latency=1)))(one)
    shown = np.asarray(driven.trace)[0, 1::2, CHANNELS.index("action_omega")]
    speeds = [scale_action(task, jnp.array([0.2 * count - 0.5, 0.0]))[0] for count in range(2)]
    np.testing.assert_allclose(shown, [0.0, 0.0, 0.0, *speeds], atol=1e-6)
