"""Looking at a log: sampling, clocks, signs, excitation, and what it cannot tell."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import shared_folder

import sysid
import sysid.inspect as inspect_module
from bridge.driving.command_table import check_space, make_table, reach_of, read_commands
from sysid.errors.space import make_space
from sysid.inspect import InspectConfig, main
from sysid.logs import replicates
from sysid.logs.coverage import blind_spots, excitation, replicate_spread, sanity, sign_changes
from sysid.logs.inspection import inspect, text
from sysid.logs.loaders import load_whole
from sysid.logs.log import load_log
from sysid.logs.metrics import ideal_replay
from sysid.logs.next_drives import next_drives
from sysid.logs.planar import integrate_speeds
from sysid.logs.records import Command, Log, OdometryStream, PoseStream, Start, Trial, manoeuvre_of, with_timeout
from sysid.logs.stream_quality import LAGS, clock_shift, find_shift, pose_jitter, quality, response_shift, standstill
from sysid.search import thin
from sysid.verdict.pipeline import check_logs
from whill_mjx.logs.dataset import COMMAND_HEADER, write_csv
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR, in_proportion

pytestmark = pytest.mark.quick
DT = 0.02
CHAIR = Path(sysid.__file__).parent / "data" / "chair"


def steps(seconds=20.0, dt=DT, seed=0):
    """Random steps every half second."""
    levels = np.random.default_rng(seed).uniform(-1, 1, int(seconds / 0.5))
    return np.repeat(levels, round(0.5 / dt))


def delayed(signal, delay, lag):
    """The signal on a 1 ms grid, delayed and lagged, back on the grid."""
    fine = np.repeat(signal, 20)
    moved = np.concatenate([np.full(round(delay * 1000), fine[0]), fine])[: len(fine)]
    out, y = np.empty_like(moved), moved[0]
    for i, u in enumerate(moved):
        y += (u - y) * (1 - np.exp(-0.001 / lag)) if lag else u - y
        out[i] = y
    return out[::20]


def delayed_slowly(signal, lag, dt=0.01):
    """The signal after a lag [s]."""
    out, y = np.empty_like(signal), signal[0]
    for i, u in enumerate(signal):
        y += (u - y) * (1 - np.exp(-dt / lag))
        out[i] = y
    return out


def trial_of(command, name="drive_1", offset=0.0, held_out=False, yaw=0.0):
    """A trial that follows its commands exactly, with the outside pose's clock `offset` seconds late."""
    t = np.arange(0.0, command.t[-1], 0.05)
    blank = np.zeros_like(t)
    shell = Trial(name, manoeuvre_of(name), command, OdometryStream(t, blank, blank, blank, blank, blank),
                  PoseStream(t, blank, blank, blank), Start(yaw=yaw), held_out)
    seen = ideal_replay(shell)
    return replace(shell, odometry=seen.odometry, ground_truth=replace(seen.ground_truth, t=t + offset))


def smooth_command(v=0.5, omega=0.6, seconds=20.0):
    t = np.arange(0.0, seconds, 0.01)
    wave = np.clip(t - 1.0, 0.0, 1.0)
    return Command(t, v * wave * (1 + 0.5 * np.sin(1.3 * t)), omega * wave * np.sin(0.9 * t))


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.14, 0.0), (0.06, 0.3), (-0.1, 0.0)])
def test_delay_and_lag_of_a_response_are_told_apart(delay, lag):
    signal = steps()
    late = delayed(signal, delay, lag) if delay >= 0 else np.roll(signal, round(delay / DT))
    shift = find_shift(signal, 0.8 * late, DT, lags=LAGS)
    assert shift.delay == pytest.approx(delay, abs=0.01)
    assert shift.lag == pytest.approx(lag, abs=1e-9)
    assert shift.gain == pytest.approx(0.8, abs=0.01)


def test_a_reversed_sign_is_found_as_a_negative_gain():
    shift = find_shift(steps(), -0.9 * delayed(steps(), 0.1, 0.0), DT)
    assert shift.gain == pytest.approx(-0.9, abs=0.02) and shift.correlation < -0.95


