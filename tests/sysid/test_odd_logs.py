"""Logs of strangers: long drives, a vehicle that stands, commands beyond its limits, a pose that comes seldom."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from sysid.logs.contradictions import running_fast
from sysid.logs.coverage import doubts, sanity
from sysid.logs.loaders import load_any
from sysid.logs.log import load_log
from sysid.logs.metrics import CHANNELS
from sysid.logs.planar import integrate_speeds
from sysid.logs.records import FAR, Command, GyroStream, Log, OdometryStream, PoseStream, Start, Trial, manoeuvre_of
from sysid.logs.stream_quality import clock_shift, response_shift
from sysid.logs.unusable import stood, without_standing
from sysid.logs.wheel_faults import backward_wheel
from sysid.logs.windows import WINDOW, in_windows
from whill_mjx.vehicle.specs import WHILL_CR

pytestmark = pytest.mark.quick
DT, HELD = 0.02, 100


def drive(name="a", seconds=30.0, seed=0, size=1.0, gain=1.0, limit=9.0, delay=0.2, pose=0.1):
    """Random steps that a vehicle follows late and exactly, or by a gain, or up to a limit."""
    rng, count = np.random.default_rng(seed), int(seconds / DT)
    told = np.repeat(size * rng.uniform(-1, 1, (count // HELD + 1, 2)), HELD, axis=0)[:count]
    t, late = np.arange(count) * DT, round(delay / DT)
    seen = np.clip(gain * np.concatenate([np.zeros((late, 2)), told[: count - late]]), -limit, limit)
    yaw = DT * np.cumsum(seen[:, 1])
    x, y = (DT * np.cumsum(seen[:, 0] * one(yaw)) for one in (np.cos, np.sin))
    rows = np.arange(0, count, round(pose / DT))
    return Trial(name, manoeuvre_of(name), Command(t, *told.T), OdometryStream(t, x, y, yaw, *seen.T),
                 PoseStream(t[rows], x[rows], y[rows], yaw[rows]), Start(), gyro=GyroStream(t, yaw))


def log_of(*trials):
    return Log("odd", WHILL_CR, trials, "")


def test_a_long_drive_is_cut_into_windows_that_begin_where_it_was():
    whole = drive(seconds=130.0)
    log = in_windows(log_of(whole, drive("short", seed=1)))
    assert len(log.trials) == 8 and log.trials[-1].name == "short" and "130 s" in log.notes[-1]
    assert sum(trial.duration for trial in log.trials[:-1]) > whole.duration - 1.0  # nothing of its end is lost
    for number, trial in enumerate(log.trials[:-1]):
        begin = number * whole.duration / 7
        assert trial.name == f"a/{number:03d}" and trial.duration <= WINDOW and trial.command.t[0] == 0.0
        first = np.searchsorted(whole.odometry.t, begin - 1e-9)
        np.testing.assert_allclose(trial.command.v[0], whole.command.v[first])
        np.testing.assert_allclose(trial.odometry.v[0], whole.odometry.v[first])
        if number:
            moved, start = trial.ground_truth, trial.start
            far = np.hypot(trial.odometry.x, trial.odometry.y)[::5][: len(moved.t)]
            np.testing.assert_allclose(np.hypot(moved.x - start.x, moved.y - start.y), far, atol=0.1)
            assert trial.start.measured and abs(trial.gyro.turn[-1]) > 0


@pytest.mark.parametrize(("way", "turn", "said"), [
    (1.0, 1.09, "turns 0.9.* the track is then"), (1.09, 1.09, "goes 0.9.* the wheel radius is then"), (1.02, 0.98, ""),
])  # fmt: skip
def test_nominal_sizes_that_the_outside_pose_contradicts_are_named(way, turn, said):
    trials = []
    for trial in (drive("a"), drive("b", seed=1)):
        o = trial.odometry
        trials.append(replace(trial, odometry=OdometryStream(o.t, None, None, None, way * o.v, turn * o.omega)))
    found = sanity(log_of(*trials))
    assert len(found) == bool(said) and all(re.search(said, one) for one in found)
    assert doubts(log_of(*trials)) == []  # a fit frees sizes itself


def test_the_clocks_of_a_drive_of_hours_are_compared_in_little_memory():
    trial = replace(drive(seconds=6 * 3600.0), gyro=None)
    fast = replace(trial.ground_truth, t=1.05 * trial.ground_truth.t)
    tracemalloc.start()
    said = running_fast("ground_truth", [replace(trial, ground_truth=fast)], "odometry")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "5% faster" in said and peak < 6e8


def test_a_drive_of_which_nothing_was_measured_after_its_first_command_is_no_fault():
    whole = drive(seconds=8.0)
    late = replace(whole, command=Command(whole.odometry.t[-1:], np.ones(1), np.ones(1)))
    assert running_fast("odometry", [late]) == ""


@pytest.mark.filterwarnings("error")
def test_an_outside_pose_that_begins_after_the_odometry_has_ended_shows_no_backward_wheel():
    whole = drive(seconds=12.0)
    early, late = whole.odometry.t < 5.0, whole.ground_truth.t > 6.0
    columns = {name: values[early] for name, values in vars(whole.odometry).items()}
    pose = {name: values[late] for name, values in vars(whole.ground_truth).items()}
    apart = replace(whole, odometry=OdometryStream(**columns), ground_truth=PoseStream(**pose))
    assert backward_wheel(log_of(apart)) == ""


def test_windows_of_a_drive_of_kilometres_begin_near_the_origin_of_their_room():
    log = in_windows(log_of(drive(seconds=130.0, size=30.0)))
    starts = np.array([[trial.start.x, trial.start.y] for trial in log.trials])
    assert np.hypot(*starts.T).max() < 1.5 * FAR
    for trial in log.trials:
        pose = trial.ground_truth
        assert abs(np.hypot(pose.x[0] - trial.start.x, pose.y[0] - trial.start.y)) < 5.0


def test_a_fit_and_a_loop_say_first_that_a_log_contradicts_itself():
    trial = drive("a")
    late = replace(trial, command=replace(trial.command, t=trial.command.t + 4.0))
    said = doubts(log_of(late))[0]
    assert re.match("Check the log: .* another clock", said)


def test_the_start_of_a_window_is_a_line_through_noisy_poses():
    rng, whole = np.random.default_rng(1), drive(seconds=130.0, size=0.0, gain=0.0)
    t = np.arange(0.0, 130.0, 0.05)
    noisy = PoseStream(t, 0.5 * t + rng.normal(0, 0.01, len(t)), rng.normal(0, 0.01, len(t)),
                       rng.normal(0, 0.01, len(t)))
    starts = [one.start for one in in_windows(log_of(replace(whole, ground_truth=noisy, odometry=None))).trials[1:]]
    assert max(abs(one.y) for one in starts) < 0.01
    assert all(0 < one.position_sigma < 0.008 and abs(one.v - 0.5) < 0.1 for one in starts)


def test_a_long_drive_that_is_repeated_stays_whole():
    log = log_of(drive("a_1", seconds=130.0), drive("a_2", seconds=130.0))
    assert in_windows(log) == log


def test_a_trial_in_which_the_vehicle_stands_is_left_out_and_a_dead_zone_is_not():
    moving = [drive(f"m_{i}", seed=i) for i in range(3)]
    stopped, slow = drive("stopped", seed=4, gain=0.0), drive("slow", seed=5, size=0.03, gain=0.0)
    assert stood([*moving, stopped, slow], 0.25) == ["stopped"]
    log = without_standing(log_of(*moving, stopped, slow), "odd")
    assert "stopped" not in [one.name for one in log.trials] and "stopped" in log.notes[-1]
    assert "stands" in sanity(log_of(*moving, stopped))[0] and not sanity(log_of(*moving))
    held = replace(stopped, held_out=True)
    assert without_standing(log_of(*moving, held), "odd").trials[-1] is held


def test_a_driver_that_leaves_its_speeds_at_zero_is_no_emergency_stop():
    moving = drive("m_1")
    empty = replace(moving, ground_truth=None, odometry=replace(moving.odometry, v=0 * moving.odometry.v,
                                                                omega=0 * moving.odometry.omega))
    assert stood([empty], 0.25) == []
    assert any("the driver does not fill the twist" in one for one in sanity(log_of(empty)))


def test_a_log_in_which_the_vehicle_never_moves_is_refused():
    with pytest.raises(ValueError, match="stands in all training trials"):
        without_standing(log_of(drive("a", gain=0.0), drive("b", seed=1, gain=0.0)), "odd")


def test_commands_beyond_what_the_vehicle_reaches_are_told_from_a_wrong_unit():
    found = sanity(log_of(*(drive(f"l_{i}", seed=i, size=4.0, limit=0.6) for i in range(3))))
    assert any("limited to about that" in one and "cut them in command.csv" in one for one in found)
    found = sanity(log_of(*(drive(f"g_{i}", seed=i, gain=0.2) for i in range(3))))
    assert found and not any("limited" in one for one in found)


@pytest.mark.parametrize("pose", [0.1, 0.5, 1.0])
def test_how_late_a_pose_is_does_not_depend_on_how_often_it_comes(pose):
    trial = drive(seconds=60.0, pose=pose)
    for shift in response_shift(trial, "ground_truth").values():
        assert shift.delay + shift.lag == pytest.approx(0.2, abs=0.06)
    for shift in clock_shift(trial).values():
        assert shift.delay == pytest.approx(0.0, abs=0.04) and shift.gain == pytest.approx(1.0, abs=0.12)


FIELDS = 'schema = 1\nvehicle = "whill_cr"\n'


def write(folder, fields, trial, *streams):
    place = folder / "trials" / trial.name
    place.mkdir(parents=True)
    (folder / "dataset.toml").write_text(FIELDS + fields)
    for name, header, table in (("command", "t,v,omega", trial.command.table), *streams):
        np.savetxt(place / f"{name}.csv", table, delimiter=",", header=header, comments="", fmt="%.9g")
    return folder


def test_replays_take_commands_beyond_the_stated_limits_as_they_were_recorded(tmp_path):
    trial = drive(size=4.0, limit=0.6)
    pose = "ground_truth", "t,x,y,yaw", np.column_stack([trial.ground_truth.t, trial.ground_truth.values])
    log = load_any(write(tmp_path, "command_limits = [0.6, 9.0]\n", trial, pose))
    np.testing.assert_allclose(log.trials[0].command.v, trial.command.v, rtol=1e-6, atol=1e-6)
    assert np.abs(trial.command.v).max() > 0.6


def test_a_gyro_alone_is_refused_with_the_reason(tmp_path):
    trial = drive()
    folder = write(tmp_path, "", trial, ("imu", "t,gyro", np.column_stack([trial.gyro.t, trial.gyro.turn])))
    with pytest.raises(ValueError, match="imu.csv alone shows no speed"):
        load_log(folder)


def test_windows_of_a_long_drive_can_be_held_out(tmp_path):
    trial = drive("whole", seconds=130.0)
    pose = "ground_truth", "t,x,y,yaw", np.column_stack([trial.ground_truth.t, trial.ground_truth.values])
    log = load_any(write(tmp_path, "", trial, pose), train=("whole:0-0.6",), held_out=("whole:0.6-1",))
    names = [one.name for one in (*log.training, *log.held_out)]
    assert names == [f"whole/{k:03d}" for k in range(len(names))] and len(log.training) > len(log.held_out) > 1


def paused(stream, begin, end):
    """A stream without its rows in a time."""
    kept = (stream.t < begin) | (stream.t > end)
    return type(stream)(*(getattr(stream, one)[kept] for one in stream.__dataclass_fields__))


@pytest.mark.parametrize(("streams", "named"), [
    (("command", "odometry", "ground_truth"), True), (("odometry", "ground_truth"), False), (("odometry",), False),
])  # fmt: skip
def test_a_time_of_which_nothing_was_recorded_is_named(streams, named):
    trial = drive()
    gappy = replace(trial, **{one: paused(getattr(trial, one), 10.3, 14.1) for one in streams})
    assert [one for one in sanity(log_of(gappy)) if "the recording paused" in one] == [
        "time: in 1 of 1 trials (a, from 10.3 to 14.1 s) no stream has a row, commands neither, though they come "
        "regularly otherwise: the recording paused, and what was sent meanwhile is unknown. Split the trial there."
    ] * named


def test_commands_that_come_only_where_they_change_are_no_pause_of_the_recording():
    trial = drive()
    seldom = Command(*(one[::HELD] for one in (trial.command.t, trial.command.v, trial.command.omega)))
    gappy = {one: paused(getattr(trial, one), 10.3, 11.4) for one in ("odometry", "ground_truth")}
    assert not any("recording paused" in one for one in sanity(log_of(replace(trial, command=seldom, **gappy))))


def set_forward(trial):
    """The trial by a clock that is set forward by an hour in it."""
    streams = {one: getattr(trial, one) for one in ("command", "odometry", "ground_truth")}
    return replace(trial, **{one: replace(stream, t=stream.t + 3600.0 * (stream.t > 15.0))
                             for one, stream in streams.items()})


def test_of_a_clock_that_was_set_forward_nothing_else_is_said():
    (said,) = sanity(log_of(set_forward(drive())))
    assert "the clock was set forward" in said


@pytest.mark.parametrize("known", [False, True], ids=["responses computed", "responses known"])
def test_a_clock_that_was_set_forward_in_one_trial_does_not_hide_the_faults_of_others(known):
    turned = [replace(one, odometry=replace(one.odometry, omega=57.3 * one.odometry.omega))
              for one in (drive("a"), drive("b", seed=1))]
    log = log_of(set_forward(drive("c", seed=2)), *turned)
    responses = {channel: {one.name: response_shift(one, channel) for one in log.trials} for channel in CHANNELS}
    found = sanity(log, responses if known else None)
    assert "in 1 of 3 trials (c" in found[0] and "the clock was set forward" in found[0]
    assert any("odometry" in one and "omega" in one for one in found[1:])
    assert found[1:] == sanity(log_of(*turned))


def test_a_jump_of_the_outside_pose_is_no_motion_of_the_vehicle():
    trial = drive(size=0.5)
    rest = trial.odometry.t > 20.0  # it comes to rest
    still = OdometryStream(trial.odometry.t, *(np.where(rest, one[~rest][-1], one) for one in (
        trial.odometry.x, trial.odometry.y, trial.odometry.yaw)), *(np.where(rest, 0.002, one) for one in (
            trial.odometry.v, trial.odometry.omega)))
    pose = PoseStream(*(one[::5] for one in (still.t, still.x, still.y, still.yaw)))
    jumpy = replace(pose, x=pose.x + 2.0 * (pose.t > 25.0))
    stopped = Command(trial.command.t, *(one * (trial.command.t < 19.8) for one in (
        trial.command.v, trial.command.omega)))
    said = sanity(log_of(replace(trial, odometry=still, ground_truth=jumpy, command=stopped)))
    assert any("ground_truth" in one and "jumps by 2.00 m" in one for one in said)
    assert not any("its rows repeat" in one for one in said)


def test_a_frame_whose_z_points_down_is_named():
    trial = drive()
    down = replace(trial.ground_truth, y=-trial.ground_truth.y, yaw=-trial.ground_truth.yaw)
    (said,) = sanity(log_of(replace(trial, ground_truth=down)))
    assert "z of its frame points down (NED): negate y and yaw" in said


@pytest.mark.parametrize("name", ["odometry", "ground_truth"])
def test_of_two_clocks_that_come_apart_the_faster_ones_gain_shows_no_unit(name):
    trials = [drive(f"a_{seed}", seconds=40.0, seed=seed, gain=0.47) for seed in range(2)]
    fast = [replace(one, **{name: replace(getattr(one, name), t=1.12 * getattr(one, name).t)}) for one in trials]
    assert sanity(log_of(*trials)) == []
    (said,) = sanity(log_of(*fast))
    assert re.match("(ground_truth|odometry): its clock runs", said)


@pytest.mark.parametrize("pose", [True, False])
def test_a_speed_without_a_sign_is_named(pose):
    t = np.arange(0.0, 40.0, 0.05)
    sent = np.select([t < 2, t < 30, t < 34], [0.0, 0.5, -0.3], 0.0)
    v, omega = np.interp(t - 0.2, t, sent), np.interp(t - 0.2, t, 0.4 * (t > 3))
    size = np.abs(v)
    places = integrate_speeds(t, v if pose else size, omega)
    trial = Trial("a_1", "a", Command(t, sent, 0.4 * (t > 3)), OdometryStream(t, *places, size, omega), None, Start())
    assert any("v is never negative" in one for one in sanity(log_of(trial)))
    forward = replace(trial, odometry=replace(trial.odometry, v=np.maximum(v, 0.0)))  # it has no reverse
    assert not any("v is never negative" in one for one in sanity(log_of(forward)))


def test_a_wheel_that_sticks_and_slips_is_no_empty_twist():
    t = np.arange(0.0, 6.0, 0.02)
    omega = np.where((t % 0.3 < 0.1) & (t > 1), 2.0, 0.0)
    v = np.full(len(t), 0.3)
    odometry = OdometryStream(t, *integrate_speeds(t, v, omega), v, omega)
    trial = Trial("stuck_1", "stuck", Command(t, v, np.full(len(t), 0.7)), odometry, None, Start())
    assert not [one for one in sanity(log_of(trial)) if "does not fill the twist" in one]
    assert [one for one in sanity(log_of(replace(trial, odometry=replace(odometry, omega=0 * omega))))
            if "speeds omega are all zero" in one]
