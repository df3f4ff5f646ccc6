"""What a named effect must stand: agreement of manoeuvres that see it, and its own falsifiers."""

from types import SimpleNamespace

import numpy as np
import pytest

from sysid.logs.records import Command, OdometryStream, Start, Trial
from sysid.missing.catalogue import Hypothesis, hypotheses, outside_hypotheses
from sysid.missing.catalogue import falsifiers as known
from sysid.missing.joint_fit import Refit
from sysid.verdict import falsification
from sysid.verdict.agreement import SCATTER, heterogeneity, interval_of_sum
from sysid.verdict.falsification import course_of, sizes_in_parts
from sysid.verdict.falsifiers import QUIET, SPLITS, side
from sysid.verdict.pipeline import guarded
from sysid.verdict.posterior import Thresholds
from sysid.verdict.result import Support
from sysid.verdict.search_record import Candidate, Search
from whill_mjx.effects import EFFECTS
from whill_mjx.effects.card import GONE_WHEN_SETTLED, QUANTITIES, STATES, Axis, Falsifier
from whill_mjx.vehicle.presets import preset

pytestmark = pytest.mark.quick
TWO = Falsifier("has one size", "speed")
SIGN = Falsifier("changes sign with the heading", "heading along x", -1.0)


def test_manoeuvres_that_agree_say_so_only_where_they_could_have_differed():
    assert heterogeneity(np.ones(6), np.full(6, 0.1)).outcome == "agree"
    assert heterogeneity(np.ones(2), np.full(2, 0.34)).outcome == "untold"


def test_a_manoeuvre_that_cannot_see_an_effect_has_no_veto():
    sizes, errors = np.array([1.0, 1.0, 1.0, 1.0, -9.0]), np.array([0.1, 0.1, 0.1, 0.1, 4.0])
    found = heterogeneity(sizes, errors)
    assert found.asked.sum() == 4
    assert found.outcome == "agree"
    assert heterogeneity(sizes, np.full(5, 0.1)).outcome == "differ"


def test_the_power_of_the_agreement_test_is_what_simulations_show():
    rng, errors = np.random.default_rng(0), np.array([0.1, 0.15, 0.2, 0.25, 0.3])
    drawn = 1 + SCATTER * rng.standard_normal((1000, 5)) + errors * rng.standard_normal((1000, 5))
    differ = np.mean([heterogeneity(each, errors).outcome == "differ" for each in drawn])
    assert heterogeneity(np.ones(5), errors).power == pytest.approx(differ, abs=0.06)
    alike = 1 + errors * rng.standard_normal((1000, 5))
    assert np.mean([heterogeneity(each, errors).p < 0.05 for each in alike]) == pytest.approx(0.05, abs=0.02)


def test_the_scatter_of_sizes_is_told_with_its_lower_end():
    rng, errors = np.random.default_rng(1), np.full(8, 0.1)
    found = [heterogeneity(1 + 0.6 * rng.standard_normal(8) + 0.1 * rng.standard_normal(8), errors)
             for _ in range(400)]
    assert np.median([one.scatter for one in found]) == pytest.approx(0.6, rel=0.3)
    assert np.mean([one.least < 0.6 for one in found]) > 0.9


def test_the_interval_of_a_sum_holds_the_sum():
    low, high = interval_of_sum(np.array([3.0, 4.0, 5.0, 4.0]))
    assert low < 16 < high and low > 0


def test_every_effect_of_the_catalogue_says_what_would_contradict_it():
    for name in ("whill_cr_physical", "whill_cr"):
        spec, params = preset(name)
        looked_for = (*hypotheses(spec, params), *outside_hypotheses(spec, params, ()))
        assert {one.effect for one in looked_for} <= set(known())
    assert "turn_efficiency" in known() and "pose_delay" in known()
    assert all(one.by in {*SPLITS, *QUIET} for each in known().values() for one in each)
    assert (tuple(SPLITS), tuple(QUIET)) == (QUANTITIES, STATES)


def fitted(sizes, weight=(1.0, 1.0), trials=6, bins=600, prediction=None):
    """A linear fit of one base parameter and one effect whose size is another one in the second half of every trial;
    `weight` is how much each half shows of it."""
    rng = np.random.default_rng(2)
    base, effect = rng.standard_normal((2, trials, bins))
    half = np.arange(bins) >= bins // 2
    effect = effect * np.where(half, weight[1], weight[0])
    data = effect * np.where(half, sizes[1], sizes[0]) + rng.standard_normal((trials, bins))
    columns = np.stack([base, effect], axis=-1)
    q = np.linalg.lstsq(columns.reshape(-1, 2), data.reshape(-1), rcond=None)[0]
    one = Hypothesis("slope", (Axis("slope.along_x", 0.01, signed=True),))
    fit = Refit((one,), q[:1], q[1:], 0.0, data - columns @ q, columns, q)
    parts = np.stack([effect * q[1] * ~half, effect * q[1] * half], axis=-1)
    refitter = SimpleNamespace(precision=np.eye(1), reference=SimpleNamespace(u=np.zeros(1)))
    size, covariance = sizes_in_parts(fit, slice(0, 1), parts, refitter, [[2 * k, 2 * k + 1] for k in range(3)])
    law = falsification.Law("slope", prediction or SIGN, 0.003)
    return size, covariance, falsification._same(law, size, covariance, 8)


