"""How the loops on measured sets are judged and scored."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured_floors import run_log
from benchmarks.measured_loop import climb, is_false, of_terrain
from benchmarks.measured_peers import (
    Steps,
    all_values,
    fit_kinematic,
    fit_published,
    fit_slip,
    follow,
    integrated,
    motion,
    sides,
    steps_of,
)
from benchmarks.measured_verdicts import Benchmark, config_of, drive_log, interval, keep
from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from sysid.replay.models import with_effects
from whill_mjx.vehicle.presets import preset_params

pytestmark = pytest.mark.quick
SHARED = Path(os.environ.get("WHILL_SHARED", Path(__file__).parents[2] / ".." / "shared"))


def verdict(name, **parameters):
    return {"verdict": "named", "effects": [
        {"name": name, "class": [name], "parameters": {f"{name}.{key}": [value, 0.0, 1.0]
                                                       for key, value in parameters.items()}}]}


@pytest.mark.parametrize(("loop", "false"), [
    ({"verdict": "none", "effects": []}, False),
    (verdict("command_delay", delay=0.12), False),
    (verdict("command_delay", delay=0.42), True),
    (verdict("actuator_lag", time_constant=0.17, cascade=0.5), False),
    (verdict("command_scale", linear=0.97, angular=1.08), False),
    (verdict("wheel_radius_difference", difference=-0.01, common=0.15), True),
    (verdict("command_dead_zone", linear=0.02, angular=0.0), True),
    (verdict("command_dead_zone", wheel=0.009, release=1.0), False),
    (verdict("command_dead_zone", wheel=0.02, release=1.0), True),
    (verdict("slope", along_x=0.001, along_y=0.0), True),
])
def test_a_verdict_on_a_nearly_ideal_robot_is_false_where_it_cannot_have_the_effect(loop, false):
    assert is_false(loop, fastest=0.1) is false


def test_the_share_removed_is_that_of_the_means_and_its_interval_is_paired():
    names = [f"run/{i:03d}.0" for i in range(60)]
    sizes = 1 + 9 * np.random.default_rng(1).random(60)
    before = {name: [size, size] for name, size in zip(names, sizes, strict=True)}
    after = {name: [0.8 * size, size] for name, size in zip(names, sizes, strict=True)}
    np.testing.assert_allclose(interval(names, before, after, 0), 0.2)
    np.testing.assert_allclose(interval(names, before, after, 1), 0.0, atol=1e-12)


def test_trials_are_of_the_terrain_in_their_name():
    names = ["warthog_sand_2/000.0", "warthog_gravel/001.0"]
    assert of_terrain(names, "sand") == names[:1] and of_terrain(names, "all") == names


def test_a_loop_that_was_kept_is_not_run_again(tmp_path):
    """An interrupted run goes on where it was: without a log there is nothing that a loop could be run on."""
    settings = Benchmark(out=tmp_path)
    keep(settings, "ladder_1", {"verdict": "none", "effects": []})

    class Nothing:
        spec = drive_spec()

    assert [one["verdict"] for one in climb(settings, "ladder", Nothing())] == ["none"]


def test_a_delay_of_the_pose_that_was_named_is_held():
    plain = preset_params(drive_spec(), "physical")
    assert config_of(Benchmark(), plain).held == ()
    assert config_of(Benchmark(), with_effects(plain, ("pose_delay",))).held == ("pose_delay.delay",)


def drive_spec():
    from whill_mjx.vehicle.specs import WARTHOG

    return WARTHOG


def test_no_step_is_both_fitted_and_held_out_and_poses_are_known_to_be_late():
    if not (SHARED / "data" / "measured" / "drive_norlab").is_dir():
        pytest.skip(f"measured set drive_norlab is not in {SHARED}; set WHILL_SHARED to the folder that holds data")
    log = drive_log(Benchmark(shared=SHARED, windows=12), ("asphalt", "gravel", "sand"))
    names = {trial.name for trial in log.training}, {trial.name for trial in log.held_out}
    assert len(names[0]) == 12 and not names[0] & names[1]
    assert {trial.group for trial in log.held_out} == {"asphalt", "gravel", "sand"}
    assert set(log.fields["yaw_rate"]) >= names[0]
    assert log.fields["pose_stamps"] == "receipt" and any(trial.breaks for trial in log.training)


def test_each_third_of_a_run_is_held_back_once_and_lost_poses_leave_the_gyro():
    if not (SHARED / "data" / "measured" / "drive_norlab").is_dir():
        pytest.skip(f"measured set drive_norlab is not in {SHARED}; set WHILL_SHARED to the folder that holds data")
    thirds = [run_log(Benchmark(shared=SHARED), "warthog_gravel", third) for third in range(3)]
    names = [{trial.name for trial in log.held_out} for log in thirds]
    assert sum(map(len, names)) == len(set.union(*names)) > 90
    for log in thirds:
        assert all(trial.ground_truth is not None for trial in log.held_out)
        lost = [trial for trial in log.training if trial.ground_truth is None]
        assert 0 < len(lost) < len(log.training) / 2 and all(trial.gyro is not None for trial in lost)


def test_a_peer_of_a_few_numbers_predicts_steps_that_it_was_not_fitted_to():
    truth = {"linear": 0.9, "angular": 0.6, "lag": 0.5, "delay": 0.15, "limit": 3.0}

    def steps(seed, count=10, length=50):
        rng = np.random.default_rng(seed)
        command = np.repeat(rng.uniform([-4.0, -2.0], [4.0, 2.0], (count, 1, 2)), length, axis=1)
        start = rng.uniform([-2.0, -1.0], [2.0, 1.0], (count, 2))
        index = np.tile(np.arange(4, length, 5), (count, 1))
        paths = np.stack([np.asarray(motion(all_values(tuple(truth), truth.values()), *one, half=0.54))
                          for one in zip(command, start, strict=True)])
        return Steps(command, start, index, np.take_along_axis(paths, index[..., None], axis=1),
                     np.ones(index.shape), 0.54), paths

    known, _ = steps(0)
    other, paths = steps(1)
    found, predict = fit_kinematic(known, 5)
    for name, value in truth.items():
        assert found[name] == pytest.approx(value, abs=0.15)  # lag and delay make up for one another
    moved = np.abs(paths[..., :2]).mean()
    assert np.abs(predict(other) - paths)[..., :2].mean() < 0.05 * moved


def test_the_publishers_model_finds_its_own_powertrain_and_slip_again():
    half, lag, delay, bounds = 0.54, 0.4, 0.1, (-3.0, 3.0)
    slips = [np.array([0.1]), np.array([0.2]), np.array([0.02, -0.05, 0.3])]

    def drives(seed, count=12, length=120):
        rng = np.random.default_rng(seed)
        command = np.repeat(rng.uniform([-4.0, -2.0], [4.0, 2.0], (count, 1, 2)), length, axis=1)
        start = rng.uniform([-1.0, -0.5], [1.0, 0.5], (count, 2))
        asked, first = sides(command, half), sides(start, half)
        left, right = (follow(asked[..., side], first[:, side], lag, delay, bounds) for side in range(2))
        v, omega = (left + right) / 2, (right - left) / (2 * half)
        paths = integrated(v - 0.1 * v, -0.2 * v * omega, 0.7 * omega - 0.02 * v * omega + 0.05 * v)
        t = np.arange(length) * 0.05
        return tuple(Trial(f"run/{k}", "run", Command(t, *command[k].T),
                           OdometryStream(t, None, None, None, v[k], omega[k]), PoseStream(t, *paths[k].T),
                           Start(v=start[k, 0], omega=start[k, 1], measured=True)) for k in range(count)), paths

    trials, _ = drives(0)
    for found, true in zip(fit_slip(trials), slips, strict=True):
        np.testing.assert_allclose(found, true, atol=0.03)
    others, paths = drives(1)
    predict = fit_published(trials, steps_of(trials, 2 * half))
    assert np.abs(predict(steps_of(others, 2 * half))[:, :120] - paths).mean() < 0.05 * np.abs(paths).mean()
