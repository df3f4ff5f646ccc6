"""Intervals hold the truth as often as they say, whatever the errors within a drive; a drive's start counts once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import unicycle_objective

from sysid.errors.space import Space
from sysid.intervals import independence, uncertainty
from sysid.intervals.independence import sandwich
from sysid.logs.records import Command, Start, Trial
from sysid.search import least_squares

DRIVES, SAMPLES, PARAMETERS = 12, 80, 3


@pytest.fixture(autouse=True)
def few_flips(monkeypatch):
    """Enough for shares over hundreds of logs."""
    monkeypatch.setattr(independence, "FLIPS", 199)


class Linear:
    """Residuals of y = X u + errors, as an objective shows them."""

    def __init__(self, design: np.ndarray, errors: np.ndarray):
        count = design.shape[-1]
        self.space = Space(tuple("abcdefg"[:count]), np.zeros(count), np.ones(count), np.full(count, 0.5),
                           np.zeros(count, bool))
        # Twos are replicates: 0_1, 0_2, 1_1, ...
        self.trials = tuple(drive(i // 2, i % 2 + 1) for i in range(len(design)))
        self.prior = None
        self._design, self._errors = design, errors
        self.counted = errors.size

    def residuals(self, u):
        return np.einsum("bkp,np->nbk", self._design, u - 0.5) - self._errors

    def jacobian(self, u):
        return self.residuals(u), np.tile(self._design, (len(u), 1, 1, 1))

    def pieces(self, count):
        samples = self._design.shape[1]
        return np.arange(samples) * count // samples

    def own_frame(self, residual):
        return residual


class Growing(Linear):
    """Residuals of y = X g(u) + errors, of which a log tells the more the larger the parameter is."""

    RATE = 3.0

    def level(self, u):
        return np.exp(self.RATE * (u - 0.5)) / self.RATE

    def residuals(self, u):
        return super().residuals(self.level(u) - self.level(0.5) + 0.5)

    def jacobian(self, u):
        slope = np.exp(self.RATE * (u - 0.5))
        return self.residuals(u), slope[:, None, None] * self._design


def drive(manoeuvre: int, replicate: int) -> Trial:
    command = Command(np.zeros(1), np.full(1, float(manoeuvre)), np.zeros(1))
    return Trial(f"m{manoeuvre}_{replicate}", f"m{manoeuvre}", command, None, None, Start())


@pytest.mark.quick
@pytest.mark.parametrize("ahead", [0.0, 0.4, 1.0, 1.0 + 1e-9, 2.0, 3.0])
def test_an_interval_reaches_as_far_as_what_is_told_between_adds_up_to(ahead):
    reach = float(uncertainty.stretched(np.array(ahead)))
    x = np.linspace(0.0, reach, 200_001)
    assert np.trapezoid(1 / (1 + (ahead - 1) * x), x) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.quick
def test_an_interval_reaches_three_half_widths_at_most():
    assert uncertainty.stretched(np.array(50.0)) == uncertainty.stretched(np.array(uncertainty.WIDEST)) < 3.2


@pytest.mark.quick
@pytest.mark.parametrize("name, alike", [("body.com_z", 1.0), ("body.com_x", 0.7)])
def test_the_height_of_the_mass_is_told_as_far_on_either_side_where_a_log_tells_more_of_a_high_one(name, alike):
    random = np.random.default_rng(5)
    design = random.standard_normal((DRIVES, SAMPLES, 1))
    objective = Growing(design, 2.6 * random.standard_normal((DRIVES, SAMPLES)))
    objective.space = dataclasses.replace(objective.space, names=(name,))
    u = least_squares.fit(objective, stop=least_squares.Stopping(20)).u
    (told,) = uncertainty.estimate(objective, u).estimates
    low, middle, high = (objective.level(one) for one in (told.low, u[0], told.high))
    assert told.high - told.low > 0.2
    assert (middle - low) / (high - middle) == pytest.approx(alike, abs=0.08)


def correlated(random: np.random.Generator, rho: float) -> np.ndarray:
    """(DRIVES, SAMPLES) errors of variance 1 within drives that do not know of each other."""
    errors = random.standard_normal((DRIVES, SAMPLES))
    for k in range(1, SAMPLES):
        errors[:, k] = rho * errors[:, k - 1] + np.sqrt(1 - rho**2) * errors[:, k]
    return errors


def designs(random: np.random.Generator) -> np.ndarray:
    """(DRIVES, SAMPLES, PARAMETERS): slow and fast, and of one parameter in every third drive only."""
    t = np.linspace(0, 1, SAMPLES)
    size = random.uniform(0.5, 1.5, (DRIVES, 1))
    third = np.where(np.arange(DRIVES)[:, None] % 3 == 0, size, 0.0)
    return 30 * np.stack([size * t, size * np.sin(20 * t), third * np.ones_like(t)], axis=-1)


def covered(objective: Linear) -> tuple[list[bool], np.ndarray]:
    """Whether the interval of each parameter holds the truth, 0.5, and the fit (P,)."""
    u = least_squares.fit(objective, stop=least_squares.Stopping(4)).u
    return [one.low <= 0.5 <= one.high for one in uncertainty.estimate(objective, u).estimates], u


@pytest.mark.quick
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_intervals_of_correlated_errors_cover_nine_in_ten(rho):
    """The widest of several estimates is taken, and would hold in 96 were it not corrected for that."""
    random = np.random.default_rng(1)
    inside = []
    for _ in range(400):
        inside.append(covered(Linear(designs(random), correlated(random, rho)))[0])
    share = np.mean(inside, axis=0)
    assert (share > 0.87).all() and (share < 0.955).all() and share.mean() < 0.93


@pytest.mark.quick
def test_the_variance_of_few_blocks_is_unbiased_where_errors_are_independent():
    """Without the correction, five drives of three parameters show far too little of it."""
    random = np.random.default_rng(2)
    design = designs(random)[:5]
    blocks = np.einsum("bkp,bkq->bpq", design, design)
    inverse = np.linalg.inv(blocks.sum(0))
    one = sandwich(blocks, inverse)
    found, plain = [], []
    for _ in range(2000):
        errors = random.standard_normal(design.shape[:2])
        residual = errors - design @ (inverse @ np.einsum("bkp,bk->p", design, errors))
        scores = np.einsum("bkp,bk->bp", design, residual)
        found.append(np.diag(one.covariance(scores)))
        plain.append(np.square(scores @ inverse).sum(0))
    told = np.diag(inverse)
    np.testing.assert_allclose(np.mean(found, 0), told * one.informed, rtol=0.1)
    assert one.informed[:2] == pytest.approx(1.0, rel=1e-6)
    assert (np.mean(plain, 0) < 0.85 * told).all()
    # Satterthwaite: the degrees of freedom say how much the variance itself varies.
    np.testing.assert_allclose(2 * np.mean(found, 0) ** 2 / np.var(found, 0), one.freedom, rtol=0.25)


def misfit(random: np.random.Generator) -> np.ndarray:
    """(DRIVES, SAMPLES): the same in both replicates of a manoeuvre, twice as large as the noise."""
    return 2 * np.repeat(correlated(random, 0.9)[: DRIVES // 2], 2, axis=0)


@pytest.mark.quick
def test_what_replicates_share_widens_intervals_until_they_hold():
    """A model that is wrong about each manoeuvre in its own way: replicates do not average that out."""
    random = np.random.default_rng(4)
    design = np.repeat(designs(random)[::2], 2, axis=0)
    inside, narrow = [], []
    for _ in range(300):
        objective = Linear(design, correlated(random, 0.5) + misfit(random))
        held, u = covered(objective)
        inside.append(held)
        shared = independence.shared_error(objective.residuals(u[None])[0], np.arange(DRIVES) // 2)
        narrow.append(shared > independence.CHANCE)
    assert np.mean(narrow) < 0.05
    assert (np.mean(inside, axis=0)[:2] > 0.83).all()


@pytest.mark.quick
def test_errors_that_replicates_share_at_places_of_their_drives_are_counted_once():
    """Two drives of a manoeuvre do not average out where a wheel breaks away a little early in both."""
    random = np.random.default_rng(7)
    design = np.repeat(designs(random)[::2], 2, axis=0)
    inside, reach = [], []
    for shared in (1.5, 0.0):
        held, width = [], []
        for _ in range(120):
            places = random.standard_normal((DRIVES // 2, uncertainty.PIECES))
            errors = shared * np.repeat(np.repeat(places, SAMPLES // uncertainty.PIECES, axis=1), 2, axis=0)
            objective = Linear(design, random.standard_normal((DRIVES, SAMPLES)) + errors)
            u = least_squares.fit(objective, stop=least_squares.Stopping(4)).u
            known = uncertainty.estimate(objective, u)
            held.append([one.low <= 0.5 <= one.high for one in known.estimates])
            width.append(known.quantile * known.deviation)
        inside.append(np.mean(held, axis=0))
        reach.append(np.median(width, axis=0))
    assert (inside[0][:2] > 0.85).all() and (inside[0][:2] < 0.955).all() and (inside[1] > 0.85).all()
    assert (reach[0] > 2 * reach[1]).all()


@pytest.mark.quick
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_replicates_that_share_nothing_are_rarely_taken_to(rho):
    random = np.random.default_rng(5)
    found = []
    for _ in range(300):
        design, errors = designs(random), correlated(random, rho)
        inverse = np.linalg.inv(np.einsum("bkp,bkq->pq", design, design))
        residual = errors - design @ (inverse @ np.einsum("bkp,bk->p", design, errors))
        found.append(independence.shared_error(residual, np.arange(DRIVES) // 2))
    assert np.mean(np.array(found) < independence.CHANCE) < 0.08
    assert independence.shared_error(residual, np.arange(DRIVES)) == 1.0


@pytest.mark.quick
def test_a_parameter_that_one_drive_tells_is_not_judged_between_drives():
    random = np.random.default_rng(3)
    design = designs(random)
    design[1:, :, 2] = 0.0
    objective = Linear(design, correlated(random, 0.0))
    u = least_squares.fit(objective, stop=least_squares.Stopping(4)).u
    known = uncertainty.estimate(objective, u)
    independent = np.sqrt(np.linalg.inv(np.einsum("bkp,bkq->pq", design, design))[2, 2])
    assert known.deviation[2] > 0.9 * independent


@pytest.mark.quick
def test_an_error_of_the_odometrys_start_is_absorbed_as_far_as_its_noise_allows(unicycle_log):
    """The odometry counts from the mean of a noisy standstill: turned by that error, all of it is off."""
    objective = unicycle_objective(unicycle_log.training)
    u = least_squares.fit(objective, stop=least_squares.Stopping(8)).u
    assert all(0 < trial.start.odometry_yaw_sigma < 1e-3 for trial in objective.trials)
    off = 5e-4  # rad
    odometry = objective.measured.odometry.copy()
    x, y = odometry[..., 0].copy(), odometry[..., 1].copy()
    odometry[..., 0], odometry[..., 1] = x - off * y, y + off * x
    odometry[..., 2] += off * (odometry[..., 2] != 0)
    turned = dataclasses.replace(objective, measured=dataclasses.replace(objective.measured, odometry=odometry))
    exact = tuple(dataclasses.replace(trial, start=dataclasses.replace(
        trial.start, odometry_position_sigma=0.0, odometry_yaw_sigma=0.0)) for trial in objective.trials)
    rigid = dataclasses.replace(turned, trials=exact)
    worse = [float(np.square(one.residuals(u[None])).sum()) - float(np.square(level.residuals(u[None])).sum())
             for one, level in ((turned, objective), (rigid, dataclasses.replace(objective, trials=exact)))]
    assert worse[0] < 0.5 * worse[1]


@pytest.mark.quick
def test_what_the_start_was_averaged_from_is_not_scored_again(unicycle_log):
    objective = unicycle_objective(unicycle_log.training)
    first = unicycle_log.training[0]
    resting = int((first.ground_truth.t <= first.start.rest).sum())
    residual, tables = objective.residuals(np.full((1, 3), 0.5))[0, 0], (objective.measured.pose[0],
                                                                         objective.measured.odometry[0])
    pose, odometry = residual[: tables[0].size], residual[tables[0].size : tables[0].size + tables[1].size]
    pose, odometry = pose.reshape(tables[0].shape), odometry.reshape(tables[1].shape)
    assert resting > 5 and first.start.rest > 0
    for column in (pose[:, 0], odometry[:, 2]):
        assert (column[:resting] == 0).all() and column[resting] != 0
    assert odometry[0, 3] != 0
    assert objective.counted < objective.measured.pose_mask.sum() + objective.measured.odometry_mask.sum()


@pytest.mark.quick
def test_a_nuisance_is_never_told_and_its_interval_is_its_bounds():
    random = np.random.default_rng(5)
    plain, other = (Linear(designs(np.random.default_rng(6)), correlated(random, 0.0)) for _ in range(2))
    other._errors = plain._errors
    other.space = dataclasses.replace(plain.space, names=("a", "torque_drive.period", "c"))
    u = least_squares.fit(plain, stop=least_squares.Stopping(4)).u
    usual, known = (uncertainty.estimate(one, u).estimates for one in (plain, other))
    assert usual[1].identifiable and not known[1].identifiable and "not identifiable" in known[1].remark
    assert (known[1].low, known[1].high) == (0.0, 1.0)
    assert (known[0].low, known[2].high) == (usual[0].low, usual[2].high)


@pytest.mark.quick
def test_errors_of_the_same_information_are_computed_once(monkeypatch):
    """They take longest of all that intervals take; only the other end of a bent parameter has its own."""
    asked = []

    def counted(*given):
        asked.append(independence.errors_of(*given))
        return asked[-1]

    monkeypatch.setattr(uncertainty, "errors_of", counted)
    random = np.random.default_rng(5)
    objective = Linear(designs(random), correlated(random, 0.5))
    known = uncertainty.estimate(objective, least_squares.fit(objective, stop=least_squares.Stopping(4)).u)
    assert len(asked) == 1
    elsewhere = dataclasses.replace(known.evidence, u=known.evidence.u + 0.01)
    again = uncertainty.uncertainty_of(elsewhere, objective.space, errors=known.errors)
    assert len(asked) == 1
    assert again.estimates == uncertainty.uncertainty_of(elsewhere, objective.space).estimates


@pytest.mark.quick
def test_an_interval_reaches_as_far_down_as_up_on_the_scale_on_which_it_is_told():
    """The wheels' inertia is a term of what drives tell, not a factor."""
    names = ("wheel_inertia.ratio", "torque_drive.kp")
    space = Space(names, np.full(2, 0.2), np.full(2, 20.0), np.full(2, 2.0), np.ones(2, bool))
    scores = 5.0 * np.random.default_rng(0).standard_normal((12, 8, 2))
    parts = np.tile(9.0 * np.eye(2), (12, 8, 1, 1))
    told = independence.Information(np.full(2, 0.5), scores - scores.mean((0, 1)), parts, np.arange(12) // 2, 1.0, 1.0,
                                    np.eye(2), 1.0)
    wheels, gain = uncertainty.uncertainty_of(told, space).estimates
    assert wheels.identifiable and gain.identifiable and wheels.high > 2.5
    assert wheels.high - wheels.value == pytest.approx(wheels.value - wheels.low)
    assert gain.high / gain.value == pytest.approx(gain.value / gain.low)
    wide = dataclasses.replace(told, scores=6 * told.scores)
    assert uncertainty.uncertainty_of(wide, space).estimates[0].low == 0.2  # no further than its bound
