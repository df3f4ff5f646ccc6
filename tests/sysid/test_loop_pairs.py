"""Two effects that hide one another, and what a set of drives can show, on evidence that is linear by construction."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from linear_drives import EFFECTS, SPREAD, Linear, drives

from sysid.follow_up.power import SEED, Days, false_alarms, power_curve
from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.days import no_wander
from sysid.missing.evidence import Solver, column_layout
from sysid.missing.joint_fit import Refit, moved_last
from sysid.pages.loop_tables import detectable
from sysid.verdict import rounds
from sysid.verdict.posterior import Thresholds
from sysid.verdict.result import LoopConfig
from sysid.verdict.rounds import begin
from sysid.verdict.scan import CHI_SQUARED, best, null_days, run, scan_again, scan_pairs
from sysid.verdict.search import pairs_of as pairs_of_effects
from sysid.verdict.search import settle
from sysid.verdict.search_record import tail

pytestmark = pytest.mark.quick
def pairs_of(evidence, wander, similar=np.eye(4), draws=200):  # noqa: B008
    nulls = null_days(evidence, SPREAD, wander, draws, np.random.default_rng((0, 2)))
    return scan_pairs(evidence, EFFECTS, wander, nulls, similar, 0.9)


def simulated_days(evidence, wander, scan, seed=0):
    nulls = null_days(evidence, SPREAD, wander, 400, np.random.default_rng((seed, SEED)))
    return Days(evidence, EFFECTS, wander, scan, nulls)


@pytest.fixture(scope="module")
def wander():
    return no_wander(column_layout(EFFECTS, 1))


def test_two_effects_that_hide_one_another_are_found_together(wander):
    evidence = drives((1.0, -1.0, 0.0, 0.0), close=0.97)
    alone, pairs = run(evidence, EFFECTS, SPREAD, wander, 200), pairs_of(evidence, wander)
    best = int(np.argmax(pairs.gain))
    assert pairs.members[best] == (0, 1)
    assert pairs.gain[best] > 2 * alone.gain.max()
    assert pairs.p_family < 0.01 and pairs.p_family < alone.p_family
    assert pairs.q[best] == pytest.approx([1.0, -1.0], abs=0.4)


def test_what_acts_only_through_another_axis_is_found_beside_the_size_that_it_was_simulated_at():
    """A limit of the speed that is not reached, but falls with the load: at 0 of the limit nothing would fall."""
    limit = Hypothesis("limit", (Axis("limit.speed", 10.0, form="inverse"), Axis("limit.droop", 1.0, dependent=True)))
    columns, plain = column_layout((limit, EFFECTS[2]), 1), drives(np.zeros(4))
    design = np.random.default_rng(1).standard_normal((*plain.residual.shape, 12))
    design[..., [one.index[0] for one in columns[:-1]]] = 0.0
    [through] = [one.index[1] for one in columns[:-1] if one.level == 2.0]
    residual = plain.residual + 0.7 * design[..., through] + 0.5 * design[..., -1]
    evidence = replace(
        plain, residual=residual, design=design, columns=columns, products=np.einsum("bni,bnj->bij", design, design),
        moments=np.einsum("bni,bn->bi", design, residual), pool_moments=tuple(np.zeros((2, 12)) for _ in residual))
    wander = no_wander(columns)
    assert best(Solver(evidence), (limit, EFFECTS[2]), wander)[2][0] == pytest.approx([2.0, 0.7], abs=0.15)
    nulls = null_days(evidence, SPREAD, wander, 20, np.random.default_rng(0))
    [both] = scan_pairs(evidence, (limit, EFFECTS[2]), wander, nulls, np.eye(2), 0.9).q
    assert both == pytest.approx([2.0, 0.7, 0.5], abs=0.15)


def test_other_drives_are_held_against_the_nulls_of_a_scan_made_before(wander):
    first = pairs_of(drives(np.zeros(4), close=0.97), wander)
    hidden = drives((1.0, -1.0, 0.0, 0.0), close=0.97)
    again, afresh = scan_again(first, hidden, EFFECTS, wander), pairs_of(hidden, wander)
    np.testing.assert_allclose(again.gain, afresh.gain)
    np.testing.assert_allclose(again.worth, afresh.worth)
    assert again.p_family < 0.01 < first.p_family
    same = scan_again(first, drives(np.zeros(4), close=0.97), EFFECTS, wander)
    np.testing.assert_allclose(same.p, first.p)


def test_pairs_of_nothing_have_no_small_p_values(wander):
    p = [pairs_of(drives(np.zeros(4), seed=seed), wander).p_family for seed in range(10)]
    assert min(p) > 0.005 and np.mean(np.array(p) < 0.2) < 0.5


def verdict(evidence, wander):
    asked = begin(evidence, SimpleNamespace(hypotheses=EFFECTS, wander=wander), Linear(evidence), LoopConfig(draws=300))
    return settle(asked, pairs_of_effects(asked))


def named(found):
    return found.verdict, {one.hypothesis.effect for one in found.accepted}


def test_a_hidden_pair_is_named_and_a_single_effect_stays_one(wander):
    pair = verdict(drives((0.6, -0.6, 0.0, 0.0), close=0.88), wander)
    assert named(pair) == ("named", {"slope", "track_width"})
    assert pair.scan.p_family > Thresholds.alpha > pair.p_value and pair.share > 0.7
    assert named(verdict(drives((0.0, 0.0, 1.0, 0.0)), wander)) == ("named", {"side_force"})
    assert named(verdict(drives(np.zeros(4)), wander)) == ("none", set())


def test_what_resembles_two_effects_together_gives_way_to_them(wander):
    """`command_scale` here changes the motion nearly as slope and track width together do."""
    evidence, sizes = drives(np.zeros(4), close=0.0), np.array([0.0, 1.0, 1.0, 0.0, 0.0])
    design = evidence.design.copy()
    design[..., 4] = 0.9 * (design[..., 1] + design[..., 2]) / np.sqrt(2) + 0.43 * design[..., 4]
    evidence = replace(evidence, residual=evidence.residual + design @ sizes, design=design,
                       products=np.einsum("bni,bnj->bij", design, design),
                       moments=np.einsum("bni,bn->bi", design, evidence.residual + design @ sizes))
    found = verdict(evidence, wander)
    assert found.rounds[0][0].hypothesis.effect == "command_scale"
    assert named(found) == ("named", {"slope", "track_width"})


def test_what_the_drives_do_not_separate_from_an_effect_shows_beside_the_other_one(wander, monkeypatch):
    """The first round tries too few effects to see that `track_width` fits nearly as well as slope."""
    evidence = drives((1.0, 0.0, 0.8, 0.0), close=0.93)
    evidence = replace(evidence, residual=evidence.residual + np.sin(np.arange(120) / 5))  # something unknown is left
    evidence = replace(evidence, moments=np.einsum("bni,bn->bi", evidence.design, evidence.residual))
    asked = replace(begin(evidence, SimpleNamespace(hypotheses=EFFECTS, wander=wander), Linear(evidence),
                          LoopConfig(draws=300)), similar=np.eye(4))  # their signatures where both are small differ
    starts = rounds._starts
    monkeypatch.setattr(rounds, "_starts", lambda *given: starts(*given)[: None if len(given[3]) < len(EFFECTS) else 1])
    found = settle(asked, pairs_of_effects(asked))
    assert {one.hypothesis.effect for one in found.accepted} == {"slope", "side_force"}
    assert next(members for members in found.classes if members[0] == "slope") == ["slope", "track_width"]


def test_an_effect_that_looks_different_beside_another_one_is_found(wander):
    """The scan holds columns against the drives that effects have beside the base; beside slope, `side_force` has
    another one."""
    evidence = drives((1.0, 0.0, 0.8, 0.0))
    design = evidence.design.copy()
    design[..., 3] = np.random.default_rng(5).standard_normal(design.shape[:2])
    before = replace(evidence, design=design, products=np.einsum("bni,bnj->bij", design, design),
                     moments=np.einsum("bni,bn->bi", design, evidence.residual))
    asked = begin(before, SimpleNamespace(hypotheses=EFFECTS, wander=wander), Linear(evidence), LoopConfig(draws=300))
    assert named(settle(asked, pairs_of_effects(asked))) == ("named", {"slope", "side_force"})


def test_one_class_is_no_pair(wander):
    alike = np.eye(4)
    alike[1, 0] = 0.95
    found = pairs_of(drives(np.zeros(4)), wander, alike, 50)
    assert (0, 1) not in found.members and len(found.members) == 5


def test_effects_that_wander_from_day_to_day_are_worth_less_together():
    evidence, layout = drives((1.0, -1.0, 0.0, 0.0), close=0.97), column_layout(EFFECTS, 1)
    still, moving = (pairs_of(evidence, no_wander(layout, size)) for size in (0.0, 0.5))
    assert moving.worth.max() < 0.5 * still.worth.max()


def test_a_tail_of_zeros_is_no_steeper_than_that_of_chi_squared():
    null = np.concatenate([np.zeros(195), [1.0, 2.0, 3.0, 1.0, 2.0]])
    assert tail(null, 4.0, CHI_SQUARED) > 0.01
    assert tail(null, 0.0, CHI_SQUARED) == 1.0


def test_the_other_effect_of_a_pair_may_come_last():
    rng, (first, second) = np.random.default_rng(0), EFFECTS[:2]
    columns = rng.standard_normal((2, 5, 3))
    fit = Refit((first, second), np.zeros(1), np.array([1.0, 2.0]), 1.0, np.zeros((2, 5)), columns, np.zeros(3))
    turned = moved_last(fit, 0)
    assert turned.hypotheses == (second, first) and turned.q.tolist() == [2.0, 1.0]
    assert np.array_equal(turned.jacobian[..., 1:] @ turned.q, columns[..., 1:] @ fit.q)


def test_simulated_days_raise_few_alarms_and_show_what_should_be_noticed(wander):
    evidence = drives(np.zeros(4))
    scan = run(evidence, EFFECTS, SPREAD, wander, 1000)
    days = simulated_days(evidence, wander, scan)
    alarms = false_alarms(days, 0.01)
    assert alarms["alarms"] <= 12 and alarms["upper"] >= alarms["rate"]
    curve = [one["noticed"] for one in power_curve(days, 2, np.array([0.3]), 0.01)]
    assert curve == sorted(curve) and curve[0] < 0.5 < curve[2]


def test_the_smallest_detectable_size_is_noticed_in_four_days_of_five(wander, monkeypatch):
    evidence = drives(np.zeros(4))
    scan = run(evidence, EFFECTS, SPREAD, wander, 1000)
    days = simulated_days(evidence, wander, scan)
    monkeypatch.setattr("sysid.pages.loop_tables.base_values", lambda _: dict.fromkeys(
        (one.axes[0].parameter for one in EFFECTS), 0.0))
    result = SimpleNamespace(search=SimpleNamespace(scan=scan, findings=None), evidence=evidence, hypotheses=EFFECTS,
                             full=None, prepared=SimpleNamespace(wander=wander),
                             config=SimpleNamespace(thresholds=SimpleNamespace(alpha=0.01)))
    rows = detectable(result, days)
    assert [row["effect"] for row in rows] == [one.effect for one in EFFECTS]
    assert all(0.8 <= row["power"] < 0.85 for row in rows)
    again = simulated_days(evidence, wander, scan, seed=1)
    there = [(one, np.array([row["value"] / EFFECTS[one.hypothesis].axes[0].unit])) for one, row in
             zip(evidence.columns, rows, strict=True)]
    assert again.noticed(0.01, there) == pytest.approx([0.8] * 4, abs=0.1)
