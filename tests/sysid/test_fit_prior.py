"""A vehicle file as what is known before a fit."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE, unicycle_plant

from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.errors.prior import UNKNOWN, Prior, bounds_alone, make_prior, moved
from sysid.errors.space import Space
from sysid.intervals import uncertainty
from sysid.replay.differences import CourseReplay, DifferenceReplay
from sysid.search import fitting, least_squares
from sysid.search.settings import FitConfig
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.vehicle.vehicle_file import load_intervals, save_vehicle

U_TRUTH = UNICYCLE_SPACE.to_unit(TRUTH)


def test_the_jacobian_with_a_prior_is_that_of_the_residual(objective):
    known = dataclasses.replace(objective, prior=Prior(np.array([0.3, 0.4, 0.5]), np.array([0.1, 0.2, 0.05]), 2.0))
    u = np.array([[0.4, 0.5, 0.6], [0.5, 0.5, 0.4]])
    residual, jacobian = known.jacobian(u)
    np.testing.assert_allclose(residual, known.residuals(u), rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(np.square(residual[:, 0, -3:]).sum(-1), [2 * (1 + 0.25 + 4), 2 * (4 + 0.25 + 4)])
    np.testing.assert_array_equal(residual[:, 1:, -3:], 0.0)
    np.testing.assert_allclose(jacobian[1, 0, -3:], np.diag(np.sqrt(2) / known.prior.sd))


def test_a_weak_prior_yields_to_the_log_and_a_sharp_one_holds(objective):
    """The log tells all three: a weak prior at wrong values hardly moves them, a sharp one does."""
    wrong = U_TRUTH + np.array([0.1, 0.0, 0.1])
    weak, sharp = (dataclasses.replace(objective, prior=Prior(wrong, np.full(3, sd))) for sd in (0.2, 1e-5))
    ends = [least_squares.fit(one, starts=U_TRUTH[None] + 0.05,
                              stop=least_squares.Stopping(12)).u for one in (weak, sharp)]
    assert np.abs(ends[0] - U_TRUTH).max() < 0.02
    assert np.abs(ends[1] - wrong).max() < 0.02
    free = uncertainty.estimate(objective, ends[0])
    held = uncertainty.estimate(dataclasses.replace(objective, prior=Prior(ends[0], np.full(3, 3e-5))), ends[0])
    for one, other in zip(held.estimates, free.estimates, strict=True):
        assert one.high - one.low < 0.5 * (other.high - other.low)
    assert uncertainty.inflation(objective, ends[0]) >= 1.0


def test_what_no_drive_tells_stays_in_the_middle_of_its_bounds_and_takes_nothing_along(unicycle_log):
    """`extra` only adds to tau_v: what the log tells is their sum."""
    def with_extra(values):
        return jnp.array([values[0] + 0.1 * values[3], values[1], values[2]])

    trials = unicycle_log.training
    replay = CourseReplay(unicycle_plant(), trials, with_extra)
    space = Space((*UNICYCLE_SPACE.names, "extra"), np.append(UNICYCLE_SPACE.low, 0.0),
                  np.append(UNICYCLE_SPACE.high, 1.0), np.append(UNICYCLE_SPACE.initial, 0.0),
                  np.append(UNICYCLE_SPACE.log, False))
    free = Objective(DifferenceReplay(replay, space), space, trials, replay.measured, estimate_noise(trials))
    held = dataclasses.replace(free, prior=bounds_alone(space))
    found = space.to_values(least_squares.fit(held, stop=least_squares.Stopping(20, 1e-6)).u)
    assert found[3] == pytest.approx(0.5, abs=0.15)
    assert found[0] + 0.1 * found[3] == pytest.approx(TRUTH[0], abs=0.01)
    known = uncertainty.estimate(held, space.to_unit(found)).estimates
    assert not known[3].identifiable
    assert known[0].low < TRUTH[0] - 0.08 and known[0].high > TRUTH[0] - 0.02  # extra may be anything from 0 to 1


@pytest.mark.quick
def test_a_parameter_without_an_interval_is_known_by_its_bounds_only():
    prior = make_prior(UNICYCLE_SPACE, {"tau_v": (0.09, 0.11), "turn": (0.99, 1.01)}, spread=0.05)
    assert prior.sd[1] == UNKNOWN and prior.sd[0] < 0.05
    # 5 % of 1.0 on a range of 1.0, and 0.01 / 1.645 from the interval
    assert prior.sd[2] == pytest.approx(np.hypot(0.05, 0.01 / 1.645), rel=1e-3)
    rows = moved(prior, UNICYCLE_SPACE, prior.mean + np.array([0.0, 0.2, 0.2]))
    assert [row["within"] for row in rows] == [True, True, False]


@pytest.mark.quick
def test_a_vehicle_file_of_another_vehicle_is_an_error(tmp_path):
    params = preset_params(WHILL_CR, "physical")
    path = tmp_path / "vehicle.toml"
    save_vehicle(path, WHILL_CR, params, {"torque_drive.kp": (8.0, 9.0)}, {})
    assert load_intervals(path) == {"torque_drive.kp": (8.0, 9.0)}
    other = SimpleNamespace(spec=dataclasses.replace(WHILL_CR, track=0.6), name="there")
    with pytest.raises(ValueError, match="track is .* but 0.6 in 'there'"):
        fitting.of_earlier(other, FitConfig(vehicle=path))