@pytest.mark.parametrize("signal", [np.zeros(1000), np.r_[np.zeros(5), np.ones(995)]])
def test_a_signal_that_hardly_changes_tells_no_shift(signal):
    assert find_shift(signal, signal + 0.0, DT) is None


def test_sampling_counts_gaps_jitter_and_repeats():
    t = np.arange(0, 200) * 0.05
    t[::2] += 0.004
    keep = np.ones(200, bool)
    keep[100:110] = False
    values = np.cumsum(np.ones((200, 2)), axis=0)
    values[50] = values[49]
    found = quality(t[keep], [values[keep], np.arange(190.0)[:, None]], np.ones(190, bool))
    assert found.rate == pytest.approx(20, rel=0.1)
    assert found.gaps == 1 and found.longest == pytest.approx(0.55, abs=0.01)
    assert found.missing == pytest.approx(0.05, abs=0.01)
    assert found.jitter == pytest.approx(0.004, abs=1e-3)
    assert found.held == pytest.approx(1 / 189)


def test_a_vehicle_at_rest_may_repeat_its_pose():
    t = np.arange(10) * 0.1
    assert quality(t, [np.ones((10, 3))], np.zeros(10, bool)).held == 0.0


@pytest.mark.parametrize("offset", [-0.08, 0.0, 0.12])
def test_the_clock_offset_between_odometry_and_outside_pose_is_found(offset):
    shifts = clock_shift(trial_of(smooth_command(), offset=offset))
    assert shifts["v"].delay == pytest.approx(offset, abs=0.01)
    assert shifts["omega"].delay == pytest.approx(offset, abs=0.01)


def test_an_ideal_vehicle_has_no_delay_after_its_command():
    for shift in response_shift(trial_of(smooth_command()), "odometry").values():
        assert abs(shift.delay) < 0.03 and shift.gain == pytest.approx(1.0, abs=0.02)


def test_a_pose_updated_on_another_clock_than_it_is_sampled_is_out_of_step():
    straight = trial_of(Command(np.arange(0.0, 20.0, 0.1), np.full(200, 0.6), np.zeros(200)))
    assert pose_jitter(straight) < 1e-3
    updated = np.floor(straight.odometry.t / 0.02 + 1e-6) * 0.02
    stale = replace(straight, odometry=replace(straight.odometry, x=0.6 * updated))
    assert pose_jitter(stale) == pytest.approx(0.01 / np.sqrt(2), rel=0.1)


def test_standstill_is_counted_before_and_after():
    command = Command(np.array([0.0, 2.0, 5.0]), np.array([0.0, 0.5, 0.0]), np.zeros(3))
    assert standstill(command, 9.0) == (2.0, 4.0)
    assert standstill(Command(np.array([0.0]), np.zeros(1), np.zeros(1)), 3.0) == (3.0, 3.0)


def test_sign_changes_ignore_noise_around_zero():
    assert sign_changes(np.array([0.5, 0.01, -0.01, 0.4, -0.3, 0.0, -0.2, 0.6]), 0.02) == 2


def test_excitation_counts_reversals_steps_and_path():
    t = np.arange(0.0, 6.0, 1.0)
    command = Command(t, np.array([0.0, 0.5, 0.5, -0.5, 0.05, 0.0]), np.zeros(6))
    found = excitation(trial_of(command))
    assert found.v == (-0.5, 0.5) and found.reversals == 2
    assert found.slow_seconds == pytest.approx(1.0)
    assert found.distance == pytest.approx(0.5 + 0.5 + 0.5 + 0.05)
    assert found.steps == 4


def log_of(*trials):
    return Log("toy", WHILL_CR, trials, "")


@pytest.mark.parametrize("part, factor, said, remedy", [
    ("xy", 0.5, "its pose goes 0.5 times as far as its own v says", "v is right: multiply x and y by 2"),
    ("yaw", 0.7, "its pose turns 0.7 times as far as its own omega says", "omega is right: multiply yaw by 1.4"),
    ("v", 2.0, "its pose goes 0.5 times as far as its own v says", "the pose is right: multiply v by 0.5"),
    ("omega", 0.5, "its pose turns 2 times as far as its own omega says", "the pose is right: multiply omega by 2"),
])  # fmt: skip
def test_an_odometry_whose_pose_and_speeds_differ_in_size_is_named(part, factor, said, remedy):
    good = trial_of(smooth_command())
    changed = {name: factor * getattr(good.odometry, name) for name in (("x", "y") if part == "xy" else (part,))}
    found = " ".join(sanity(log_of(replace(good, odometry=replace(good.odometry, **changed)))))
    assert f"odometry: {said}" in found and remedy in found
    close = {name: values * 1.1 / factor for name, values in changed.items()}
    assert "times as far" not in " ".join(sanity(log_of(replace(good, odometry=replace(good.odometry, **close)))))


