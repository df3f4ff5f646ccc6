"""Profile likelihoods: parabolas where they must be, open ends where the data say nothing."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE

from sysid.intervals import uncertainty
from sysid.intervals.profiles import Profile, crossings, profile
from sysid.pages.fit_page import profiles as profiles_section
from sysid.search import least_squares
from sysid.search.fitting import fit_log
from sysid.search.settings import FitConfig


@pytest.fixture(scope="module")
def fitted(objective):
    result = least_squares.fit(objective, stop=least_squares.Stopping(15))
    return result.u, uncertainty.estimate(objective, result.u)


@pytest.fixture(scope="module")
def traced(objective, fitted):
    return profile(objective, fitted[1], objective.space.names, points=7)


def test_a_profile_of_well_known_parameters_is_the_interval_from_curvature(traced, fitted, objective):
    u, known = fitted
    for one, estimate, truth in zip(traced, known.estimates, TRUTH, strict=True):
        low, high = one.interval
        width = estimate.high - estimate.low
        assert low == pytest.approx(estimate.low, abs=0.1 * width)
        assert high == pytest.approx(estimate.high, abs=0.1 * width)
        assert low - width < truth < high + width
        assert one.statistic.min() == 0 and one.remark(objective.space) == ""
        assert (np.diff(one.values) > 0).all()


def test_the_other_parameters_follow(traced, fitted, objective):
    """At the ends of the grid the cost is that of a search with the parameter held there."""
    u, _ = fitted
    one = traced[1]
    held = one.others[0]
    start = objective.space.to_unit(np.array([TRUTH[0], held[1], TRUTH[2]]))
    alone = least_squares.fit(objective, starts=start[None], frozen=("tau_omega",), stop=least_squares.Stopping(20))
    assert one.cost[0] == pytest.approx(alone.cost, rel=1e-3)
    unmoved = objective.space.to_values(u)
    unmoved[1] = held[1]
    assert one.cost[0] <= objective.weighted_cost(objective.space.to_unit(unmoved)[None])[0]


def test_a_parameter_that_the_log_does_not_tell_has_an_open_profile(objective, fitted):
    """A fourth parameter that does nothing."""
    class Blind:
        def simulate(self, values):
            return objective.replay.simulate(values[:, :3])

        def jacobian(self, values):
            value, slope = objective.replay.jacobian(values[:, :3])
            pad = [np.concatenate([leaf, np.zeros_like(leaf[..., :1])], axis=-1)
                   for leaf in (slope.pose, slope.odometry)]
            return value, dataclasses.replace(slope, pose=pad[0], odometry=pad[1])

    space = dataclasses.replace(UNICYCLE_SPACE, names=(*UNICYCLE_SPACE.names, "nothing"),
                                **{key: np.append(getattr(UNICYCLE_SPACE, key), value) for key, value in
                                   (("low", 1.0), ("high", 3.0), ("initial", 2.0), ("log", False))})
    blind = dataclasses.replace(objective, replay=Blind(), space=space)
    u = np.append(fitted[0], 0.5)
    (one,) = profile(blind, uncertainty.estimate(blind, u), ["nothing"], points=3)
    assert one.interval == (None, None) and (one.values[0], one.values[-1]) == (1.0, 3.0)
    assert one.remark(space) == "open below: even its bound is allowed, open above: even its bound is allowed"


@pytest.mark.quick
def test_a_better_point_than_the_fit_is_told(objective):
    one = Profile("tau_v", np.array([0.1, 0.2, 0.3]), np.ones(3), np.array([0.0, 1.0, 9.0]), 3.0, (None, 0.25),
                  np.zeros((3, 3)), 0.2)
    assert one.remark(objective.space) == "better at 0.1 than where the fit ended, open below"


@pytest.mark.quick
def test_crossings_of_a_parabola_are_exact_and_open_where_there_is_none():
    values = np.linspace(-2.0, 1.0, 7)
    low, high = crossings(values, 4 * values**2, 2.56)
    assert low == pytest.approx(-0.8) and high == pytest.approx(0.8)
    assert crossings(values, values**2, 2.0) == (pytest.approx(-np.sqrt(2)), None)


@pytest.mark.quick
def test_the_report_draws_a_profile_and_says_what_is_open():
    report = {"parameters": [{"name": "lag", "value": 0.2, "interval": [0.1, 0.3], "identifiable": True,
                              "confidence": 0.9}],
              "profiles": [{"name": "lag", "unit": "s", "values": [0.05, 0.1, 0.2, 0.3], "threshold": 2.7,
                            "statistic": [4.0, 2.0, 0.0, 1.0], "interval": [0.08, None], "remark": "open above"}]}
    text = profiles_section(json.loads(json.dumps(report)))
    assert text.count("<svg") == 1 and "open above" in text and "profile, 90% from" in text and "nan" not in text


@pytest.mark.quick
def test_a_profile_of_what_is_not_fitted_is_refused_before_the_search(unicycle_log):
    with pytest.raises(ValueError, match="profile of 'pid_drive.gain': it is not among the fitted"):
        fit_log(unicycle_log, FitConfig(preset="paper", parameters=("pid_drive.kp",), profile=("pid_drive.gain",)))
    with pytest.raises(ValueError, match="--profile with --method tpe"):
        fit_log(unicycle_log, FitConfig(preset="paper", method="tpe", profile=("all",)))
