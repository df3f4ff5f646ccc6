"""Skid-steered robots of one's own: a vehicle of the simulator is fitted in place of their contacts."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.plant.first_day import Day, Wrong, make_uncalibrated
from benchmarks.plant.skid import CRAWLER, SKIDS, write_skid_urdf
from sysid.logs.log import load_log
from sysid.logs.records import OdometryStream, PoseStream, Prediction
from sysid.pages.fit_page import headline, warning
from sysid.pages.fit_report import effective_track
from sysid.replay.mjcf import mjcf_model
from sysid.replay.model_files import steps_mjx
from sysid.search.fitting import fit_log, make_problem, predict, subject
from sysid.search.settings import FitConfig

WRONG = Wrong(radius=0.02, track=-0.03, x=0.05, y=-0.02)


def commands() -> dict[str, np.ndarray]:
    """A straight line and a turn on the spot, and a straight line and an S: 9 s each."""
    t = np.arange(90) / 10
    first, then = (t >= 1) & (t < 4.5), (t >= 4.5) & (t < 8.2)
    spot = np.stack([t, 0.7 * first, 0.9 * then], axis=-1)
    bend = np.stack([t, 0.7 * first + 0.4 * then, 0.9 * np.sin(2 * (t - 4.5)) * then], axis=-1)
    return {"spot": spot, "bend": bend}


@pytest.fixture(scope="module", params=sorted(SKIDS))
def robot(request, tmp_path_factory):
    """A log of a robot on four or six wheels, and the file with the sizes that are believed."""
    folder = tmp_path_factory.mktemp(request.param)
    make_uncalibrated(folder / "log", Day(request.param, WRONG, seed=3), 1, commands())
    return load_log(folder / "log"), write_skid_urdf(folder / "robot.urdf", SKIDS[request.param])


def test_the_simulators_vehicle_is_fitted_with_the_files_mass_and_places_of_wheels(robot):
    log, file = robot
    seen, model = subject(log, FitConfig(model=str(file)))
    assert seen.spec.drive == "skid" and seen.spec.track == log.spec.track
    axles = np.array(next(one for one in SKIDS.values() if one.mass == pytest.approx(seen.spec.mass)).axles)
    assert seen.spec.wheelbase == pytest.approx(np.ptp(axles), abs=1e-5)
    assert any("is skid-steered: the simulator's vehicle is fitted" in note for note in seen.notes)
    again, _ = subject(seen, FitConfig(model=str(file)), model)
    assert again.notes == seen.notes and again.spec == seen.spec
    given = make_problem(seen, FitConfig(model=str(file), physics_dt=0.01), model=model)
    assert given.model is None and given.plant.host is None
    inside = [effect for effect in given.params.effects if effect.name == "middle_wheels"]
    assert [float(effect.share) for effect in inside] == [pytest.approx(1 / 3)] * (len(axles) == 3)
    names = set(given.space.names)
    assert {"wheel_radius_difference.common", "slip_traction.mu", "slip_traction.slip_speed",
            "slip_traction.side_slip_speed", "yaw_scrub.torque", "pose_mount.x"} <= names
    assert not {"track_width.error", "wheels.radius", "slip_traction.mu_free"} & names
    held = dict(given.space.fixed)
    assert all(held[f"body.com_{axis}"] == "the robot's file states it" for axis in "xyz")
    asked = make_problem(seen, FitConfig(model=str(file), physics_dt=0.01, parameters=("body.com_x",)), model=model)
    assert asked.space.names == ("body.com_x",)


@pytest.mark.quick
def test_parameters_of_the_file_keep_its_contacts(tmp_path):
    file = write_skid_urdf(tmp_path / "robot.urdf", CRAWLER)
    assert mjcf_model(file, ["wheels.radius"]).instead is None and mjcf_model(file, calibrate=True).instead is not None
    assert steps_mjx(str(file), parameters=("wheels.radius",)) and not steps_mjx(str(file))
    assert not steps_mjx(str(file), parameters=("slip_traction.mu",))


@pytest.mark.parametrize("robot", ["crawler"], indirect=True)
def test_radius_and_tracked_point_of_a_skid_steered_robot_come_out_of_two_drives(robot):
    log, file = robot
    names = ("wheel_radius_difference.common", "slip_traction.mu", "slip_traction.slip_speed",
             "slip_traction.side_slip_speed", "yaw_scrub.torque", "torque_drive.kp", "torque_drive.ki",
             "torque_drive.limit", "torque_drive.windup", "command_delay.delay", "pose_mount.x", "pose_mount.y",
             "pose_mount.yaw")
    config = FitConfig(model=str(file), method="lm", physics_dt=0.01, iterations=8, elsewhere=False, parameters=names,
                       effects=("wheel_radius_difference", "pose_mount"))
    fit = fit_log(log, config)
    found = {one.name: one.value for one in fit.uncertainty.estimates}
    assert found["wheel_radius_difference.common"] == pytest.approx(WRONG.radius, abs=0.004)
    assert found["pose_mount.y"] == pytest.approx(WRONG.y, abs=0.005)
    assert found["pose_mount.yaw"] == pytest.approx(WRONG.yaw, abs=np.radians(0.3))
    before, after = predict(fit, log.trials)

    def turned_too_far(replays):
        return max(np.abs(one.ground_truth.yaw[-1] - trial.ground_truth.yaw[-1])
                   for one, trial in zip(replays, log.trials, strict=True))

    assert turned_too_far(after) < 0.03 < turned_too_far(before)


def report(fitted, initial, floor=None, yaw=None):
    one = {"fitted": fitted, "initial": initial, "ideal": 1.0, "noise_floor": floor}
    turned = {} if yaw is None else {"yaw": {"fitted": yaw[0], "initial": yaw[1], "ideal": 1.0, "noise_floor": 0.002}}
    held_out = {"ground_truth": {"trials": 2, "trajectory": one, **turned}}
    return {"summary": {"held_out": held_out, "training": {}}}


@pytest.mark.quick
@pytest.mark.parametrize("worse", [report(0.97, 0.29, 0.0016), report(None, 0.29), report(float("nan"), 0.29),
                                   report(0.1, 0.29, 0.01, yaw=(0.7, 0.1))])
def test_a_fit_that_is_worse_on_held_out_drives_says_so_first(worse):
    assert headline(worse).startswith("This fit is worse than the vehicle as stated")


@pytest.mark.quick
@pytest.mark.parametrize("better", [report(0.1, 0.29), report(0.0015, 0.0014, 0.002), report(0.1, None),
                                    report(0.1, 0.29, yaw=(0.001, 0.0005)),
                                    {"summary": {"held_out": {}, "training": {}}}])
def test_a_fit_that_is_better_or_within_the_spread_of_replicates_is_no_worse(better):
    assert warning(better) == ""


@pytest.mark.quick
@pytest.mark.parametrize(("turns", "track"), [(1.0, 0.75), (0.0, None), (np.nan, None)])
def test_the_effective_track_is_of_drives_that_turn_and_did_not_diverge(turns, track):
    t = np.linspace(0.0, 10.0, 101)
    outside, wheels = PoseStream(t, t, 0 * t, turns * 0.2 * t), OdometryStream(t, t, 0 * t, turns * 0.3 * t, t, 0 * t)
    assert effective_track([Prediction(outside, wheels)], 0.5) == (None if track is None else pytest.approx(track))