def test_units_and_signs_that_the_commands_contradict_are_named():
    good = trial_of(smooth_command())
    assert sanity(log_of(good)) == []
    flipped = replace(good, odometry=replace(good.odometry, omega=-good.odometry.omega))
    assert any("odometry: omega" in one and "sign is reversed" in one for one in sanity(log_of(flipped)))
    backwards = replace(good, ground_truth=replace(good.ground_truth, yaw=good.ground_truth.yaw + np.pi))
    assert any("moves against its own yaw" in one for one in sanity(log_of(backwards)))
    degrees = replace(good, odometry=replace(good.odometry, omega=np.rad2deg(good.odometry.omega)))
    assert any("check its unit (rad/s)" in one for one in sanity(log_of(degrees)))
    folded = replace(good, ground_truth=replace(good.ground_truth, yaw=np.sin(good.ground_truth.yaw / 2)))
    assert not any("sign is reversed" in one for one in sanity(log_of(folded)))
    swapped = replace(good, command=Command(good.command.t, good.command.omega, good.command.v))
    assert any("the two columns are exchanged" in one for one in sanity(log_of(swapped)))
    t = np.arange(0.0, 20.0, 0.01)
    circle = trial_of(Command(t, 0.5 * np.sin(0.5 * t), 0.4 * np.sin(0.5 * t)))  # either follows either
    small = replace(circle.odometry, v=0.4 * circle.odometry.v, x=None, y=None, yaw=None)
    assert not any("exchanged" in one for one in sanity(log_of(replace(circle, odometry=small, ground_truth=None))))
    millimetres = replace(good, ground_truth=replace(good.ground_truth, x=1e3 * good.ground_truth.x,
                                                     y=1e3 * good.ground_truth.y))
    assert any("must be in metres" in one for one in sanity(log_of(millimetres)))


def counting_backwards(trial, side, track=WHILL_CR.track):
    """The trial with an odometry of wheels of which one counts backwards."""
    o, half = trial.odometry, (track if side == "left" else -track) / 2
    v, omega = half * o.omega, o.v / half
    return replace(trial, odometry=OdometryStream(o.t, *integrate_speeds(o.t, v, omega), v, omega))


@pytest.mark.parametrize("pose", [True, False])
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("turning", [0.6, 0.0])
def test_a_wheel_that_counts_backwards_is_named_instead_of_exchanged_columns_or_a_turned_pose(side, pose, turning):
    good = trial_of(smooth_command(omega=turning))
    good = good if pose else replace(good, ground_truth=None)
    wrong = counting_backwards(good, side)
    beside = "outside pose" if pose else "commands"
    (found,) = sanity(log_of(wrong))
    assert f"odometry: the {side} wheel counts backwards" in found and f"follow the {beside}" in found
    scale = float(re.search(r"v must become (\S+) omega", found)[1])
    assert scale == pytest.approx(0.248 if side == "left" else -0.248)
    np.testing.assert_allclose(scale * wrong.odometry.omega, good.odometry.v, atol=1e-9)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_wheel_that_counts_backwards_is_named_where_wheel_speeds_are_the_input(side):
    wrong = counting_backwards(trial_of(lively()), side)
    o = wrong.odometry
    trial = replace(wrong, command=Command(o.t, o.v, o.omega), odometry=None)
    (found,) = sanity(replace(log_of(trial), fields={"input": "wheels"}))
    assert f"command: the {side} wheel counts backwards" in found
    good = trial_of(lively())
    right = replace(good, command=Command(o.t, good.odometry.v, good.odometry.omega), odometry=None)
    assert sanity(replace(log_of(right), fields={"input": "wheels"})) == []


