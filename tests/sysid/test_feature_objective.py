"""Whitened motion in bins: what is counted, and what the noise that a fit leaves makes of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE, unicycle_plant

from sysid.errors.bin_objective import FeatureObjective, make_features_objective
from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.errors.prior import Prior, bounds_alone
from sysid.replay.differences import CourseReplay, DifferenceReplay
from sysid.search import least_squares
from sysid.search.fitting import choose
from sysid.search.settings import FitConfig

U_TRUTH = UNICYCLE_SPACE.to_unit(TRUTH)


@pytest.fixture(scope="module")
def poses(unicycle_log) -> Objective:
    trials = unicycle_log.training
    replay = CourseReplay(unicycle_plant(), trials, lambda values: values)
    return Objective(DifferenceReplay(replay, UNICYCLE_SPACE), UNICYCLE_SPACE, trials, replay.measured,
                     estimate_noise(trials))


@pytest.fixture(scope="module")
def features(poses):
    return make_features_objective(poses, 0.5)


def test_whole_drives_are_fitted_where_their_errors_do_not_add_up(poses):
    poses = dataclasses.replace(poses, prior=bounds_alone(UNICYCLE_SPACE))
    told = choose(poses, U_TRUTH, 0.5, FitConfig())
    assert isinstance(told, Objective) and told.prior.share < 2.0
    random, measured = np.random.default_rng(0), poses.measured
    pushed = measured.pose + np.cumsum(0.01 * random.standard_normal(measured.pose.shape), axis=1)
    adding = dataclasses.replace(poses, measured=dataclasses.replace(measured, pose=pushed))
    bins = choose(adding, U_TRUTH, 0.5, FitConfig())
    assert isinstance(bins, FeatureObjective)
    told = choose(adding, U_TRUTH, 0.5, FitConfig(method="lm"))
    assert isinstance(told, Objective)
    assert told.prior.share > 3.0 and told.prior.share > 2 * bins.prior.share  # poses count more often than they tell


def test_at_the_truth_the_noise_that_is_left_has_unit_size(features):
    fine = features.renewed(U_TRUTH)
    white, shown = fine.residuals(U_TRUTH[None])[0], features.mask.reshape(len(features.mask), -1) > 0
    assert np.square(white[shown]).mean() == pytest.approx(1.0, abs=0.15)
    assert fine.weighted_cost(U_TRUTH[None] + 0.1)[0] > 1.5


def test_a_pose_that_comes_too_seldom_is_not_told_by_bins(features):
    assert features.enough
    blind = features.mask.copy()
    blind[:, ::2, 2:5] = 0.0
    less = dataclasses.replace(features.features, mask=blind)
    assert not dataclasses.replace(features, features=less).enough


def test_a_prior_pulls_a_fit_of_features_as_far_as_it_is_sure(features):
    fine = features.renewed(U_TRUTH)
    free = least_squares.fit(fine, stop=least_squares.Stopping(8)).u
    away = np.clip(free + 0.1, 0.0, 1.0)
    for sd, expected in ((1e-5, away), (10.0, free)):
        held = dataclasses.replace(fine, prior=Prior(away, np.full(3, sd)))
        np.testing.assert_allclose(least_squares.fit(held, stop=least_squares.Stopping(12)).u, expected, atol=5e-3)


def test_replays_of_many_sets_at_once_are_those_of_a_few(features):
    u = np.random.default_rng(0).uniform(0.3, 0.7, (70, 3))
    many = features.residuals(u)
    np.testing.assert_allclose(many[:3], features.residuals(u[:3]), atol=1e-3)
    np.testing.assert_allclose(many[-2:], features.residuals(u[-2:]), atol=1e-3)
