"""A further effect, or another form of the one before it; and which effects have their chance in a round."""

from types import SimpleNamespace

import numpy as np
import pytest

from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.joint_fit import Refit
from sysid.verdict.agreement import foretold
from sysid.verdict.forms import forms_of, modulated
from sysid.verdict.posterior import Thresholds
from sysid.verdict.rounds import _rivals, _starts

pytestmark = pytest.mark.quick
TRIALS, BINS = 6, 80
GROUPS = [[0, 1], [2, 3], [4, 5]]


def effect(name):
    return Hypothesis(name, (Axis(f"{name}.size", 1.0, limit=50.0),))


class Linear:
    """Features that are linear in a base parameter and two effects, with white noise of size 1."""

    def __init__(self, second, truth, form=0.0, sizes=(1.0, 1.0, 1.0)):
        """`second` (B, K, 5): signature of the second effect. `form`: of the first one beyond what its law says.
        `sizes`: of the first one in each manoeuvre, as a share of its own."""
        rng = np.random.default_rng(0)
        self.motion = np.stack([np.cumsum(rng.standard_normal((TRIALS, BINS)), 1) / 6 for _ in range(5)], -1)
        first = rng.standard_normal((TRIALS, BINS, 5)) * (np.arange(5) > 1)  # speeds are those of the motion
        self.signatures = np.stack([first[::-1], first, second(self, first)], -1)
        self.precision, self.groups = np.eye(1), GROUPS
        self.reference = SimpleNamespace(u=np.zeros(1))
        self.drives = SimpleNamespace(simulate=lambda sets: np.stack([self.features(one) for one in sets]),
                                      features=SimpleNamespace(width=0.25))
        law = first * (1 + form * np.abs(self.motion[..., :1])) * np.repeat(sizes, 2)[:, None, None]
        self.data = self.features(np.array([0.0, 0.0, truth[1]])) + truth[0] * law + rng.standard_normal(first.shape)

    def features(self, sizes):
        return self.motion + self.signatures @ sizes

    def white(self, series):
        return series.reshape(TRIALS, BINS * 5, *series.shape[3:])

    def values_at(self, hypotheses, u, q):
        sizes = {one.effect: size for one, size in zip(hypotheses, q, strict=True)}
        return np.array([*u, sizes.get("first", 0.0), sizes.get("second", 0.0)])

    def fit(self, count):
        """The joint fit of the first `count` effects."""
        columns = self.white(self.signatures[..., : 1 + count])
        flat, data = columns.reshape(-1, 1 + count), self.white(self.data - self.motion)
        sizes = np.linalg.lstsq(flat, data.reshape(-1), rcond=None)[0]
        residual = data - columns @ sizes
        names = tuple(effect(name) for name in ("first", "second")[:count])
        whole = np.concatenate([sizes, np.zeros(2 - count)])
        return Refit(names, sizes[:1], sizes[1:], float(np.square(residual).sum()), residual, columns, whole)


def unrelated(model, first):
    return first[:, ::-1]


def stronger_when_fast(model, first):
    return first * np.abs(model.motion[..., :1])


def like_the_first(model, first):
    return first / 2 + first[:, ::-1]


def test_a_second_effect_is_no_worse_predicted_where_the_first_has_another_size_in_a_manoeuvre():
    """How large the first one is there, no other manoeuvre could know: the second is judged by the rest."""
    model = Linear(like_the_first, (8.0, 1.0), sizes=(0.5, 1.0, 2.0))
    fit = model.fit(2)
    _, apart = forms_of(model, fit, GROUPS).gain(0.5, 1, GROUPS)
    plainly = foretold(fit, fit.parts[1], GROUPS, model.precision)
    assert apart.min() > 200 and plainly.min() < -200


@pytest.mark.parametrize(("second", "form", "own"), [(unrelated, 0.0, True), (stronger_when_fast, 0.5, False)])
def test_what_other_forms_of_the_first_effect_explain_is_no_gain_of_a_second(second, form, own):
    model = Linear(second, (3.0, 0.0 if form else 1.0), form)
    fit = model.fit(2)
    assert abs(fit.q[1]) > 0.9  # it explains what the law of the first leaves
    plain, found = model.fit(1).cost - fit.cost, forms_of(model, fit, GROUPS)
    gain, apart = found.gain(0.5, 1, GROUPS)
    assert gain > 0.9 * plain if own else gain < 0.1 * plain
    assert (apart.min() > 0.1 * plain) == own  # 0.2 of its squares: a log density has half of them
    assert np.square(found.left(0.5)).mean() == pytest.approx(1.0, abs=0.05)
    assert own or np.square(model.fit(1).residual).mean() > 1.2  # by its law alone the first leaves more


def test_the_curve_of_a_form_shows_over_which_quantity_an_effect_is_larger_than_its_law():
    model = Linear(unrelated, (3.0, 0.0), 0.5)
    fit = model.fit(1)
    speed, turning, time = forms_of(model, fit, GROUPS).deviations(0.5, 0)
    assert [one.quantity for one in (speed, turning, time)] == ["speed", "yaw rate", "time in the drive"]
    planted = 3.0 * (1 + 0.5 * np.abs(speed.at)) / fit.q[0] - 1  # off the size that is found on average
    assert np.mean(np.abs(speed.share - planted) < 2 * speed.error) > 0.8 and speed.share.max() > 5 * speed.error.max()
    for one in (turning, time):  # it does not depend on these
        assert np.abs(one.share / np.maximum(one.error, 1e-9)).max() < 3
    assert time.at[[0, -1]].tolist() == [0.0, BINS * 0.25]


def test_columns_of_other_forms_are_the_effect_itself_where_nothing_modulates_it():
    rng = np.random.default_rng(0)
    change, motion = rng.standard_normal((TRIALS, BINS, 5)), np.zeros((TRIALS, BINS, 5))
    columns = modulated(change, motion, GROUPS)
    assert columns.shape == (*change.shape, 7 + len(GROUPS) + 2)
    assert not columns[..., :6].any()  # the vehicle stands still
    np.testing.assert_allclose(columns[..., 7 : 7 + len(GROUPS)].sum(-1), change)


def test_what_gains_most_is_refitted_though_it_does_not_stand_out():
    """What wanders from day to day must be larger to stand out; what imitates it need not."""
    effects = [effect(name) for name in ("traction", "payload", "slope")]
    gain, worth = np.array([100.0, 20.0, 1.0]), np.array([1.0, 15.0, 1.0])
    first = SimpleNamespace(p_of=lambda h, worth: 0.001 if worth > 10 else 0.5)
    chosen = _starts(effects, [(gain, worth, tuple(np.ones(1) for _ in effects))] * 2, first, range(3), Thresholds())
    assert sorted(h for h, _ in chosen) == [0, 1]
    chosen = _starts(effects, [(gain, worth, tuple(np.ones(1) for _ in effects))] * 2, first, [1, 2], Thresholds())
    assert [h for h, _ in chosen] == [1]


@pytest.mark.parametrize("imitates", [(0, 1), (1, 0)])
def test_what_the_best_fit_imitates_has_its_chance_as_what_imitates_it(imitates):
    effects = [effect(name) for name in ("payload", "traction", "slope")]
    similar = np.eye(3)
    similar[imitates] = 0.8
    assert _rivals(effects, similar, [0], [SimpleNamespace(cost=1.0)], set()) == [1]
    assert _rivals(effects, np.eye(3), [0], [SimpleNamespace(cost=1.0)], set()) == []