@pytest.mark.parametrize("pose", [True, False])
def test_exchanged_commands_are_no_wheel_that_counts_backwards(pose):
    good = trial_of(lively())
    swapped = replace(good, command=Command(good.command.t, good.command.omega, good.command.v))
    found = sanity(log_of(swapped if pose else replace(swapped, ground_truth=None)))
    assert len(found) == 1 + pose and all("the two columns are exchanged" in one for one in found)


def test_columns_are_not_said_to_be_exchanged_where_the_outside_pose_follows_them_as_they_are():
    good = trial_of(lively())
    o = good.odometry
    wrong = replace(good, odometry=OdometryStream(o.t, *integrate_speeds(o.t, o.omega, o.v), o.omega, o.v))
    found = sanity(log_of(wrong))
    assert found and not any("the two columns are exchanged" in one for one in found)


def lively(seconds=20.0):
    """Speeds that turn through many headings."""
    t = np.arange(0.0, seconds, 0.01)
    return Command(t, 0.4 * np.sin(1.1 * t) + 0.2 * (t > 1), 0.8 * np.sin(0.5 * t + 0.4) * (t > 1))


def lost(pose, **values):
    """Other values for a second."""
    gone = (pose.t > 9) & (pose.t < 10)
    return replace(pose, **{name: np.where(gone, one, getattr(pose, name)) for name, one in values.items()})


def inverted(pose):
    """The fixed frame as the vehicle sees it."""
    cos, sin = np.cos(pose.yaw), np.sin(pose.yaw)
    return replace(pose, x=-cos * pose.x - sin * pose.y, y=sin * pose.x - cos * pose.y, yaw=-pose.yaw)


def turned(pose, degrees):
    return replace(pose, yaw=pose.yaw + np.deg2rad(degrees))


@pytest.mark.parametrize(("change", "said"), [
    (lambda pose: turned(pose, 10), "the outside pose moves 10 deg to the right of its own heading.*--truth-turned 10"),
    (lambda pose: turned(pose, -90), "the outside pose moves 90 deg to the left of its own heading"),
    (lambda pose: replace(pose, y=-pose.y), "the frame is left-handed"),
    (lambda pose: replace(pose, x=pose.y, y=pose.x), "the frame is left-handed"),
    (lambda pose: replace(pose, t=pose.t + 5.0), "its motion comes (4.9|5.0|5.1) s later .* another clock"),
    (lambda pose: lost(pose, x=0.0, y=0.0, yaw=0.0), "its pose jumps by .* tracking was lost"),
    (lambda pose: lost(pose, yaw=pose.yaw + np.pi), "its pose jumps by 3.* rad .* took another body"),
    (lambda pose: replace(pose, yaw=0 * pose.yaw), "its yaw never changes, though .* turns"),
    (lambda pose: replace(pose, y=0 * pose.y), "its y never changes, though .* another axis up"),
    (lambda pose: inverted(pose), "parent and child are exchanged"),
    (lambda pose: replace(pose, t=pose.t + 18.0), "its motion comes (17.9|18.0|18.1) s later .* another clock"),
    (lambda pose: replace(pose, x=pose.x - np.sin(pose.yaw), y=pose.y + np.cos(pose.yaw)), "(0.9|1.0). m to the left"),
    (lambda pose: replace(pose, **{name: np.where(pose.t > 9, getattr(pose, name)[180], getattr(pose, name))
                                   for name in ("x", "y", "yaw")}), "its rows repeat while the odometry moves on"),
])
def test_an_outside_pose_that_contradicts_the_odometry_is_named_and_no_sign_is_said_to_be_reversed(change, said):
    good = trial_of(lively())
    assert sanity(log_of(good)) == []
    (found,) = sanity(log_of(replace(good, ground_truth=change(good.ground_truth))))
    assert re.search(said, found)


def reset_at_9_s(o):
    later = o.t > 9
    k = int(np.argmax(later))
    return replace(o, x=o.x - o.x[k] * later, y=o.y - o.y[k] * later, yaw=o.yaw - o.yaw[k] * later)


def held_up(o):
    frozen = np.where((o.t > 8) & (o.t < 10), np.argmax(o.t > 8), np.arange(len(o.t)))
    return replace(o, **{name: getattr(o, name)[frozen] for name in ("x", "y", "yaw", "v", "omega")})


