"""How well a named effect's size is known, and what warns that it may be another one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sysid.follow_up.trust import at_the_end, intervals, undone
from sysid.logs.metrics import replicate_noise
from sysid.missing.catalogue import Axis, Hypothesis, hypotheses
from sysid.missing.days import no_wander
from sysid.missing.evidence import column_layout
from sysid.missing.joint_fit import Refit, Start
from sysid.missing.pose_fit import by_own_noise, to_its_end
from sysid.missing.refit import Refitter
from sysid.replay.records import Measured
from sysid.search import least_squares
from sysid.verdict.rounds import elsewhere
from whill_mjx.effects.side_force import pushed_anywhere
from whill_mjx.vehicle.presets import preset

pytestmark = pytest.mark.quick
ONE = Hypothesis("slope", (Axis("slope.along_x", 0.01, signed=True, limit=50.0),))
TWO = Hypothesis("wind", (Axis("wind.along_x", 1.0, signed=True, limit=50.0),))
GROUPS = tuple((2 * i, 2 * i + 1) for i in range(8))


def fitted(rng, spread=0.0, axes=(ONE,)):
    """A joint fit of one base parameter and some effects of size 1, whose manoeuvres each have a size of their own."""
    size = 1 + sum(len(one.axes) for one in axes)
    columns = rng.standard_normal((16, 60, size))
    sizes = np.repeat(1 + spread * rng.standard_normal(8), 2)
    data = np.einsum("bni,b->bn", columns[..., 1:], sizes) + rng.standard_normal((16, 60))
    flat = columns.reshape(-1, size)
    found = np.linalg.solve(flat.T @ flat, flat.T @ data.reshape(-1))
    return Refit(axes, found[:1], found[1:], 0.0, data - columns @ found, columns, found)


def result_of(axes=(ONE,)):
    layout = column_layout(axes, 1)
    return SimpleNamespace(evidence=SimpleNamespace(groups=GROUPS, precision=1e-6 * np.eye(1), columns=layout),
                           hypotheses=axes, prepared=SimpleNamespace(wander=no_wander(layout)))


def test_a_size_that_one_manoeuvre_tells_is_not_judged_by_the_others():
    rng = np.random.default_rng(5)
    fit = fitted(rng)
    columns = fit.jacobian.copy()
    columns[2:, :, 1] *= 1e-3
    (low,), (high,) = intervals(replace(fit, jacobian=columns), result_of())
    told = 1 / np.sqrt(np.square(columns[:2, :, 1]).sum())
    assert 4 * told < high - low < 16 * told


@pytest.mark.parametrize("spread", [0.0, 0.1, 0.5])
def test_intervals_hold_the_mean_size_however_much_manoeuvres_differ(spread):
    rng, inside = np.random.default_rng(0), []
    for _ in range(200):
        (low,), (high,) = intervals(fitted(rng, spread), result_of())
        inside.append(low <= 1.0 <= high)
    assert np.mean(inside) > 0.91


def test_what_an_effect_leaves_open_widens_its_interval_to_one_side_only():
    axis = replace(ONE.axes[0], open=(1.0, 3.0))
    for sign in (1, -1):
        fit = fitted(np.random.default_rng(1))
        fit = replace(fit, q=sign * fit.q)
        (low,), (high,) = intervals(fit, result_of())
        wider = (replace(ONE, axes=(axis,)),)
        (wide_low,), (wide_high,) = intervals(replace(fit, hypotheses=wider), result_of(wider))
        near, far = (low, high) if sign > 0 else (high, low)
        assert (wide_low, wide_high) == pytest.approx((near, 3 * far) if sign > 0 else (3 * far, near))


def test_a_side_force_may_act_anywhere_ahead_of_the_driven_axle():
    spec, params = preset("whill_cr_physical")
    [side] = [one for one in hypotheses(spec, params) if one.effect == "side_force"]
    least, most = side.axes[0].open
    arm = abs(spec.reference_x)
    for place in (0.3, 0.5, 0.7):  # of the wheelbase: a force there that turns as much as 1 at the origin
        assert least <= arm / (place * spec.wheelbase) <= most
    assert pushed_anywhere(replace(spec, drive="skid")) == (1.0, 1.0)
    assert pushed_anywhere(replace(spec, rear_axle_x=0.0)) == (1.0, 1.0)


def test_effects_that_undo_one_another_are_told_from_those_that_do_not():
    fit = fitted(np.random.default_rng(2), axes=(ONE, TWO))
    [(first, second, left)] = undone(fit)
    assert (first, second) == ("slope", "wind") and 0.8 < left < 1.2
    columns = fit.jacobian.copy()
    columns[..., 2] = -columns[..., 1] + 0.3 * columns[..., 2]
    assert undone(replace(fit, jacobian=columns))[0][2] < 0.2


def test_a_size_at_the_end_of_its_range_is_told():
    fit, result = fitted(np.random.default_rng(3)), result_of()
    assert not at_the_end(SimpleNamespace(**vars(result), search=SimpleNamespace(final=fit)))
    end = replace(ONE, axes=(replace(ONE.axes[0], limit=1.0),))
    moved = replace(fit, hypotheses=(end,), q=np.array([0.99]))
    short = result_of((end,))
    assert at_the_end(SimpleNamespace(**vars(short), search=SimpleNamespace(final=moved))) == ["slope.along_x"]


def test_a_fit_at_the_end_of_a_range_starts_anew_with_the_effect_alone():
    axes = (Axis("payload_shift.mass", 4.0), Axis("payload_shift.x", 1.0, form="moment", signed=True, dependent=True))
    payload = Hypothesis("payload_shift", axes)
    refitter = Refitter.__new__(Refitter)
    refitter.low, refitter.high, refitter.reference = np.zeros(1), np.ones(1), SimpleNamespace(u=np.array([0.5]))
    fit = Refit((ONE, payload), np.array([0.4]), np.array([2.0, 5.0, 3.0]), 0.0, *[np.zeros((1, 1))] * 2, np.zeros(1))
    assert not refitter.stuck(fit)
    assert refitter.stuck(replace(fit, u=np.zeros(1))) and refitter.stuck(replace(fit, q=np.array([2.0, 5.0, -12.0])))
    starts = elsewhere(refitter, fit, 1)
    found = [start.q.tolist() for start in starts]
    assert found == [[2.0, 5.0, 0.0], [2.0, 12.0, 0.0], [2.0, 5.0, -2.0], [2.0, 5.0, 2.0]]
    assert all(start.u == 0.5 for start in starts)


def test_drives_are_weighed_by_what_their_replicates_differ_by(unicycle_log):
    trials = tuple(replace(one, name=f"{one.manoeuvre}_{k}") for one in unicycle_log.training[:4:2] for k in (1, 2))
    rng = np.random.default_rng(4)
    rough = [replace(one, ground_truth=replace(one.ground_truth, x=one.ground_truth.x + size * rng.standard_normal()))
             for one, size in zip(trials, (0.001, 0.001, 0.2, 0.2), strict=True)]
    ones = np.ones((4, 3, 3))
    plain = Measured(ones, ones, np.ones((4, 3, 5)), np.ones((4, 3, 5)))
    weighed = by_own_noise(rough, plain).pose_mask[:, 0, 0]
    assert replicate_noise(tuple(rough)) is not None
    assert weighed[0] == weighed[1] > 1.1 > 0.95 > weighed[2] == weighed[3]
    alone = [replace(one, name=one.manoeuvre) for one in trials[::2]]
    assert by_own_noise(alone, plain) is plain


def folded(u):
    """(N, 1, 2) residuals of a steep valley b = a^2 with a fold every 0.04 along its floor, lowest near a = 0.47."""
    a, b = u[:, 0], u[:, 1]
    return np.stack([200 * (b - a**2), 40 * (a - 0.4) + 3 * np.sin(50 * np.pi * a)], axis=-1)[:, None]


class OnFolds(Refitter):
    """Refits of two base parameters that lie anywhere, by derivatives over a share of their range."""

    def __init__(self, u):
        self.drives = SimpleNamespace(mask=np.ones((1, 3)))
        self.reference = SimpleNamespace(u=np.array(u), spread=0.29**2 * np.eye(2))
        self.precision = np.linalg.inv(self.reference.spread)
        self.low, self.high, self.target = np.zeros(2), np.ones(2), np.zeros((1, 2))
        sides = folded(self.reference.u + 0.05 * np.concatenate([np.eye(2), -np.eye(2)]))
        self.white_slopes = np.moveaxis(sides[:2] - sides[2:], 0, -1) / 0.1

    def replayed(self, sets):
        return [folded(sets)]

    def values_at(self, _, u, __):
        return u


@pytest.mark.parametrize("start", [(0.9, 0.9), (0.8, 0.2), (0.1, 0.9)])
def test_a_refit_that_came_to_rest_on_a_fold_goes_on_from_there(start):
    refitter = OnFolds(start)
    found = refitter.fit((), np.zeros(0), 60)
    np.testing.assert_allclose(found.u, [0.472, 0.223], atol=2e-3)
    again = refitter.fit_all([Start.at(found)], 60)[0]
    assert found.cost - again.cost < 1e-3 * found.cost


class Curved:
    """A steep valley b = a^2 that bends; cost 0.01 at its end, a = 0.4."""

    counted, space = 1, SimpleNamespace(names=("a", "b"), size=2, moved=np.add)

    def residuals(self, u):
        a, b = u[:, 0], u[:, 1]
        return np.stack([100 * (b - a**2), a - 0.4, np.full_like(a, 0.1)], axis=-1)[:, None]

    def jacobian(self, u):
        sides = [self.residuals(u + sign * 1e-4 * one) for one in np.eye(2) for sign in (1, -1)]
        return self.residuals(u), np.stack([sides[0] - sides[1], sides[2] - sides[3]], axis=-1) / 2e-4


def test_a_fit_to_poses_is_followed_until_another_search_gains_nothing():
    begun = []

    def objective(at):
        begun.append(at)
        return Curved()

    start = np.array([0.9, 0.1])
    one = least_squares.fit(Curved(), starts=start[None], stop=least_squares.Stopping(2))
    end = to_its_end(objective, start, 2)
    np.testing.assert_array_equal(begun[1], one.u)  # derivatives are taken around where the search before it ended
    assert abs(end[0] - 0.4) < 0.05 < 0.15 < abs(one.u[0] - 0.4) and len(begun) > 3
    begun.clear()
    to_its_end(objective, end, 20)
    assert len(begun) <= 2
