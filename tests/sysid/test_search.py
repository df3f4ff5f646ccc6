"""Replay, residual, both searches and the intervals, on a small kinematic vehicle with planted parameters."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import TRUTH, UNICYCLE_SPACE, unicycle_objective, unicycle_plant, without_start_noise

from sysid.errors.pose_objective import Noise
from sysid.errors.space import Space
from sysid.intervals import uncertainty
from sysid.replay.rollout import Replay, make_batch, predictions
from sysid.search import least_squares, studies
from sysid.search.result import Stages
from sysid.search.settings import FitConfig
from sysid.search.valleys import gradient_search

U_TRUTH = UNICYCLE_SPACE.to_unit(TRUTH)


def unit_space(*names):
    """Parameters between 0 and 1."""
    size = len(names)
    return Space(names, np.zeros(size), np.ones(size), np.full(size, 0.5), np.zeros(size, bool))


@dataclasses.dataclass(frozen=True)
class TwoValleys:
    """Cost 1 at (0.5, 0.5), where no derivative leads away, and 0.04 at (1, 1), behind a ridge."""

    steep: float
    """How much it costs that the first parameter stays behind the second."""
    counted, space = 1, unit_space("a", "b")

    def renewed(self, u):
        return self

    def residuals(self, u):
        behind, x = self.steep * (u[:, 0] - u[:, 1]), u[:, 1]
        valley = 1.0 + 0.25 * np.sin(2 * np.pi * (x - 0.5)) ** 2 - 3.2 * np.maximum(x - 0.75, 0.0)
        return np.stack([behind, valley], axis=-1)[:, None]

    def jacobian(self, u):
        sides = [self.residuals(u + sign * 1e-4 * one) for one in np.eye(2) for sign in (1, -1)]
        return self.residuals(u), np.stack([(sides[0] - sides[1]), (sides[2] - sides[3])], axis=-1) / 2e-4


@pytest.mark.quick
@pytest.mark.parametrize(("dear", "cost"), [(10.0, 0.04), (0.01, 1.0)])
def test_a_search_goes_on_from_far_along_a_range_where_that_costs_little(dear, cost, monkeypatch):
    valleys, start = TwoValleys(4.0), np.full((1, 2), 0.5)
    stuck = least_squares.fit(valleys, starts=start, stop=least_squares.Stopping(20))
    assert stuck.cost == pytest.approx(1.0, abs=1e-3)
    monkeypatch.setattr("sysid.search.valleys.DEAR", dear)
    monkeypatch.setattr("sysid.search.slopes.ROUNDS", 0)  # nor from close by
    result, _, _ = gradient_search(valleys, start, 20, FitConfig(), None)
    assert result.cost == pytest.approx(cost, abs=1e-3)
    assert (result.evaluations > stuck.evaluations) == (cost < 1.0)
    np.testing.assert_array_equal(result.starts, stuck.starts)  # the report tells where the given starts ended
    same, _, _ = gradient_search(valleys, start, 20, FitConfig(elsewhere=False), None)
    assert same.cost == stuck.cost


class NeverMet:
    """A gain and the limit of what it drives: while the limit is above all that is driven nothing tells of it."""

    counted, space = 1, unit_space("gain", "limit")

    def renewed(self, u):
        return self

    t = np.linspace(0.0, 1.0, 12)

    def _driven(self, u):
        return np.minimum(u[:, :1] * self.t, u[:, 1:])

    def residuals(self, u):
        return (10 * (self._driven(u) - self._driven(np.array([[0.9, 0.37]]))))[:, None]

    def jacobian(self, u):
        sides = [self.residuals(u + sign * 1e-4 * one) for one in np.eye(2) for sign in (1, -1)]
        return self.residuals(u), np.stack([sides[0] - sides[1], sides[2] - sides[3]], axis=-1) / 2e-4


@pytest.mark.quick
def test_a_limit_that_is_never_met_is_looked_for_inside_its_range():
    start = np.array([[0.5, 1.0]])
    stuck = least_squares.fit(NeverMet(), starts=start, stop=least_squares.Stopping(20))
    assert stuck.u[1] == 1.0 and stuck.cost > 1.0
    costs, points = least_squares.far_points(NeverMet(), stuck.u)
    assert points[0, 1] < 0.6 and len(costs) == 3  # the limit behind level ground, a smaller gain and a larger one
    result, _, _ = gradient_search(NeverMet(), start, 20, FitConfig(), None)
    np.testing.assert_allclose(result.u, [0.9, 0.37], atol=1e-3)


class Folded:
    """A steep valley b = a^2 with a fold every 0.02 along its floor, which is lowest, at cost 1, in five points
    from a = 0.385 to 0.415."""

    counted, space = 1, unit_space("a", "b")

    def renewed(self, u):
        return self

    def residuals(self, u):
        a, b = u[:, 0], u[:, 1]
        floor = 2 * (a - 0.4) + 0.03 * np.sin(100 * np.pi * a)
        return np.stack([np.ones_like(a), 50 * (b - a**2), floor], axis=-1)[:, None]

    def jacobian(self, u):
        sides = [self.residuals(u + sign * 1e-4 * one) for one in np.eye(2) for sign in (1, -1)]
        return self.residuals(u), np.stack([sides[0] - sides[1], sides[2] - sides[3]], axis=-1) / 2e-4


@pytest.mark.quick
def test_averaged_slopes_lead_over_the_folds_of_a_valleys_floor_to_where_it_is_lowest(monkeypatch):
    def ends():
        starts = np.array([[0.9, 0.9], [0.8, 0.2]])
        return [gradient_search(Folded(), start[None], 40, FitConfig(), None)[0] for start in starts]

    found, again = ends(), ends()
    assert [one.cost for one in found] == pytest.approx([1.0, 1.0], abs=1e-5)  # no fold beside it costs as little
    assert [one.u[0] for one in found] == pytest.approx([0.4, 0.4], abs=0.0155)
    np.testing.assert_array_equal(found[0].u, again[0].u)  # the same seed, the same points
    monkeypatch.setattr("sysid.search.slopes.ROUNDS", 0)
    stuck = ends()
    assert min(one.cost for one in stuck) > 1.1 and abs(stuck[0].u[0] - stuck[1].u[0]) > 0.1


class Hidden(Folded):
    """A third parameter c is better at 1 than at 0 and 0.5, where a search finds it, but only the floor shows that."""

    space = unit_space("a", "b", "c")

    def residuals(self, u):
        a, c = u[:, 0], u[:, 2]
        valley = 1.0 + 0.25 * np.sin(2 * np.pi * (c - 0.5)) ** 2 - 3.2 * np.maximum(c - 0.75, 0.0)
        hidden = 100 * (a - 0.4) * np.maximum(c - 0.75, 0.0)
        return np.concatenate([super().residuals(u), np.stack([valley, hidden], axis=-1)[:, None]], axis=-1)

    def jacobian(self, u):
        sides = [self.residuals(u + sign * 1e-4 * one) for one in np.eye(3) for sign in (1, -1)]
        return self.residuals(u), np.stack([sides[i] - sides[i + 1] for i in (0, 2, 4)], axis=-1) / 2e-4


@pytest.mark.quick
@pytest.mark.parametrize(("rounds", "end", "cost"), [(6, 1.0, 1.04), (0, 0.0, 2.6)])
def test_ends_of_ranges_are_tried_again_from_the_floor_of_the_valley(rounds, end, cost, monkeypatch):
    monkeypatch.setattr("sysid.search.valleys.DEAR", 0.01)  # far along the ranges lies nothing
    monkeypatch.setattr("sysid.search.slopes.ROUNDS", rounds)
    found, _, _ = gradient_search(Hidden(), np.array([[0.9, 0.9, 0.5]]), 40, FitConfig(), None)
    assert found.u[2] == pytest.approx(end, abs=0.02)
    assert found.cost == pytest.approx(cost, rel=0.1)


def test_the_jacobian_is_that_of_the_residual(unicycle_log):
    objective = unicycle_objective(tuple(without_start_noise(trial) for trial in unicycle_log.training[:3]))
    u = np.array([[0.4, 0.5, 0.6]])
    _, jacobian = objective.jacobian(u)
    for parameter in range(3):
        step = np.eye(3)[parameter] * 1e-2
        slope = (objective.residuals(u + step) - objective.residuals(u - step)) / 2e-2
        error = np.linalg.norm(slope - jacobian[..., parameter]) / np.linalg.norm(slope)
        assert error < 0.01


def test_a_wrong_start_pose_is_absorbed_only_as_far_as_its_noise_allows(objective):
    """A start error of the size of its noise costs about its prior; ignoring it costs hundreds of samples."""
    moved = []
    for trial in objective.trials:
        start = dataclasses.replace(trial.start, yaw=trial.start.yaw + 0.02, position_sigma=1e-9, yaw_sigma=0.02)
        moved.append(dataclasses.replace(trial, start=start))
    solved = unicycle_objective(tuple(moved))
    strict = unicycle_objective(tuple(
        dataclasses.replace(trial, start=dataclasses.replace(trial.start, yaw_sigma=1e-9)) for trial in moved))
    base, absorbed, ignored = (dataclasses.replace(one, noise=objective.noise).weighted_cost(U_TRUTH[None])[0]
                               for one in (objective, solved, strict))
    assert absorbed < base + 0.1 < ignored - 1.0


def test_lm_reaches_the_noise_floor_from_several_starts(objective):
    starts = least_squares.random_starts(objective.space, 4, seed=1)
    result = least_squares.fit(objective, starts=starts)
    assert np.ptp(result.start_costs) < 0.01 * result.cost
    assert 0.8 < result.cost < 1.2  # the residual is as large as the spread between replicates
    np.testing.assert_allclose(objective.space.to_values(result.u), TRUTH, rtol=0.05)


def test_lm_stays_inside_the_bounds_and_finds_a_minimum_on_one(objective):
    space = dataclasses.replace(objective.space, low=np.array([0.02, 0.02, 0.95]), initial=np.array([0.1, 0.1, 1.2]))
    bounded = dataclasses.replace(objective, space=space)
    result = least_squares.fit(bounded)
    assert ((result.u >= 0) & (result.u <= 1)).all()
    assert space.to_values(result.u)[2] == pytest.approx(0.95)


def test_frozen_parameters_keep_their_value(objective):
    result = least_squares.fit(objective, frozen=("tau_v",), stop=least_squares.Stopping(3))
    assert objective.space.to_values(result.u)[0] == pytest.approx(0.1)
    assert result.cost < result.initial_cost


def test_a_robust_fit_is_not_drawn_by_outliers(objective):
    pose, start = objective.measured.pose.copy(), np.array([[trial.start.yaw] for trial in objective.trials])
    pose[:, ::7, 2] += 0.5 * (pose[:, ::7, 2] - start)  # every seventh yaw is half as far again
    spoiled = dataclasses.replace(objective, measured=dataclasses.replace(objective.measured, pose=pose))
    errors = [np.abs(least_squares.fit(spoiled, robust=robust).u - U_TRUTH).max()
              for robust in (False, True)]
    assert errors[1] < 0.5 * errors[0]


def test_intervals_of_a_robust_fit_are_not_those_of_its_outliers(objective):
    """Outliers of a few samples widen the intervals of squares, and hardly those of the Huber loss."""
    pose = objective.measured.pose.copy()
    pose[:, ::17, 2] += np.where(np.arange(pose[:, ::17].shape[1]) % 2, 0.3, -0.3)
    spoiled = dataclasses.replace(objective, measured=dataclasses.replace(objective.measured, pose=pose))
    u = least_squares.fit(spoiled, robust=True).u

    def widths(objective, robust):
        known = uncertainty.estimate(objective, u, robust=robust).estimates
        return np.array([one.high - one.low for one in known])

    clean, squares, huber = widths(objective, False), widths(spoiled, False), widths(spoiled, True)
    assert (huber < 2.5 * clean).all() and squares[2] > 1.5 * huber[2]
    for one, truth in zip(uncertainty.estimate(spoiled, u, robust=True).estimates, TRUTH, strict=True):
        assert one.low - (one.high - one.low) < truth < one.high + (one.high - one.low)


@pytest.mark.parametrize("cost", ["paper", "weighted"])
def test_tpe_improves_on_the_initial_values(objective, cost):
    result = studies.global_search(objective, objective.space, studies.GlobalSearch(64, 0, cost, best=3))
    assert result.cost < 0.5 * result.initial_cost
    assert result.starts.shape == (3, 3) and (np.diff(result.history) <= 0).all()


def test_the_papers_cost_is_the_sum_of_the_position_rmse(objective):
    from sysid.logs.metrics import score

    u = np.array([[0.3, 0.4, 0.5]])
    simulated = objective.simulate(u)
    one = type(simulated)(simulated.pose[0], simulated.odometry[0], simulated.diverged[0])
    errors = [score(trial, prediction)["ground_truth"]["trajectory"]
              for trial, prediction in zip(objective.trials, predictions(objective.trials, one), strict=True)]
    assert objective.paper_cost(u)[0] == pytest.approx(sum(errors), rel=1e-4)


def test_the_papers_cost_is_the_same_where_an_accelerator_sums_it(objective, monkeypatch):
    class Broken:
        def traced(self, values):
            simulated = objective.replay.traced(values)
            return dataclasses.replace(simulated, pose=simulated.pose.at[0].set(np.nan))

    u = np.random.default_rng(0).uniform(0.2, 0.8, (4, 3))
    expected = objective.paper_cost(u)
    monkeypatch.setattr("sysid.errors.normal_equations.on_processor", lambda: False)
    np.testing.assert_allclose(objective.paper_cost(u), expected, rtol=1e-4)
    broken = dataclasses.replace(objective, replay=Broken()).paper_cost(u)
    assert broken[0] > 100 and broken[1:] == pytest.approx(expected[1:], rel=1e-4)


def test_intervals_hold_the_truth_and_are_not_wide(objective):
    result = least_squares.fit(objective)
    known = uncertainty.estimate(objective, result.u)
    for estimate, truth in zip(known.estimates, TRUTH, strict=True):
        assert estimate.low - 0.02 * truth < truth < estimate.high + 0.02 * truth
        assert estimate.identifiable and estimate.high - estimate.low < 0.5 * truth
    assert known.weak_combinations() == []


def test_what_the_log_does_not_tell_is_named(objective):
    """Two parameters that act only as a sum, and one that does nothing."""
    space = Space(("a", "b", "nothing"), np.zeros(3), np.ones(3), np.full(3, 0.5), np.zeros(3, bool))
    plant = unicycle_plant()
    batch, measured = make_batch(objective.trials, plant.dt, record_dt=0.04)

    def lags(values):
        return values[:2].sum() * np.array([0.3, 0.2, 0.0]) + np.array([0.0, 0.0, 0.9])

    blind = dataclasses.replace(objective, replay=Replay(plant, batch, lags), space=space, measured=measured)
    result = least_squares.fit(blind, stop=least_squares.Stopping(8))
    known = uncertainty.estimate(blind, result.u)
    assert [estimate.identifiable for estimate in known.estimates] == [False, False, False]
    weak = " / ".join(known.weak_combinations())
    assert "nothing" in weak and "a" in weak and "b" in weak
    sum_sd = np.sqrt(np.array([1, 1, 0]) @ known.covariance @ np.array([1, 1, 0]))
    assert sum_sd < 0.1  # their sum is well known


def test_a_delay_is_profiled_on_a_grid_and_the_others_follow(objective):
    renamed = dataclasses.replace(objective.space, names=("delay", "tau_omega", "turn"))
    behind = dataclasses.replace(objective, space=renamed)
    off = U_TRUTH + np.array([0.0, 0.1, 0.0])
    (name, grid, costs, followed), = least_squares.profile_delays(behind, off)
    assert name == "delay" and 16 < len(grid) == len(costs) == len(followed) <= 16 + 2 * 13
    near = np.sort(np.abs(grid - behind.space.to_values(off)[0]))
    assert 0 < near[near > 1e-9].min() < 0.001  # s: finer than a step of the controller's clock
    assert grid[costs.argmin()] == pytest.approx(TRUTH[0], rel=0.1)
    assert np.abs(followed[costs.argmin(), 1:] - U_TRUTH[1:]).max() < 0.05
    np.testing.assert_allclose(behind.weighted_cost(followed), costs, rtol=1e-6)


def test_starts_that_have_converged_are_not_searched_further(objective):
    calls, tried = [], []

    class Counted:
        counted, space = objective.counted, objective.space

        @staticmethod
        def residuals(u):
            tried.append(len(u))
            return objective.residuals(u)

        @staticmethod
        def jacobian(u):
            calls.append(len(u))
            return objective.jacobian(u)

    starts = np.array([U_TRUTH, [0.9, 0.9, 0.1]])
    result = least_squares.fit(Counted(), starts=starts, stop=least_squares.Stopping(tolerance=1e-3))
    assert calls[0] == 2 and calls[-1] == 1
    assert result.evaluations == sum(calls) + sum(tried)


def test_steps_that_bring_what_they_promise_are_followed_without_a_new_jacobian(objective):
    """Fewer Jacobians lead to the same place, and what is learnt on the way foretells the last step exactly."""
    calls = []

    class Counted:
        counted, space = objective.counted, objective.space
        residuals = staticmethod(objective.residuals)

        @staticmethod
        def jacobian(u):
            calls.append(len(u))
            return objective.jacobian(u)

    start = np.array([[0.2, 0.8, 0.7]])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(least_squares, "FOLLOWING", 0)
        plain = least_squares.fit(Counted(), starts=start, stop=least_squares.Stopping(20))
        needed, calls[:] = len(calls), []
        assert plain.evaluations == needed * 5
    quick = least_squares.fit(Counted(), starts=start, stop=least_squares.Stopping(20))
    assert len(calls) < needed
    assert quick.cost == pytest.approx(plain.cost, rel=1e-4) and np.abs(quick.u - plain.u).max() < 0.01
    rng = np.random.default_rng(0)
    jacobian, change, move = rng.normal(size=(2, 3, 4, 5)), rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 5))
    learnt = least_squares._learnt(jacobian, change, move)
    np.testing.assert_allclose(np.einsum("nbkp,np->nbk", learnt, move), change, atol=1e-12)
    across = np.cross(move[0, :3], rng.normal(size=3))
    np.testing.assert_allclose(learnt[0, ..., :3] @ across, jacobian[0, ..., :3] @ across, atol=1e-12)


def test_a_diverged_simulation_is_dear_and_not_a_number_nowhere(objective):
    class Broken:
        def simulate(self, values):
            simulated = objective.replay.simulate(values)
            pose = simulated.pose.copy()
            pose[:, 0] = np.nan
            return dataclasses.replace(simulated, pose=pose)

    broken = dataclasses.replace(objective, replay=Broken())
    assert np.isfinite(broken.weighted_cost(U_TRUTH[None])).all()
    assert broken.weighted_cost(U_TRUTH[None])[0] > 1e3 * objective.weighted_cost(U_TRUTH[None])[0]
    assert broken.paper_cost(U_TRUTH[None])[0] > 100


@pytest.mark.quick
def test_noise_scales_are_named():
    noise = Noise(np.ones(3), np.arange(5.0), "defaults")
    assert noise.as_dict()["odometry.omega"] == 4.0


def test_progress_names_the_stage_of_each_cost(objective):
    """Costs of two stages are of two objectives; each remark says whose it is."""
    said = []
    stages = Stages(lambda count, remark: said.append((count, remark)), 2)
    least_squares.fit(objective, stop=least_squares.Stopping(2), progress=stages.begin("whole poses"))
    gradient_search(objective, UNICYCLE_SPACE.to_unit(TRUTH)[None], 2,
                    FitConfig(elsewhere=False), Stages(lambda count, remark: said.append((count, remark)), 2))
    remarks = [remark for _, remark in said]
    assert remarks[0] == "stage 1 of 2, whole poses" and remarks[1].startswith("stage 1 of 2, whole poses: cost ")
    assert sum(count for count, _ in said) == len([remark for remark in remarks if "cost" in remark])
    assert remarks[-1] == "stage 2 of 2, checks from other starts" and Stages(None, 2).begin("features") is None