@pytest.mark.parametrize(("change", "said"), [
    (reset_at_9_s, "at 9.[01] s.* its pose jumps by .* it was reset there"),
    (held_up, "its pose jumps by .* rows that repeat for (1.9|2.0) s: its driver was held up"),
    (lambda o: replace(o, v=o.v * np.cos(o.yaw)), "the twist is in the frame odom"),
    (lambda o: replace(o, v=0 * o.v), "its pose moves .*, but its speeds v are all zero"),
    (lambda o: replace(o, x=-o.y, y=o.x), "its pose moves 90 deg to the left of its own heading"),
    (lambda o: replace(o, y=-o.y, yaw=-o.yaw), "its yaw turns against its own omega"),
    (lambda o: inverted(o), "parent and child are exchanged"),
])
def test_odometry_whose_pose_and_speeds_contradict_each_other_is_named(change, said):
    good = trial_of(lively())
    found = sanity(log_of(replace(good, odometry=change(good.odometry))))
    assert re.search(said, found[0]) and not any("sign is reversed" in one for one in found)


def test_a_tracked_point_beside_the_axle_is_no_turned_axis():
    good = trial_of(lively())
    pose = good.ground_truth
    cos, sin = np.cos(pose.yaw), np.sin(pose.yaw)
    beside = replace(pose, x=pose.x + 0.2 * cos - 0.15 * sin, y=pose.y + 0.2 * sin + 0.15 * cos)
    assert sanity(log_of(replace(good, ground_truth=beside))) == []


def test_rows_in_bursts_are_named_and_do_not_shorten_the_path():
    good = trial_of(smooth_command())
    late = 0.5 * np.ceil(good.odometry.t / 0.5) + 1e-3 * (good.odometry.t % 0.5)
    found = sanity(log_of(replace(good, odometry=replace(good.odometry, t=late))))
    assert len(found) == 1 and "odometry: its rows come in bursts" in found[0] and "--stamp header" in found[0]


def test_a_clock_that_was_set_forward_in_the_drive_is_told_from_rows_that_were_lost():
    good = trial_of(smooth_command())

    def ahead(stream):
        return replace(stream, t=stream.t + 2.0 * (stream.t > 8))

    jumped = replace(good, command=ahead(good.command), odometry=ahead(good.odometry),
                     ground_truth=ahead(good.ground_truth))
    (found,) = sanity(log_of(jumped))
    assert "t jumps ahead by 2" in found and "clock was set forward" in found
    kept = (good.odometry.t < 8) | (good.odometry.t > 10)
    lost = {name: getattr(good.odometry, name)[kept] for name in ("t", "x", "y", "yaw", "v", "omega")}
    assert sanity(log_of(replace(good, odometry=OdometryStream(**lost)))) == []


def causes(log):
    return {one.cause for one in blind_spots(log, {trial.name: excitation(trial) for trial in log.trials})}


def test_blind_spots_name_what_a_poor_log_lacks():
    straight = Command(np.array([0.0, 4.0]), np.array([0.5, 0.0]), np.zeros(2))
    poor = trial_of(straight)
    found = causes(log_of(replace(poor, ground_truth=None)))
    assert found >= {"no outside pose", "no reversal", "no turn", "no slow crossing of zero", "nothing held out",
                     "no replicates", "no standstill before the first command", "hardly any standstill"}
    assert "no odometry" in causes(log_of(replace(poor, odometry=None)))
    assert "one heading of the room" in causes(log_of(poor))


def test_a_rich_log_has_only_the_blind_spot_that_driving_cannot_cure():
    t = np.arange(0.0, 40.0, 0.1)
    going = (t > 3) & (t < 36)
    v = np.where(going, 0.8 * np.sin(0.35 * (t - 3)), 0.0)
    omega = np.where(going, 0.9 * np.sin(0.21 * (t - 3)) * np.sign(np.sin(2.1 * t)), 0.0)
    slow = (t > 28) & (t < 36)
    v[slow], omega[slow] = 0.04, 0.0
    trials = [trial_of(Command(t, v, omega), f"mix_{k}", yaw=yaw) for k, yaw in ((1, 0.0), (2, 3.0))]
    abrupt = trials[1].odometry
    trials[1] = replace(trials[1], odometry=replace(abrupt, v=abrupt.v + (abrupt.t % 4 > 2) * 1.5))
    held = trial_of(Command(t, v, omega), "other_1", held_out=True)
    assert causes(log_of(*trials, held)) == {"velocities and poses only"}


