"""Starts in features, and replicates that are driven once."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE, unicycle_plant

from sysid.errors.bin_objective import FeatureObjective, make_features_objective
from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.replay.cores import Compiled
from sysid.replay.differences import CourseReplay, DifferenceReplay, make_courses
from sysid.replay.models import with_effects
from sysid.replay.rollout import BEYOND, PathReplay, Replay, _Programs, make_batch
from sysid.search import least_squares, starts
from whill_mjx.effects import make_effect
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.vehicle.types import VehicleParams

U_TRUTH = UNICYCLE_SPACE.to_unit(TRUTH)


@pytest.fixture(scope="module")
def poses(unicycle_log) -> Objective:
    trials = unicycle_log.training
    replay = CourseReplay(unicycle_plant(), trials, lambda values: values)
    return Objective(DifferenceReplay(replay, UNICYCLE_SPACE), UNICYCLE_SPACE, trials, replay.measured,
                     estimate_noise(trials))


@pytest.fixture(scope="module")
def features(poses) -> FeatureObjective:
    return make_features_objective(poses, WHILL_CR.track)


@pytest.mark.parametrize("anywhere", [True, False])
def test_courses_replay_every_trial_as_driving_each_by_itself_does(unicycle_log, anywhere):
    trials, plant = unicycle_log.training, unicycle_plant()
    courses = CourseReplay(plant, trials, lambda values: values, anywhere)
    assert courses.courses == (len({trial.manoeuvre for trial in trials}) if anywhere else len(trials))
    batch, measured = make_batch(trials, plant.dt)
    alone = Replay(plant, batch, lambda values: values)
    values = np.array([TRUTH, [0.1, 0.3, 1.2], [0.5, 0.5, 0.8]])
    one, other = courses.simulate(values), alone.simulate(values)
    np.testing.assert_allclose(one.pose * measured.pose_mask, other.pose * measured.pose_mask, atol=3e-4)
    np.testing.assert_allclose(one.odometry * measured.odometry_mask, other.odometry * measured.odometry_mask,
                               atol=3e-4)


def test_an_effect_that_is_tied_to_the_room_makes_each_trial_a_course(unicycle_log):
    params = preset_params(WHILL_CR, "physical")
    trials, plant = unicycle_log.training[:4], unicycle_plant()
    free, _ = make_courses(plant, trials, lambda values: values, params)
    sloping = VehicleParams(params.body, (*params.effects, make_effect("slope")))
    tied, _ = make_courses(plant, trials, lambda values: values, sloping)
    assert free.courses == 2 and tied.courses == 4


def test_the_jacobian_of_features_is_that_of_their_residual(features):
    u = np.array([[0.4, 0.5, 0.6], [0.6, 0.4, 0.3]])
    residual, jacobian = features.jacobian(u)
    np.testing.assert_allclose(residual, features.residuals(u), atol=1e-4)
    for parameter in range(3):
        step = np.eye(3)[parameter] * 1e-2
        slope = (features.residuals(u + step) - features.residuals(u - step)) / 2e-2
        assert np.linalg.norm(slope - jacobian[..., parameter]) < 0.02 * np.linalg.norm(slope)


def test_random_starts_in_features_agree_and_lie_where_the_poses_fit_best(poses):
    points = least_squares.random_starts(poses.space, 6, seed=2)
    found = starts.fit(poses, points, WHILL_CR.track, iterations=20)
    assert starts.agreeing(found.start_costs) == 6
    np.testing.assert_allclose(poses.space.to_values(found.u), TRUTH, rtol=0.1)
    polished = least_squares.fit(poses, starts=found.u[None], stop=least_squares.Stopping(8))
    direct = least_squares.fit(poses, stop=least_squares.Stopping(30))
    assert polished.cost <= direct.cost * 1.001


def test_a_drawn_start_is_near_the_truth_and_does_not_depend_on_the_others(poses):
    drawn = starts.draw(poses, [0, 1, 2], WHILL_CR.track, seed=3, scan=16)
    np.testing.assert_array_equal(drawn[0], poses.space.to_unit(poses.space.initial))
    np.testing.assert_allclose(starts.draw(poses, [2], WHILL_CR.track, seed=3, scan=16)[0], drawn[2], atol=1e-3)
    np.testing.assert_allclose(poses.space.to_values(drawn[1:]), [TRUTH, TRUTH], rtol=0.2)


def test_each_end_of_a_search_is_told_with_the_start_it_comes_from(features):
    points = least_squares.random_starts(features.space, 4, seed=2)
    found = least_squares.fit(features, starts=points, stop=least_squares.Stopping(1))
    for end, number in zip(found.starts, found.order, strict=True):
        alone = least_squares.fit(features, starts=points[number][None], stop=least_squares.Stopping(1))
        np.testing.assert_allclose(end, alone.u, atol=1e-5)


def test_a_drive_that_diverges_is_dear_in_features(features):
    class Broken:
        def simulate(self, values):
            simulated = features.replay.simulate(values)
            pose = np.array(simulated.pose)
            pose[:, 0] = np.nan
            return dataclasses.replace(simulated, pose=pose)

    cost = dataclasses.replace(features, replay=Broken()).weighted_cost(U_TRUTH[None])
    assert np.isfinite(cost).all() and cost[0] > 1e3 * features.weighted_cost(U_TRUTH[None])[0]


@pytest.mark.quick
def test_costs_agree_within_a_share_of_the_best():
    assert starts.agreeing(np.array([1.0, 1.01, 1.019, 1.2, np.inf])) == 3


@pytest.mark.quick
def test_effects_are_added_where_they_do_nothing():
    params = preset_params(WHILL_CR, "physical")
    more = with_effects(params, ("lateral_damping", "jerk_limit", "yaw_scrub"))
    assert sorted(set(describe(more)) - set(describe(params))) == [
        "jerk_limit.angular", "jerk_limit.linear", "lateral_damping.c_front", "lateral_damping.c_rear"]
    values = dict(zip(describe(more), np.asarray(get_values(more, list(describe(more)))), strict=True))
    assert values["lateral_damping.c_front"] == 0.0 and np.isfinite(values["jerk_limit.linear"])
    with pytest.raises(ValueError, match="no effect 'anti_gravity'"):
        with_effects(params, ("anti_gravity",))


def test_drives_of_any_length_share_the_program_of_the_physics(unicycle_log):
    plain, traced = unicycle_plant(), []

    def substep(params, state, command):
        traced.append(command.shape)
        return plain.substep(params, state, command)

    plant = dataclasses.replace(plain, substep=substep, substeps=None)
    batch, _ = make_batch(unicycle_log.training[:1], plant.dt)
    paths, values, first = PathReplay(plant, lambda values: values, 8), np.array([TRUTH]), np.array([0])
    whole = paths(values, batch, first)
    count = len(traced)
    part = paths(values, dataclasses.replace(batch, command=batch.command[:, :40]), first)
    assert len(traced) == count
    np.testing.assert_allclose(part, whole[:, :41], atol=1e-6)


def test_short_drives_are_replayed_together_and_no_further_than_they_are_measured(unicycle_log, monkeypatch):
    whole = unicycle_log.training
    trials = tuple(ended(trial, 1.0) if number % 2 else trial for number, trial in enumerate(whole))
    plant, asked = unicycle_plant(), []
    courses = CourseReplay(plant, trials, lambda values: values)
    courses.paths.rows = 4
    build = _Programs.__call__
    monkeypatch.setattr(_Programs, "__call__", lambda one, *given: asked.append(given[-1].max()) or build(one, *given))
    values = np.stack([TRUTH, 1.1 * TRUTH])
    found = courses.simulate(values)
    short = round((1.0 + BEYOND) / plant.dt) + 1  # records
    assert min(asked) == short and max(asked) > 2 * short
    monkeypatch.setattr(PathReplay, "__call__", lambda one, values, batch, rows, records: one._on_cores(
        values, batch, rows, None))
    for mine, full in zip(jax.tree.leaves(found), jax.tree.leaves(courses.simulate(values)), strict=True):
        np.testing.assert_array_equal(mine, full)


def ended(trial, end):
    """The trial as if nothing had been recorded after `end` [s]."""
    def kept(stream):
        there = stream.t <= end
        return dataclasses.replace(stream, **{name: table[there] for name, table in vars(stream).items()})

    return dataclasses.replace(trial, command=kept(trial.command), odometry=kept(trial.odometry),
                               ground_truth=kept(trial.ground_truth))


def test_what_is_compiled_ahead_is_not_compiled_again(unicycle_log, monkeypatch):
    trials, plant = unicycle_log.training, unicycle_plant()
    courses = CourseReplay(plant, trials, lambda values: values)
    begun: list[str] = []
    build = Compiled._compile
    monkeypatch.setattr(Compiled, "_compile", lambda one, *given: begun.append("") or build(one, *given))
    courses.compile(len(TRUTH), trials)
    courses.simulate(TRUTH[None])
    assert len(begun) == 3  # the begin of a drive, its steps, and what sensors make of it
    batch, _ = make_batch(trials, plant.dt)
    shorter = dataclasses.replace(batch, command=batch.command[:, :40])
    courses.paths.compile(len(TRUTH), shorter)
    courses.paths(TRUTH[None], shorter, np.array([0]))
    assert len(begun) == 5  # the steps are those of any length


def test_a_function_is_compiled_once_for_each_shape_and_each_static_argument():
    traced = []

    def scaled(x, factor):
        traced.append((x.shape, factor))
        return factor * x

    function = Compiled(scaled, static=1)
    for size, factor in ((3, 2), (3, 2), (4, 2), (3, 5)):
        np.testing.assert_array_equal(function(np.ones(size, np.float32), factor), factor * np.ones(size))
    assert sorted(traced) == [((3,), 2), ((3,), 5), ((4,), 2)]
    assert function.shapes(np.ones(3, np.float32), 2).shape == (3,)


def test_what_fails_while_it_is_compiled_fails_where_it_is_needed():
    def refused(x):
        raise ValueError("no such thing")

    function = Compiled(refused)
    program = function.compile(np.ones(2))
    with pytest.raises(ValueError, match="no such thing"):
        function(np.ones(2))
    assert isinstance(program.exception(), ValueError)


def test_what_failed_to_compile_once_is_tried_again():
    tries = []

    def scarce(x):
        tries.append(x.shape)
        if len(tries) == 1:
            raise MemoryError
        return 2 * x

    function = Compiled(scarce)
    with pytest.raises(MemoryError):
        function(np.ones(2))
    np.testing.assert_array_equal(function(np.ones(2)), 2 * np.ones(2))
