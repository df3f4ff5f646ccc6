"""The four errors, the ideal replay and the replicate noise against known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid.errors.noise import replicate_groups as groups_of_bins
from sysid.logs.metrics import ideal_replay, integrate, noise_floor, replicate_groups, rmse, score
from sysid.logs.records import Command, OdometryStream, PoseStream, Prediction, Start, Trial, manoeuvre_of
from sysid.pages.report import summaries
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES, Scenario, command_table

pytestmark = pytest.mark.quick


def pose(t, x, y, yaw):
    return PoseStream(t, *(np.broadcast_to(value, t.shape).astype(float) for value in (x, y, yaw)))


def trial_of(truth, command=None, name="circle_1", start=None, odometry=None):
    command = command or Command(np.array([0.0]), np.array([0.0]), np.array([0.0]))
    return Trial(name, manoeuvre_of(name), command, odometry, truth, start or Start())


def test_trajectory_error_is_the_rms_distance_and_yaw_its_own_number():
    t = np.arange(4.0)
    errors = score(trial_of(pose(t, 0, 0, 0)), Prediction(pose(t, 3.0, 4.0, 0.5), None))["ground_truth"]
    assert errors["trajectory"] == pytest.approx(5.0) and errors["yaw"] == pytest.approx(0.5)
    assert errors["velocity"] is None


def test_odometry_and_outside_pose_are_scored_apart():
    t = np.arange(4.0)
    one = np.ones(4)
    odometry = OdometryStream(t, one, one, one, one, one)
    shifted = OdometryStream(t, one, one, one, one + 0.2, one - 0.3)
    scores = score(trial_of(pose(t, 0, 0, 0), odometry=odometry), Prediction(pose(t, 1.0, 0, 0), shifted))
    assert scores["ground_truth"]["trajectory"] == pytest.approx(1.0)
    assert scores["odometry"]["trajectory"] == 0.0
    assert scores["odometry"]["velocity"] == pytest.approx(0.2)
    assert scores["odometry"]["angular_velocity"] == pytest.approx(0.3)


def test_the_ideal_replay_drives_a_circle_back_to_its_start():
    command = Command(np.array([0.0]), np.array([0.5]), np.array([0.5]))
    t = np.array([0.0, np.pi, 2 * np.pi, 4 * np.pi])
    x, y, yaw = integrate(command, Start(1.0, 2.0, 0.0), t)
    np.testing.assert_allclose(x, [1.0, 2.0, 1.0, 1.0], atol=1e-12)  # radius 1, centre (1, 3)
    np.testing.assert_allclose(y, [2.0, 3.0, 4.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(yaw, 0.5 * t)


def test_the_start_speeds_hold_until_the_first_command():
    command = Command(np.array([1.0]), np.array([0.0]), np.array([0.0]))
    x, _, _ = integrate(command, Start(v=0.5), np.array([0.5, 1.0, 3.0]))
    np.testing.assert_allclose(x, [0.25, 0.5, 0.5])


def test_an_ideal_vehicle_has_no_error():
    command = Command(*command_table("figure_eight", Scenario()).T)
    t = np.arange(0.0, 20.0, 0.05)
    start = Start(1.0, -2.0, 0.7)
    truth = PoseStream(t, *integrate(command, start, t))
    trial = trial_of(truth, command, start=start)
    assert score(trial, ideal_replay(trial))["ground_truth"]["trajectory"] < 1e-12


def test_replicate_noise_is_found_whatever_the_start_pose():
    random = np.random.default_rng(0)
    command = Command(*command_table("straight", Scenario()).T)
    t = np.arange(0.0, 10.0, 0.02)
    trials = []
    for i in range(1, 4):
        start = Start(*random.normal(size=3))
        x, y, yaw = integrate(command, start, t)
        noise = random.normal(size=(3, len(t))) * [[0.02], [0.02], [0.01]]
        truth = PoseStream(t, x + noise[0], y + noise[1], yaw + noise[2])
        trials.append(trial_of(truth, command, f"straight_{i}", start))
    floor = noise_floor(tuple(trials))
    assert floor["ground_truth"]["trajectory"] == pytest.approx(0.02 * np.sqrt(2), rel=0.05)
    assert floor["ground_truth"]["yaw"] == pytest.approx(0.01, rel=0.05)
    assert noise_floor(tuple(trials[:1])) is None


def test_a_held_out_drive_is_held_against_its_replicates_in_the_training_trials():
    """In a report, beside drives that repeat better: of each part the mean over its trials."""
    random = np.random.default_rng(0)
    t = np.arange(0.0, 10.0, 0.02)
    trials = []
    for manoeuvre, spread in (("straight", 0.02), ("circle", 0.1)):
        command = Command(*command_table(manoeuvre, Scenario()).T)
        for i in range(1, 4):
            x, y, yaw = integrate(command, Start(0.0, 0.0, 0.0), t)
            truth = PoseStream(t, x + spread * random.normal(size=len(t)), y, yaw)
            trial = trial_of(truth, command, f"{manoeuvre}_{i}")
            trials.append(replace(trial, held_out=manoeuvre == "straight" or i == 3))
    floors = {part: floor["ground_truth"]["trajectory"]
              for part, floor in summaries([], tuple(trials))["noise_floor"].items()}
    assert floors["training"] == pytest.approx(0.1, rel=0.05)
    assert floors["held_out"] == pytest.approx((3 * 0.02 + 0.1) / 4, rel=0.05)
    assert summaries([], (trials[0], trials[3]))["noise_floor"] == {"training": None, "held_out": None}


def test_only_numbered_trials_with_equal_commands_are_replicates():
    t = np.arange(3.0)
    other = Command(np.array([0.0]), np.array([0.1]), np.array([0.0]))
    trials = (trial_of(pose(t, 0, 0, 0), name="a_1"), trial_of(pose(t, 0, 0, 0), name="a_2"),
              trial_of(pose(t, 0, 0, 0), other, name="a_3"), trial_of(pose(t, 0, 0, 0), name="b_1"))
    assert [[trial.name for trial in group] for group in replicate_groups(trials)] == [["a_1", "a_2"]]


@pytest.mark.parametrize("name", PAPER_MANOEUVRES)
def test_every_manoeuvre_starts_and_ends_at_rest(name):
    command = Command(*command_table(name, Scenario(v=0.4, omega=0.7, length=5.0)).T)
    rest = command.t < 0.95
    assert not command.v[rest].any() and not command.omega[rest].any()
    assert command.v[-1] == command.omega[-1] == 0.0
    assert max(np.abs(command.v).max(), np.abs(command.omega).max()) in (0.4, 0.7)


def test_the_figure_eight_turns_as_far_to_the_left_as_to_the_right():
    command = Command(*command_table("figure_eight", Scenario(omega=0.5)).T)
    assert command.omega.sum() * 0.1 == pytest.approx(0.0, abs=0.11)
    assert rmse(np.array([3.0, 4.0])) == pytest.approx(np.sqrt(12.5))
    with pytest.raises(ValueError, match="unknown manoeuvre"):
        Command(*command_table("spiral").T)


def recorded(name, begin=0.0, period=0.1, jitter=0.0, seed=0, lost=0.0, slower=1.0, size=1.0, late=0.0):
    """A recording that began `begin` seconds before a drive of steps, forward and turning, given at some period."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, begin + 14.0 * slower, period)
    t = t + jitter * random.uniform(size=len(t))
    t = t[random.uniform(size=len(t)) >= lost]
    step = np.floor((t - begin) / slower).astype(int)
    levels = np.random.default_rng(7).choice([-0.6, -0.3, 0.2, 0.5], size=(2, 12)) * size
    going = (step >= 0) & (step < 12)
    v, omega = (np.where(going, row[np.clip(step, 0, 11)], 0.0) for row in levels)
    command = Command(t, v, omega)
    seen = np.arange(0.0, t[-1], 0.02)
    return trial_of(PoseStream(seen + late, *integrate(command, Start(), seen)), command, name)