def test_replicate_spread_is_the_deviation_between_drives():
    command = smooth_command()
    first, second = trial_of(command, "drive_1"), trial_of(command, "drive_2")
    second = replace(second, odometry=replace(second.odometry, v=second.odometry.v + 0.02))
    (group,) = replicate_spread((first, second))
    assert group["trials"] == ["drive_1", "drive_2"]
    assert group["spread"]["odometry.v"] == pytest.approx(0.02 / np.sqrt(2), rel=1e-6)
    assert group["spread"]["ground_truth.x"] == pytest.approx(0.0, abs=1e-9)


def test_the_command_writes_page_text_json_and_picture(tmp_path, capsys):
    main(InspectConfig(CHAIR, out=tmp_path / "seen"))
    page = (tmp_path / "seen" / "inspect.html").read_text()
    assert "9 trials of differential-drive powered chair, 214 s: nothing looks wrong" in page.partition("</header>")[0]
    assert "data:image/png" in page and "next_1.csv" in page
    printed = capsys.readouterr().out
    assert "What this log cannot determine" in printed and "figure_eight_1*" in printed
    found = json.loads((tmp_path / "seen" / "inspect.json").read_text())
    assert found["log"]["sha256"] == load_log(CHAIR).sha256
    assert found["streams"]["ground_truth"]["rate"] == pytest.approx(20, rel=0.01)
    assert (tmp_path / "seen" / "inspect.png").stat().st_size > 20_000
    main(InspectConfig(CHAIR, json=True))
    assert json.loads(capsys.readouterr().out)["clocks"].keys() == found["clocks"].keys()


def test_a_missing_folder_ends_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["inspect", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match="error: .*nowhere: no such folder"):
        inspect_module.cli()


@pytest.mark.parametrize(("name", "select", "channel"), [
    ("drive_norlab", ("warthog_grass_2024_07_18_continuous",), "odometry"), ("mrclam", ("robot1",), "ground_truth")])
def test_measured_sets_are_inspected_in_their_original_form(name, select, channel):
    log = load_whole(shared_folder(name), select)
    found = inspect(log)
    assert found["streams"][channel]["samples"] > 100 and found["trials"][0]["seconds"] > 1
    assert "nothing held out" in text(found)


def paused(timeout, pause=2.0):
    """A drive at a steady speed in which commands pause and the base stops by its time-out (none where it is inf)."""
    sent = np.arange(0.0, 16.0, 0.1)
    sent = sent[(sent <= 6.0) | (sent >= 6.0 + pause)]
    command = Command(sent, np.where(sent < 14.0, 0.5, 0.0) * (sent > 1.0), 0.0 * sent)
    held = with_timeout(command, timeout) if np.isfinite(timeout) else command
    return replace(trial_of(held), command=command)


@pytest.mark.parametrize("timeout", [0.3, 0.8])
def test_a_base_that_stops_by_its_time_out_while_commands_pause_is_named_with_the_time(timeout):
    (found,) = sanity(log_of(paused(timeout)))
    assert "its base has a time-out" in found
    assert float(re.search(r"command_timeout = ([\d.]+)", found)[1]) == pytest.approx(timeout, abs=0.06)


def test_commands_of_another_clock_and_cut_off_ones_are_named_and_no_sign_or_unit_is_doubted():
    good = trial_of(lively())
    command = good.command
    late = sanity(log_of(replace(good, command=replace(command, t=command.t + 5.0))))
    assert late and all(re.search("comes (4|5).. s earlier than the commands: another clock", one) for one in late)
    first = command.t < 6.0
    (found,) = sanity(log_of(replace(good, command=Command(command.t[first], command.v[first], command.omega[first]))))
    assert re.search("the commands end .* s before the odometry", found)