def test_an_effect_with_one_size_stands_its_split():
    size, covariance, tested = fitted((1.0, 1.0))
    assert np.abs(size - 1).max() < 4 * np.sqrt(np.diag(covariance)).max()
    assert tested.outcome == "holds" and tested.power > 0.99


def test_an_effect_that_turns_around_or_is_gone_in_one_part_is_contradicted():
    size, _, tested = fitted((1.0, -0.4))
    assert size[0] * size[1] < 0 and tested.outcome == "falsified"
    assert fitted((1.0, 0.0))[2].outcome == "falsified"


def test_an_effect_whose_law_differs_by_a_factor_of_two_is_not_contradicted():
    assert fitted((1.0, 0.5))[2].outcome == "holds"


def test_what_is_half_as_large_late_in_a_drive_is_no_effect_without_the_time_in_its_law():
    [lasting] = [one for one in EFFECTS["dry_friction"].card.forbids if one.by == "time in the drive"]
    assert fitted((1.0, 0.5), prediction=lasting)[2].outcome == "falsified"
    assert fitted((1.0, 0.9), prediction=lasting)[2].outcome == "holds"


def test_drives_that_show_an_effect_in_one_part_only_contradict_nothing():
    assert fitted((1.0, -1.0), weight=(1.0, 1e-3))[2].outcome == "untold"


@pytest.mark.parametrize(("other", "outcome"), [(0.0, "falsified"), (3.0, "holds")])
def test_what_is_left_where_an_effect_does_nothing_may_be_another_ones_form(other, outcome):
    """Twice the noise is left in bins where the effect does nothing, which gains as much as `other` others do."""
    residual = 2.0 * np.random.default_rng(3).standard_normal(1800)
    gains = 1800.0, 1800.0 * (1 + other**2)
    p_excess = lambda excess: 0.5 if excess < 0.2 else 1e-6  # noqa: E731
    law = falsification.Law("command_delay", GONE_WHEN_SETTLED, 0.003)
    tested = falsification._absent(law, residual, gains, p_excess)
    assert tested.outcome == outcome


def test_a_split_by_the_median_halves_what_counts():
    values = np.array([[0.1, 0.2, 0.3, 0.4]])
    assert side(values, np.array([[1.0, 1.0, 1.0, 1.0]])).tolist() == [[-1, -1, 1, 1]]
    assert side(values, np.array([[9.0, 1.0, 1.0, 1.0]])).tolist() == [[-1, 1, 1, 1]]


def test_the_course_of_a_drive_knows_its_steps_and_its_heading():
    command = Command(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.5, 0.2]), np.array([0.0, 0.0, 0.4]))
    told = OdometryStream(np.array([0.0, 4.0]), None, None, None, np.zeros(2), np.zeros(2))
    trial = Trial("one", "one", command, told, None, Start(yaw=np.pi))
    simulated = np.zeros((1, 16, 5))
    simulated[0, 4:, 1] = 0.4
    course = course_of([trial], simulated, 0.25, 0.5)
    assert course.heading[0, 3] == pytest.approx(np.pi)
    assert course.heading[0, -1] == pytest.approx(np.pi + 0.4 * 2.875)
    assert course.step[0, 6] == pytest.approx(0.5) and course.rising[0, 6] == 1
    assert course.asked[0, 4:].tolist() == [0.0] * 8 + [pytest.approx(0.1)] * 4
    turns = SPLITS["command to turn"](course, np.ones((1, 16)))
    assert turns[0].tolist() == [-1.0] * 12 + [1.0] * 4
    assert course.step[0, -1] == pytest.approx(np.hypot(0.3, 0.1)) and course.rising[0, -1] == -1
    assert course.since[0, -1] == pytest.approx(0.875)
    assert not QUIET["constant command"](course)[0, 5] and QUIET["constant command"](course)[0, 11]


def stood(outcome="agree", least=0.0, tested=(), interval=(10.0, 20.0)):
    agreement = SimpleNamespace(asked=np.ones(4, bool), outcome=outcome, least=least, scatter=2 * least)
    return Support("slope", np.ones(4), np.ones(4), agreement, np.ones(4), interval, tested)


@pytest.mark.parametrize(("one", "text"), [
    (stood(), None),
    (stood("differ", 0.5), None),  # another form, not another effect
    (stood("differ", 1.5), "differ on its size by 300%"),
    (stood(interval=(-30.0, -1.0)), "wrong about manoeuvres that were held back"),
    (stood(tested=(fitted((1.0, -0.4))[2],)), "changes sign with the heading, but split by heading along x"),
    (stood(tested=(fitted((1.0, 1.0))[2],)), None),
])
def test_a_contradicted_effect_is_not_named(one, text):
    hypothesis = Hypothesis("slope", ())
    found = Search("named", None, None, None, accepted=[Candidate(hypothesis, 1.0, 0.0, 0.9, None)], share=0.9)
    verdict = guarded(found, [one], Thresholds())
    assert verdict.verdict == ("named" if text is None else "unexplained")
    assert text is None or text in verdict.reason
