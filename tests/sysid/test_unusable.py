"""Outside poses that contradict a yaw rate measured on the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid.logs.coverage import sanity
from sysid.logs.records import Command, Log, OdometryStream, PoseStream, Start, Trial
from sysid.logs.unusable import LEAST, lost, without_lost, yaw_contradiction
from sysid.search.fitting import make_problem
from sysid.search.settings import FitConfig
from whill_mjx.vehicle.specs import WARTHOG

pytestmark = pytest.mark.quick
T = np.arange(0.0, 6.0, 0.05)
RATE = np.where(T < 3.0, 0.8, -0.5)


def turned(at, rate=RATE):
    """Yaw [rad] after the times `at`; before the first one the vehicle turns as then."""
    yaw = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(T))])
    return np.interp(at, T, yaw) + np.minimum(at, 0.0) * rate[0]


def trial(name, late=0.0, factor=1.0, jump=0.0, held_out=False):
    """Turning on the spot, seen `late` [s] and with its yaw `jump` [rad] off from 2 s on."""
    seen = np.arange(0.2, 6.0, 0.2)
    yaw = factor * (turned(seen - late) - turned(-late)) + jump * (seen >= 2.0)
    none = np.zeros_like(seen)
    return Trial(name, name, Command(np.zeros(1), np.zeros(1), RATE[:1]),
                 OdometryStream(T, None, None, None, 0 * T, RATE), PoseStream(seen, none, none, yaw),
                 Start(omega=RATE[0], measured=True), held_out=held_out)


def log(trials):
    return Log("test", WARTHOG, tuple(trials), "", (), {"yaw_rate": {one.name: (T, RATE) for one in trials},
                                                        "pose_stamps": "receipt"})


@pytest.mark.parametrize("late, factor", [(0.0, 1.0), (0.55, 1.0), (0.0, 1.1), (0.9, 0.9)])
def test_a_late_pose_and_a_gyro_of_another_scale_are_no_contradiction(late, factor):
    assert yaw_contradiction(trial("a", late, factor), (T, RATE)) < 0.03


@pytest.mark.parametrize("late", [0.0, 0.55])
def test_a_jump_of_the_yaw_is_a_contradiction_of_its_size_at_most(late):
    found = yaw_contradiction(trial("a", late, jump=-1.5), (T, RATE))
    assert 0.7 < found <= 1.5


def test_a_trial_without_outside_pose_is_not_judged():
    assert np.isnan(yaw_contradiction(replace(trial("a"), ground_truth=None), (T, RATE)))


def test_lost_training_trials_are_left_out_with_a_note_and_held_out_ones_are_kept():
    good = [trial(f"good{i}") for i in range(LEAST)]
    given = log([*good, trial("bad", jump=-1.5), trial("judged", jump=-1.5, held_out=True)])
    assert lost(given) == ("bad", "judged")
    kept = without_lost(given)
    assert [one.name for one in kept.training] == [one.name for one in good]
    assert [one.name for one in kept.held_out] == ["judged"]
    assert "1 of 9 training trials" in kept.notes[-1] and "not fitted" in kept.notes[-1]


def test_where_too_few_others_are_left_lost_trials_are_fitted_and_a_note_says_so():
    given = log([*(trial(f"good{i}") for i in range(LEAST - 1)), trial("bad", jump=-1.5)])
    kept = without_lost(given)
    assert kept.trials == given.trials and "fitted all the same" in kept.notes[-1]


def test_a_log_without_a_yaw_rate_stays_as_it_is():
    given = replace(log([trial("bad", jump=-1.5)]), fields={})
    assert without_lost(given) is given


def test_the_inspection_names_lost_poses():
    given = log([trial("good"), trial("bad", jump=-1.5)])
    assert any("1 of 2 trials (bad, at 2.0 s)" in one and "pose jumps" in one for one in sanity(given))
    assert not any("pose jumps" in one for one in sanity(log([trial("good")])))


def test_a_pose_stamped_on_receipt_is_fitted_with_its_delay():
    given = log([trial("a"), trial("b")])
    assert "pose_delay.delay" in make_problem(given, FitConfig(physics_dt=0.01)).space.names
    stamped = replace(given, fields={})
    assert "pose_delay.delay" not in make_problem(stamped, FitConfig(physics_dt=0.01)).space.names
    alone = make_problem(given, FitConfig(physics_dt=0.01, channels="ground_truth"))
    assert "pose_delay.delay" not in alone.space.names  # nothing tells it from a late command