@pytest.mark.parametrize(("stream", "rate"), [("ground_truth", 0.05), ("odometry", -0.04)])
def test_a_clock_that_runs_fast_or_slow_is_named_with_its_stream_and_rate(stream, rate):
    good = trial_of(lively())
    source = getattr(good, stream)
    (found,) = sanity(log_of(replace(good, **{stream: replace(source, t=source.t * (1 + rate))})))
    assert found.startswith(f"{stream}: its clock runs") and ("faster" if rate > 0 else "slower") in found
    assert float(re.search(r"runs about (\d)%", found)[1]) == pytest.approx(100 * abs(rate), abs=1)


@pytest.mark.parametrize("lag", [0.6, 1.2])
def test_a_slow_answer_to_ramps_is_no_clock_that_runs_slow(lag):
    t = np.arange(0.0, 8.0, 0.01)
    ramp = np.clip(np.floor(t) / 8, 0.0, 0.8)
    good = trial_of(Command(t, ramp, 0 * t))
    late = np.interp(good.odometry.t, t, delayed_slowly(ramp, lag))
    moved = replace(good, odometry=replace(good.odometry, v=late, x=None, y=None, yaw=None), ground_truth=None)
    assert not any("clock" in one for one in sanity(log_of(moved)))


def test_a_turn_on_the_spot_with_a_marker_ahead_is_no_frozen_odometry():
    t = np.arange(0.0, 12.0, 0.01)
    good = trial_of(Command(t, 0 * t, 0.6 * np.sin(t)))
    pose = good.ground_truth
    ahead = replace(pose, x=pose.x + 0.4 * np.cos(pose.yaw), y=pose.y + 0.4 * np.sin(pose.yaw))
    assert not any("rows repeat" in one for one in sanity(log_of(replace(good, ground_truth=ahead))))


def test_a_base_that_drives_on_while_commands_pause_is_fine():
    assert sanity(log_of(paused(np.inf))) == []


def test_the_time_of_one_stream_in_other_units_is_named_with_its_file(tmp_path):
    shutil.copytree(CHAIR, tmp_path / "log")
    path = tmp_path / "log" / "trials" / "turn_1" / "odometry.csv"
    header, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    path.write_text("\n".join([header, *(",".join([f"{1000 * float(t):.1f}", *rest]) for t, *rest in cells)]))
    with pytest.raises(ValueError, match=r"turn_1/odometry.csv: t steps by 50 .* in milliseconds. Divide t by 1000"):
        load_log(tmp_path / "log")


def test_parameters_that_a_log_cannot_show_are_not_searched_and_the_report_says_which():
    log = load_log(CHAIR)
    space = make_space(preset_params(log.spec, "physical"), log.spec)
    blind = replace(log, trials=tuple(replace(one, ground_truth=None) for one in log.trials))
    bound = thin.without_hidden(space, blind, ("slip_traction.mu",))
    assert "slip_traction.slip_speed" not in bound.names and "slip_traction.mu" in bound.names
    (note,) = thin.notes(bound)
    assert "no outside pose" in note and "slip_traction.slip_speed" in note
    assert thin.without_hidden(space, log).names == space.names and thin.notes(space) == []
    straight = log.select(lambda one: one.name.startswith("straight"))
    assert "body.yaw_inertia" not in thin.without_hidden(space, straight).names


def test_a_log_in_which_nothing_moves_is_refused():
    still = trial_of(Command(np.arange(0.0, 9.0, 0.1), np.zeros(90), np.zeros(90)))
    with pytest.raises(ValueError, match="commanded to move for 0.0 s in all, which determines nothing"):
        thin.check_moves(log_of(still))
    thin.check_moves(log_of(trial_of(smooth_command())))


def test_drives_that_are_shorter_than_what_motion_is_looked_at_over_are_refused():
    t = np.arange(0.0, 0.2, 0.02)
    short = [trial_of(Command(t, np.full(10, 0.5), 0 * t), name=f"a_{k}") for k in range(30)]
    for check in (thin.check_moves, check_logs):
        with pytest.raises(ValueError, match="'toy': its training trials last 0.15 s at most, .* over 0.25 s"):
            check(log_of(*short))