@pytest.mark.parametrize("other", [
    {"begin": 3.3}, {"jitter": 0.04, "seed": 3}, {"lost": 0.03, "seed": 4}, {"period": 0.05},
    {"begin": 1.234, "jitter": 0.03, "seed": 5, "lost": 0.02}])
def test_recordings_of_one_drive_are_replicates_whenever_they_began_and_whatever_got_lost(other):
    first, second = recorded("steps_1", begin=2.0, jitter=0.03), recorded("steps_2", **{"begin": 2.0, **other})
    assert [[one.name for one in group] for group in replicate_groups((first, second))] == [["steps_1", "steps_2"]]
    noise = noise_floor((first, second))["ground_truth"]  # the drives themselves differ by the times of their commands
    assert noise["trajectory"] < 0.1


@pytest.mark.parametrize("other", [{"slower": 1.4}, {"slower": 1.1}, {"size": 0.9}, {"size": -1.0}])
def test_drives_with_the_same_commands_at_other_times_or_of_another_size_are_no_replicates(other):
    assert replicate_groups((recorded("steps_1", begin=2.0), recorded("steps_2", begin=2.0, **other))) == []


def test_drives_cut_out_of_recordings_are_replicates_by_name():
    names = ("steps-01", "steps_2-01", "steps_2024_05_31-10_20_30", "steps_2024_06_01-09_00_00-02", "turn-02")
    groups = replicate_groups(tuple(recorded(name, begin=begin) for begin, name in enumerate(names)))
    assert [[one.name for one in group] for group in groups] == [list(names[:4])]


def test_the_noise_of_replicates_does_not_count_when_their_recordings_began():
    first, second = recorded("steps_1"), recorded("steps_2", begin=2.5)
    assert noise_floor((first, second))["ground_truth"]["trajectory"] < 1e-6


def test_bins_of_replicates_are_compared_only_where_they_show_the_same_moment():
    trials = (recorded("steps_1", begin=2.0), recorded("steps_2", begin=2.0, jitter=0.01),
              recorded("steps_3", begin=2.6))
    assert groups_of_bins(trials) == [[0, 1], [2]]
