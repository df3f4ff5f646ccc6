"""Drives in pieces side by side, as an accelerator replays them on the way of a search."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE, unicycle_plant

from sysid.errors import bin_objective
from sysid.errors.bin_objective import make_features_objective
from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.replay import differences, one_drive, pieces, rollout
from sysid.replay.differences import CourseReplay, DifferenceReplay
from sysid.search import least_squares
from sysid.search.valleys import from_all
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR


@pytest.fixture
def short_pieces(monkeypatch):
    """Pieces of a second, begun 1.5 s before: six time constants of the vehicle at TRUTH."""
    monkeypatch.setattr(pieces, "LENGTH", 1.0)
    monkeypatch.setattr(pieces, "OVERLAP", 1.5)


@pytest.fixture
def objective(unicycle_log) -> Objective:
    trials = unicycle_log.training
    replay = CourseReplay(unicycle_plant(), trials, lambda values: values)
    return Objective(DifferenceReplay(replay, UNICYCLE_SPACE), UNICYCLE_SPACE, trials, replay.measured,
                     estimate_noise(trials))


def test_a_drive_in_pieces_is_the_whole_drive(objective, short_pieces):
    whole = objective.replay.replay
    cut = whole.in_pieces
    assert cut.drives >= 4 * whole.drives
    sets = np.stack([TRUTH, TRUTH * 1.1])
    expected, found = (one(jnp.asarray(sets)) for one in (whole.traced, cut.traced))
    travelled = np.abs(np.asarray(expected.pose)[..., :2]).max()
    assert np.abs(found.pose - expected.pose).max() < 0.01 * travelled
    assert np.abs(found.odometry - expected.odometry).max() < 0.01 * max(travelled, 1.0)
    np.testing.assert_allclose(found.pose[:, :, 0], expected.pose[:, :, 0], atol=1e-5)  # they begin where it does


def test_what_is_fetched_is_of_whole_drives(objective, short_pieces):
    whole = objective.replay
    np.testing.assert_array_equal(whole.in_pieces.simulate(TRUTH[None]).pose, whole.simulate(TRUTH[None]).pose)


def test_a_drive_of_which_a_piece_diverges_has_diverged(short_pieces):
    plant = unicycle_plant()
    quick = dataclasses.replace(plant, observe=lambda state: plant.observe(state).at[8].set(state[3] > 0.5))
    records = round(5.0 / plant.dt)
    command = jnp.zeros((records, 1, 2)).at[: records // 2, :, 0].set(1.0)  # at rest again in the end
    for speeds, expected in ((None, 0.0), (jnp.zeros((5, 2)), 1.0)):
        path = one_drive.path_of(quick, TRUTH, one_drive.Commanded(command, jnp.zeros(5), speeds=speeds))
        assert path[:, 8].max() == 1.0 and path[-1, 8] == expected


@pytest.mark.parametrize("why", ["short", "tied to the room"])
def test_some_drives_stay_whole(unicycle_log, why):
    anywhere = why == "short"  # drives of 5 s are not cut by default
    replay = CourseReplay(unicycle_plant(), unicycle_log.training, lambda values: values, anywhere=anywhere)
    assert replay.in_pieces is replay
    assert DifferenceReplay(replay, UNICYCLE_SPACE).in_pieces.replay is replay


def test_pieces_begin_at_the_speeds_that_were_measured(unicycle_log):
    trial = unicycle_log.training[0]
    times = np.array([-1.0, 1.5, 2.5])
    speeds = differences.speeds_at(trial, times)
    assert not speeds[0].any()
    for time, found in zip(times[1:], speeds[1:], strict=True):
        near = np.abs(trial.odometry.t - time) < 0.15
        assert trial.odometry.v[near].min() <= found[0] <= trial.odometry.v[near].max()
    unseen = differences.speeds_at(dataclasses.replace(trial, odometry=None), times)
    held = np.searchsorted(trial.command.t, times[1:], side="right") - 1
    np.testing.assert_allclose(unseen[1:, 0], trial.command.v[held])


def test_a_search_in_pieces_ends_on_whole_drives(objective, short_pieces, monkeypatch):
    bins = make_features_objective(objective, 0.5)
    points = least_squares.random_starts(UNICYCLE_SPACE, 3, seed=1)
    expected = from_all(bins, points, 20)
    assert bins.quicker is bins  # on a processor
    monkeypatch.setattr(bin_objective, "on_processor", lambda: False)
    other = make_features_objective(objective, 0.5)
    assert other.quicker is not other and other.quicker.replay is objective.replay.in_pieces
    found = from_all(other, points, 20)
    assert found.cost == pytest.approx(expected.cost, rel=1e-3)
    np.testing.assert_allclose(UNICYCLE_SPACE.to_values(found.u), TRUTH, rtol=0.1)
    assert found.evaluations > expected.evaluations / 2


def test_a_vehicle_is_recorded_the_same_on_an_accelerator(monkeypatch):
    plant = rollout.vehicle_plant(WHILL_CR, VehicleConfig(physics_dt=0.005))
    params = preset_params(WHILL_CR, "physical")
    command = jnp.asarray(np.cumsum(np.random.default_rng(0).normal(0, 0.05, (60, 2, 2)), axis=0), jnp.float32)
    expected = jax.jit(lambda c: one_drive.path_of(plant, params, one_drive.Commanded(c, jnp.zeros(5))))(command)
    monkeypatch.setattr(one_drive, "on_processor", lambda: False)
    found = jax.jit(lambda c: one_drive.path_of(plant, params, one_drive.Commanded(c, jnp.zeros(5))))(command)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5)
