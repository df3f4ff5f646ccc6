"""Costs, gradients and Hessians that are summed where the replay runs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE, unicycle_plant

from sysid.errors import bin_objective, normal_equations, pose_objective
from sysid.errors.bin_objective import make_features_objective
from sysid.errors.noise import fit_whitener
from sysid.errors.normal_equations import NormalEquations, make_equations
from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.errors.prior import Prior
from sysid.errors.space import huber_weight, robust_cost
from sysid.replay.differences import CourseReplay, DifferenceReplay
from sysid.search import least_squares, starts

SETS = np.array([[0.4, 0.5, 0.6], [0.6, 0.4, 0.3], [1.0, 0.45, 0.5]])
"""One of them at a bound, where differences are one-sided."""


@pytest.fixture(scope="module")
def poses(unicycle_log) -> Objective:
    trials = unicycle_log.training
    replay = CourseReplay(unicycle_plant(), trials, lambda values: values)
    differences = DifferenceReplay(replay, UNICYCLE_SPACE)
    return Objective(differences, UNICYCLE_SPACE, trials, replay.measured, estimate_noise(trials))


@pytest.fixture
def on_accelerator(monkeypatch):
    """Objectives take a processor for one, and fill calls up to two sets."""
    monkeypatch.setattr(normal_equations, "on_processor", lambda: False)
    for module in (pose_objective, bin_objective):
        monkeypatch.setattr(module, "make_equations", lambda one: (
            NormalEquations(one, at_once=2) if hasattr(one.replay, "traced") else None))


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("kind", ["poses", "features", "with a prior"])
def test_sums_are_those_of_the_residuals_and_their_derivatives(poses, kind, robust):
    one = {"poses": poses, "features": make_features_objective(poses, 0.5),
           "with a prior": dataclasses.replace(poses, prior=Prior(np.full(3, 0.5), np.full(3, 0.01)))}[kind]
    equations = NormalEquations(one, at_once=1)
    value, slope, hessian = equations.quadratic(SETS, robust)
    np.testing.assert_allclose(value, equations.costs(SETS, robust), rtol=1e-4)
    residual, jacobian = one.jacobian(SETS)
    weight = huber_weight(residual) if robust else np.ones_like(residual)
    np.testing.assert_allclose(value, robust_cost(residual, robust), rtol=1e-3)
    for parameter in range(3):
        step = np.eye(3)[parameter] * 0.01
        fallen = (equations.costs(SETS + step, robust) - equations.costs(SETS - step, robust)) / 0.04
        inside = slice(0, 2)  # not the set at a bound
        np.testing.assert_allclose(slope[inside, parameter], fallen[inside], atol=0.1 * np.abs(slope[inside]).max())
    if kind == "features" or not robust:  # weights within the search for start poses are not differenced on the host
        near = 0.05 if kind == "features" else 0.12
        expected = np.einsum("nbkp,nbkq->npq", jacobian, jacobian * weight[..., None])
        np.testing.assert_allclose(hessian, expected, atol=near * np.abs(expected).max())


def test_a_search_with_sums_ends_where_one_with_residuals_does(poses, on_accelerator):
    points = least_squares.random_starts(poses.space, 4, seed=2)
    host = least_squares.fit(dataclasses.replace(poses, replay=Hidden(poses.replay)), starts=points,
                             stop=least_squares.Stopping(25), robust=True)
    there = least_squares.fit(dataclasses.replace(poses), starts=points, stop=least_squares.Stopping(25), robust=True)
    assert there.cost == pytest.approx(host.cost, rel=2e-3)
    np.testing.assert_allclose(poses.space.to_values(there.u), TRUTH, rtol=0.1)
    assert there.initial_cost == pytest.approx(host.initial_cost, rel=1e-3)
    assert np.isfinite(there.start_costs).all() and (np.diff(there.history) <= 1e-9).all()


def test_starts_are_drawn_and_fitted_in_features_alike(poses, on_accelerator):
    points = starts.draw(dataclasses.replace(poses), range(3), 0.5, seed=0, scan=16)
    assert points.shape == (3, 3)
    found = starts.fit(dataclasses.replace(poses), points, 0.5, iterations=10)
    np.testing.assert_allclose(poses.space.to_values(found.u), TRUTH, rtol=0.15)


def test_a_replay_that_diverges_is_dear_and_has_no_slope(poses):
    replay = poses.replay.replay
    broken = DifferenceReplay(Diverging(replay), UNICYCLE_SPACE)
    one = dataclasses.replace(poses, replay=broken)
    value, slope, hessian = NormalEquations(one, at_once=1).quadratic(SETS[:1])
    assert np.isfinite(value).all() and value[0] > 1e3 * robust_cost(poses.residuals(SETS[:1]), False)[0]
    assert not slope.any() and not hessian.any()


def test_a_processor_has_its_residuals_at_hand(poses):
    assert poses.equations is None and make_equations(poses) is None


def test_calls_are_of_one_size(poses):
    equations = NormalEquations(dataclasses.replace(poses, replay=dataclasses.replace(poses.replay)), at_once=2)
    three = equations.costs(SETS)
    np.testing.assert_allclose(equations.costs(SETS[1:2]), three[1:2], rtol=1e-5)
    np.testing.assert_allclose(NormalEquations(poses, at_once=3).costs(SETS), three, rtol=1e-5)


def test_few_starts_that_go_on_do_not_wait_for_many(poses, monkeypatch):
    monkeypatch.setattr(normal_equations, "FEW", 2)
    equations = NormalEquations(dataclasses.replace(poses, replay=dataclasses.replace(poses.replay)), at_once=21)
    used = []
    compiled = equations.sums["quadratic"]
    monkeypatch.setitem(equations.sums, "quadratic", lambda u, *more: (used.append(len(u)), compiled(u, *more))[1])
    many = equations.quadratic(SETS)
    few = equations.quadratic(SETS[:2])
    assert used == [21, 2]
    for one, other in zip(few, many, strict=True):
        np.testing.assert_allclose(one, other[:2], rtol=1e-4, atol=1e-4 * np.abs(other).max())


def test_long_drives_are_replayed_fewer_at_a_time(poses, monkeypatch):
    monkeypatch.setattr(normal_equations, "on_processor", lambda: False)
    courses = poses.replay.replay
    for states, expected in ((10 * courses.states, 10), (1, 1), (10**9, normal_equations.DRIVES // courses.drives)):
        monkeypatch.setattr(normal_equations, "STATES", states)
        monkeypatch.setattr(normal_equations.Compiled, "compile", lambda *_: None)
        assert make_equations(poses).sizes["cost"] == (expected,)


def test_other_noise_is_weighed_without_compiling_again(poses):
    poses = dataclasses.replace(poses, replay=dataclasses.replace(poses.replay))
    first = make_features_objective(poses, 0.5)
    louder = dataclasses.replace(first, whitener=first.whitener.scaled(2.0))
    one, other = NormalEquations(first, at_once=3), NormalEquations(louder, at_once=3)
    np.testing.assert_allclose(one.costs(SETS), 4 * other.costs(SETS), rtol=1e-4)
    assert one.sums is other.sums
    assert [len(each._programs) for each in one.sums.values()] == [1, 1]  # costs and quadratics, of one size each
    longer = dataclasses.replace(first, whitener=fit_whitener(first.target, first.mask))
    NormalEquations(longer, at_once=3).costs(SETS)
    assert [len(each._programs) for each in one.sums.values()] == [1, 1]
    wide = dataclasses.replace(poses, prior=Prior(np.full(3, 0.5), np.full(3, 0.1)))
    narrow = dataclasses.replace(poses, prior=Prior(np.full(3, 0.5), np.full(3, 0.001)))
    assert (NormalEquations(narrow, 3).costs(SETS) > NormalEquations(wide, 3).costs(SETS)).all()


class Hidden:
    """A replay that cannot be traced."""

    def __init__(self, replay):
        self.simulate, self.jacobian = replay.simulate, replay.jacobian


class Diverging:
    """A replay of which every drive diverges."""

    def __init__(self, replay):
        self._replay = replay

    def traced(self, values):
        found = self._replay.traced(values)
        return found.replace(pose=np.nan * found.pose, diverged=1.0 + found.diverged)