def test_a_small_robot_drives_at_speeds_at_which_a_chair_stands():
    t = np.arange(0.0, 9.0, 0.1)
    log = log_of(trial_of(Command(t, np.full(90, 0.03), np.zeros(90))))
    with pytest.raises(ValueError, match="below 0.05 m/s and 0.1 rad/s do not count"):
        thin.check_moves(log)
    small = replace(log, spec=in_proportion(WHILL_CR, "small", wheel_radius=0.033, track=0.16))
    thin.check_moves(small)
    assert thin.causes(small.training, thin.drives_from(small.spec)) == ["no turn"]


def test_a_first_glance_passes_all_drives_with_the_same_commands():
    base = steps(20.0)[: 950]
    t = 0.02 * np.arange(len(base))
    one = trial_of(Command(t, base, 0.5 * base[::-1]))
    late = trial_of(Command(t + 1.3, base, 0.5 * base[::-1]))
    other = trial_of(Command(t, -base, 0.5 * base[::-1]))
    first, second, third = (replicates.glance(replicates.course_of(trial)) for trial in (one, late, other))
    assert replicates.may_be_alike(first, second) and not replicates.may_be_alike(first, third)


def lacking_turns():
    straight = log_of(trial_of(Command(np.arange(0.0, 9.0, 0.1), np.full(90, 0.3), np.zeros(90))))
    return straight, blind_spots(straight, {one.name: excitation(one) for one in straight.trials})


def test_the_next_drives_show_what_a_log_lacks_with_ramps_within_the_space():
    drives = next_drives(*lacking_turns(), (4.0, 4.0), 0.4)
    assert len(drives) == 3 and drives[0].why == "no turn" and np.ptp(drives[0].command.omega) > 0.2
    for drive in drives:
        command, dt = drive.command, np.diff(drive.command.t)
        assert max(abs(command.v).max(), abs(command.omega).max()) <= 0.8 and abs(command.v).max() <= 0.4
        assert (abs(np.diff(command.v)) <= 0.5 * dt + 1e-9).all() and (abs(np.diff(command.omega)) <= dt + 1e-9).all()
        assert command.v[-1] == command.omega[-1] == command.v[0] == 0.0 and max(drive.floor) <= 4.0
    assert next_drives(*lacking_turns(), (1.0, 1.0), 0.4) == []


@pytest.mark.parametrize("space", [(2.5, 2.5), (4.0, 4.0), (2.5, 7.0)])
def test_the_bridge_takes_the_next_drives(tmp_path, space):
    drives = next_drives(*lacking_turns(), space)
    assert drives
    for drive in drives:
        write_csv(tmp_path / "next.csv", COMMAND_HEADER, drive.command.table)
        table = make_table(read_commands(tmp_path / "next.csv"), (-0.6, -1.0), (0.6, 1.0), (1.0, 2.0))
        reach = reach_of(table, drive.radius, 0.15)
        check_space(reach, space)  # raises where it does not fit
        assert (reach.length, reach.width) == pytest.approx(drive.floor, abs=0.05)


def test_a_manoeuvre_counts_as_driven_where_its_name_says_more():
    log = load_log(CHAIR)
    renamed = replace(log, trials=tuple(replace(one, manoeuvre=f"Monday_{one.manoeuvre}") for one in log.trials))
    why = {one.name: one.why for one in next_drives(renamed, ())}
    assert why == {one.name: one.why for one in next_drives(log, ())}
    assert "no drive of the log has this name" in why.values() and "circle" not in {
        name for name, reason in why.items() if reason == "no drive of the log has this name"}


def test_the_table_of_drives_stays_in_line_for_long_names_and_hints_can_be_copied(tmp_path, capsys):
    log = load_log(CHAIR)
    long = replace(log, trials=tuple(replace(one, name=f"a_long_name_of_a_drive_{one.name}") for one in log.trials))
    rows = [line for line in text(inspect(long)).splitlines() if line.startswith("  a_long_name") and ".." in line]
    table = [row for row in rows if " / " in row]
    assert len(table) == len(log.trials) and len({row.index(" .. ") for row in table}) == 1
    out = tmp_path / "my runs"
    main(InspectConfig(CHAIR, out=out))
    hints = [one["drive_it"] for one in json.loads((out / "inspect.json").read_text())["next_drives"]]
    assert hints and all(Path(shlex.split(hint)[3]).is_file() for hint in hints)
    assert hints[0] in capsys.readouterr().out
