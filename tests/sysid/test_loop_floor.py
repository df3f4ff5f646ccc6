"""Another floor as one change of several base parameters, in a linear world where the truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.errors.noise import Whitener
from sysid.errors.space import Space
from sysid.logs.log import Command, Log, PoseStream, Start, Trial
from sysid.missing.days import Leftover, Reference
from sysid.missing.joint_fit import Refit
from sysid.missing.reference import BLOCK, _spread
from sysid.verdict.floor import floor_change
from sysid.verdict.preparation import BLOCKS, days_of
from whill_mjx.vehicle.specs import HUSKY

NAMES = ("torque_drive.kp", "turn_efficiency.efficiency", "yaw_scrub.torque", "rolling_resistance.mu_r")
SPACE = Space(NAMES, np.array([1.0, 0.5, 0.0, 0.0]), np.array([9.0, 1.3, 10.0, 0.08]), np.array([5.0, 0.8, 2.0, 0.02]),
              np.zeros(4, bool))
DAYS, SPREAD, ALPHA = 6, 0.01, 0.005

pytestmark = pytest.mark.quick


def reference(random) -> Reference:
    days = SPREAD * random.standard_normal((DAYS, len(NAMES)))
    trial = Trial("a", "a", Command(np.zeros(1), np.zeros(1), np.zeros(1)), None,
                  PoseStream(np.ones(2), np.zeros(2), np.zeros(2), np.zeros(2)), Start())
    left = Leftover(trial, 0, np.zeros((4, 5)), np.ones((4, 5)))
    whitener = Whitener(np.ones(5), np.zeros((1, 5, 5)), np.eye(5))
    return Reference(None, SPACE, SPACE.to_unit(SPACE.initial), SPREAD**2 * np.eye(len(NAMES)), days, whitener,
                     np.ones((4, 5)), (left,), 0.25, True, "")


def drives_on(known: Reference, random, moved) -> Refit:
    """Base fit to drives whose vehicle is another one by `moved` (P,), held by the spread of days."""
    slopes = 300.0 * random.standard_normal((3, 40, len(NAMES)))
    day = moved + SPREAD * random.standard_normal(len(NAMES))
    seen = slopes @ day + random.standard_normal((3, 40))
    flat, precision = slopes.reshape(-1, len(NAMES)), np.linalg.inv(known.spread)
    found = np.linalg.solve(flat.T @ flat + precision, flat.T @ seen.ravel())
    return Refit((), known.u + found, np.zeros(0), 0.0, seen - slopes @ found, slopes, np.zeros(0))


def test_a_day_on_the_same_floor_is_seldom_another_floor():
    random = np.random.default_rng(0)
    known = reference(random)
    named = [floor_change(known, drives_on(known, random, np.zeros(4)), 0.0, ALPHA).named for _ in range(400)]
    assert np.mean(named) < 4 * ALPHA


def test_what_a_floor_changes_together_is_one_change_with_its_values():
    random = np.random.default_rng(1)
    known = reference(random)
    moved = np.array([0.0, -0.12, 0.1, 0.0])
    found = floor_change(known, drives_on(known, random, moved), 0.0, ALPHA)
    assert found.named and {one.parameter for one in found.members} == set(NAMES[1:3])
    one = next(one for one in found.members if one.parameter == NAMES[1])
    assert one.before == pytest.approx(0.8) and one.after == pytest.approx(0.8 - 0.12 * 0.8, abs=0.03)
    assert "another floor" in found.said() and found.report()["name"] == "floor"


def test_what_no_floor_changes_is_no_other_floor():
    random = np.random.default_rng(2)
    known = reference(random)
    found = floor_change(known, drives_on(known, random, np.array([0.15, 0.0, 0.0, 0.0])), 0.0, ALPHA)
    assert not found.named and found.said() == ""


def test_a_run_is_compared_with_blocks_of_another_as_a_mean_of_blocks():
    random = np.random.default_rng(5)
    known = replace(reference(random), blocks=True)
    known = replace(known, leftovers=known.leftovers * (8 * DAYS))  # eight windows in each block
    fit = drives_on(known, random, np.zeros(4))
    away = [floor_change(known, replace(fit, u=fit.u + [0, 0.05, 0, 0]), 0.0, ALPHA, trials).members[0].away
            for trials in (8, 64)]
    assert 1.5 < away[1] / away[0] < 2.3  # (1 + 1/6) over (1/8 + 1/6), and the error of the fit


def test_without_reference_days_or_a_share_that_turns_nothing_shows_a_floor():
    random = np.random.default_rng(3)
    known = reference(random)
    fit = drives_on(known, random, np.zeros(4))
    assert floor_change(replace(known, known=False), fit, 0.0, ALPHA) is None
    chair = replace(known, space=replace(SPACE, names=("a.b", "c.d", *NAMES[2:])))
    assert floor_change(chair, fit, 0.0, ALPHA) is None


def test_blocks_of_one_run_say_how_far_parameters_wander():
    u = SPACE.to_unit(SPACE.initial)
    still = 0.001 * np.random.default_rng(4).standard_normal((BLOCKS, len(NAMES)))
    few, remark = _spread(SPACE, u, still, True, blocks=True)
    usual, _ = _spread(SPACE, u, still, True)
    assert (np.diag(few) < 0.1 * np.diag(usual)).all() and "blocks of one run" in remark
    trials = tuple(Trial(f"run/{i:03d}", "run", Command(np.zeros(1), np.full(1, 0.1 * i), np.zeros(1)), None,
                         PoseStream(np.ones(2), np.zeros(2), np.zeros(2), np.zeros(2)), Start()) for i in range(40))
    days = days_of((Log("run", HUSKY, trials, ""),))
    assert [day.fields[BLOCK] for day in days] == list(range(1, BLOCKS + 1))
