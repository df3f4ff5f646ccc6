"""Single trials that do not belong to the others of a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid.logs.coverage import faults
from sysid.logs.log import load_log
from sysid.logs.odd_trials import odd_trials
from sysid.logs.records import Command

pytestmark = pytest.mark.quick


@pytest.fixture(scope="module")
def chair():
    return load_log("sysid/data/chair")


def changed(log, name, **streams):
    return replace(log, trials=tuple(replace(one, **streams) if one.name == name else one for one in log.trials))


def test_trials_that_belong_together_are_not_blamed(chair):
    assert faults(chair) == []


@pytest.mark.parametrize(("seconds", "said"), [(1.5, "1.5 s later"), (-3.0, "3.0 s earlier")])
@pytest.mark.parametrize("name", ["random_1", "circle_1"])
def test_a_pose_that_is_late_in_one_trial_is_named_with_it(chair, name, seconds, said):
    pose = next(one for one in chair.trials if one.name == name).ground_truth
    [found] = faults(changed(chair, name, ground_truth=replace(pose, t=pose.t + seconds)))
    assert f"in {name} its motion comes {said}" in found


def test_the_pose_of_another_trial_is_named(chair):
    pose = next(one for one in chair.trials if one.name == "circle_1").ground_truth
    [found] = faults(changed(chair, "random_1", ground_truth=pose))
    assert "in random_1 the outside pose does not turn with the odometry" in found


def test_a_drive_without_commands_is_named_with_its_way(chair):
    random = next(one for one in chair.trials if one.name == "random_1")
    still = Command(random.command.t, *np.zeros((2, len(random.command.t))))
    [found] = faults(changed(chair, "random_1", command=still))
    way = float(np.hypot(np.ptp(random.ground_truth.x), np.ptp(random.ground_truth.y)))
    assert found.startswith(f"command: in random_1 all commands are zero while the vehicle moves {way:.1f} m")


def test_noise_at_rest_is_no_drive_and_two_trials_at_rest_are_no_copies(chair):
    first, random = chair.trials[0], np.random.default_rng(0)
    command = Command(first.command.t, *np.zeros((2, len(first.command.t))))
    pose = first.ground_truth
    noisy = replace(pose, x=random.normal(0, 0.01, len(pose.t)), y=random.normal(0, 0.01, len(pose.t)),
                    yaw=random.normal(0, 0.02, len(pose.t)))
    odometry = replace(first.odometry, **dict.fromkeys(("x", "y", "yaw", "v", "omega"), 0 * first.odometry.v))
    rest = replace(first, command=command, ground_truth=noisy, odometry=odometry)
    assert odd_trials((*chair.trials, replace(rest, name="one"), replace(rest, name="two"))) == []


def test_straight_drives_with_a_noisy_pose_are_of_their_own_log(chair):
    random = np.random.default_rng(0)
    trials = [replace(one, ground_truth=replace(one.ground_truth, yaw=one.ground_truth.yaw + random.normal(
        0, 0.02, len(one.ground_truth.t)))) for one in chair.trials]
    assert odd_trials(trials) == []


def test_a_copy_is_no_replicate(chair):
    first = chair.trials[0]
    [found] = faults(replace(chair, trials=(*chair.trials, replace(first, name="again"))))
    assert found.startswith(f"trials: again has the same rows as {first.name}.")


def test_motion_before_its_commands_is_another_clock(chair):
    early = tuple(replace(one, ground_truth=replace(one.ground_truth, t=one.ground_truth.t - 0.5))
                  for one in chair.trials)
    [found] = faults(replace(chair, trials=early))
    assert found.startswith("ground_truth: its motion comes") and "before the commands that cause it" in found


@pytest.mark.parametrize(("timeout", "odd"), [(0.5, False), (0.02, True)])
def test_a_time_out_that_ends_before_the_next_command_is_named(chair, timeout, odd):
    found = faults(replace(chair, fields={**chair.fields, "command_timeout": timeout}))
    assert [f"command_timeout is {timeout:g} s" in one for one in found] == [True] * odd
