
"""Parts of the closed loop on hand-made residuals: agreement, hypotheses, wander, whitening."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import sysid
from sysid.errors.noise import fit_roughness, fit_whitener
from sysid.errors.space import make_space
from sysid.logs.log import load_log
from sysid.missing.catalogue import Axis, Hypothesis, base_values, hypotheses, with_catalogue
from sysid.missing.days import Wander
from sysid.missing.drives import DRAIN, SESSION, Drives
from sysid.missing.evidence import Columns, column_layout
from sysid.missing.joint_fit import Refit
from sysid.missing.refit import Refitter
from sysid.missing.signatures import signature_columns
from sysid.missing.wander import _pooled
from sysid.pages.loop_page import not_determined
from sysid.pages.loop_tables import base_table, in_range
from sysid.pages.loop_words import shifts
from sysid.pages.verdict_picture import account, draw
from sysid.verdict import null_refits, rounds
from sysid.verdict import search as search_module
from sysid.verdict.agreement import foretold
from sysid.verdict.posterior import Findings, Left, Thresholds, TriedSet, as_json, from_json, posterior, read, write
from sysid.verdict.preparation import as_shown
from sysid.verdict.rounds import Asked
from sysid.verdict.scan import imitation
from sysid.verdict.search_record import Scan
from whill_mjx.effects import about_of
from whill_mjx.effects.supply_sag import ROUND
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset


@pytest.mark.quick
def test_a_day_that_does_not_excite_an_effect_says_little_of_how_it_wanders():
    rng = np.random.default_rng(0)
    columns = [Columns(0, 1.0, (0,))]
    alike = [[(np.array([q]), np.array([[100.0]]))] for q in rng.normal(0.0, 0.3, 40)]
    usual = float(np.sqrt(_pooled(columns, alike).covariance[0][0, 0]))
    assert usual == pytest.approx(0.3, rel=0.3)
    blind = [*alike[:6], [(np.array([5.0]), np.array([[0.1]]))]]  # 5 is 1.6 times its noise
    assert np.sqrt(_pooled(columns, blind).covariance[0][0, 0]) < 2 * usual
    loud = [*alike[:6], [(np.array([5.0]), np.array([[100.0]]))]]  # here it is 50 times its noise
    assert np.sqrt(_pooled(columns, loud).covariance[0][0, 0]) > 4 * usual


@pytest.mark.quick
@pytest.mark.parametrize(("parameter", "value", "ends", "interval", "is_open", "said"), [
    ("acceleration_limit.linear", 0.6, [311592.0, 0.22], [0.22, 5.0], [False, True], " above 0.22 m/s^2"),
    ("acceleration_limit.linear", 0.6, [np.inf, 0.22], [0.22, 5.0], [False, True], " above 0.22 m/s^2"),
    ("acceleration_limit.slowing", 1.0, [-24.0, 1.3], [0.2, 1.3], [True, False], " below 1.3"),
    ("acceleration_limit.slowing", 1.0, [0.1, 9.0], [0.2, 5.0], [True, True], ""),
    ("acceleration_limit.linear", 0.6, [0.5, 0.7], [0.5, 0.7], [False, False], None),
    ("acceleration_limit.linear", 6.0, [5.5, 6.5], [5.5, 6.5], [False, False], None),
    ("acceleration_limit.linear", 6.0, [5.5, np.inf], [5.5, 6.0], [False, True], " above 5.5 m/s^2"),
])
def test_an_interval_lies_within_the_physical_range_and_says_what_is_not_determined(
        parameter, value, ends, interval, is_open, said):
    found = in_range(parameter, value, ends)
    assert found == {"interval": interval, "open": is_open}
    words = not_determined({parameter: {**found, "unit": about_of(parameter).unit}})
    assert words == ([] if said is None else [f"the drives do not determine {parameter}{said}"])


def joint_fit(sizes, trials=3, bins=400):
    """A linear fit of one base parameter and one coordinate of size 1, each manoeuvre with a size of its own."""
    rng = np.random.default_rng(1)
    columns = rng.standard_normal((trials * len(sizes), bins, 2))
    truth = np.repeat(sizes, trials)
    data = columns[..., 1] * truth[:, None] + rng.standard_normal(columns.shape[:2])
    q = np.linalg.lstsq(columns.reshape(-1, 2), data.reshape(-1), rcond=None)[0]
    residual = data - columns @ q
    groups = [range(trials * k, trials * (k + 1)) for k in range(len(sizes))]
    fit = Refit((), q[:1], q[1:], float(np.square(residual).sum()), residual, columns, q)
    gain = float(np.square(data - columns[..., 0] * q[0]).sum()) - fit.cost
    return fit, groups, gain


@pytest.mark.quick
def test_manoeuvres_agree_on_a_real_effect_and_foretell_one_another():
    fit, groups, gain = joint_fit((1.0, 1.0, 1.0, 1.0))
    told = foretold(fit, slice(0, 1), groups, np.eye(1))
    assert told.min() > 0
    assert told.sum() == pytest.approx(gain, rel=0.1)


@pytest.mark.quick
def test_manoeuvres_foretell_little_of_an_effect_that_only_one_of_them_asks_for():
    fit, groups, gain = joint_fit((4.0, 0.0, 0.0, 0.0))
    assert foretold(fit, slice(0, 1), groups, np.eye(1)).sum() < 0.3 * gain


@pytest.mark.quick
@pytest.mark.parametrize(("shared", "own", "smooth", "share"), [
    (0.0, 0.0, 0.0, 1.0),  # no more is left than days differ by
    (1.0, 0.0, 0.0, 1 / 2),  # replicates have as much in common as the effect gains
    (0.0, 1.0, 0.0, 4 / 5),  # what they do not share counts a quarter
    (0.0, 3.0, 0.0, 4 / 7),  # most of it is at random: lost messages, say
    (0.0, 0.0, 2.0, 1 / 3),  # smooth functions predict twice as much
])
def test_an_effect_is_held_against_what_it_leaves_though_it_could_be_predicted(shared, own, smooth, share):
    random, (trials, values) = np.random.default_rng(0), (8, 4000)
    one = Hypothesis("quadratic_drag", (Axis("quadratic_drag.coefficient", 1.0),))
    common = np.repeat(random.standard_normal((2, values)), trials // 2, axis=0)
    residual = random.standard_normal((trials, values)) * np.sqrt(1 + own) + np.sqrt(shared) * common
    drives = SimpleNamespace(mask=np.ones(residual.shape), repeats=np.repeat([0, 1], trials // 2))
    asked = Asked(None, (one,), SimpleNamespace(drives=drives), Wander((), (), freedom=10.0), Thresholds(),
                  SimpleNamespace(cost=float(residual.size)), None, None, lambda _: smooth * residual.size)
    left = search_module._left(asked, residual)
    findings = Findings(0.0, 0.0, None, residual.size, trials, asked.wander.excess, 10.0, 0.0)
    assert findings.share(residual.size, left, 0.25, Thresholds().alpha) == pytest.approx(share, abs=0.03)


def tried(excess, p=1e-6, effects=("quadratic_drag",), gain=1.0, bent=0.0, own=None, smooth=0.0):
    left, own = Left(excess, excess, smooth), own or (gain,) * len(effects)
    return TriedSet(effects, effects, (1.0,) * len(effects), gain, (p,) * len(effects), left, own,
                    tuple((one,) for one in own), Left(bent, bent, 0.0), tuple((name,) for name in effects))


def findings(excess, sets):
    """Of drives of which days with nothing missing differ by 1."""
    return Findings(excess, 0.0, None, 1.0, 1, 1.0, 10.0, 0.0, tuple(sets))


@pytest.mark.quick
@pytest.mark.parametrize(
    ("gain", "excess", "smooth", "verdict"),
    [
        (20.0, 0.0, 0.0, "none"),  # 10 less log 200 for the effect: nothing still weighs 1 %
        (22.0, 0.0, 0.0, "named"),  # and now 0.3 %
        (22.0, 0.0, 20.0, "unexplained"),  # as much could be predicted besides
        (20.0, 0.0, 20.0, "none"),  # what could be predicted is no sign by itself that anything is missing
        (0.0, 8.0, 0.0, "none"),  # standard deviations of a day's excess, by themselves
        (0.0, 14.0, 0.0, "unexplained"),
    ],
)
def test_nothing_is_missing_unless_nothing_has_hardly_any_weight(gain, excess, smooth, verdict):
    given = findings(excess, [tried(0.0, gain=gain, smooth=smooth)] if gain else [])
    found = posterior(given, Thresholds())
    assert found.verdict == verdict
    assert (found.weights["none"] < Thresholds().alpha) == (verdict != "none")
    assert sum(found.weights.values()) == pytest.approx(1.0)


@pytest.mark.quick
@pytest.mark.parametrize("effects", [("quadratic_drag",), ("quadratic_drag", "slope")])
def test_p_values_of_effects_decide_nothing(effects):
    small, large = (posterior(findings(0.0, [tried(0.0, p, effects, gain=60.0)]), Thresholds()) for p in (1e-6, 0.5))
    assert small == large and small.verdict == "named"


def base_fit(excess):
    """A fit without effects that leaves so much above the noise, of a single sample."""
    residual = np.full((1, 1), np.sqrt(1 + excess))
    return Refit((), np.zeros(1), np.zeros(0), 1 + excess, residual, np.zeros((1, 1, 1)), np.zeros(0))


@pytest.mark.quick
@pytest.mark.parametrize(("excess", "alarms"), [(8.0, 0), (14.0, 2)])  # standard deviations of a day's
def test_a_simulated_day_is_an_alarm_where_the_verdict_would_be_that_something_is_missing(excess, alarms, monkeypatch):
    base = base_fit(excess)
    refitter = SimpleNamespace(drives=SimpleNamespace(mask=np.ones((1, 1, 1))),
                               reference=SimpleNamespace(u=np.zeros(1), spread=np.eye(1)))
    monkeypatch.setattr(null_refits, "_days", lambda *_: [(refitter, base)] * 2)
    for name in ("at_fit", "Solver"):
        monkeypatch.setattr(null_refits, name, lambda *_: None)
    monkeypatch.setattr(null_refits, "best", lambda *_: (np.zeros(1), np.zeros(1), (np.zeros(1),)))
    monkeypatch.setattr(rounds, "refitted", lambda *_: [])
    nothing = np.zeros((100, 1))
    scan = Scan(np.zeros(1), np.zeros(1), (np.zeros(1),), nothing, np.ones(1), np.linspace(0.0, 1.0, 100))
    one = Hypothesis("quadratic_drag", (Axis("quadratic_drag.coefficient", 1.0),))
    asked = Asked(None, [one], refitter, Wander((), (), freedom=10.0, excess=1.0), Thresholds(), base, scan, None)
    nulls = null_refits.run(asked, search_module.settle, None, 2)
    assert (nulls.p == 1.0).all() and nulls.alarms == alarms


@pytest.mark.quick
def test_a_further_effect_must_do_more_than_to_mend_the_form_of_the_others():
    first, both = tried(8.0, gain=200.0, bent=8.0), ("quadratic_drag", "slope")
    for own, names in (((200.0, 90.0), 2), ((200.0, -1.0), 1)):
        given = findings(28.0, [first, tried(0.0, effects=both, gain=280.0, own=own, bent=5.0)])
        found = posterior(given, Thresholds())
        assert found.verdict == "named" and len(given.sets[found.chosen].effects) == names
        assert sum(found.weights.values()) == pytest.approx(1.0)


@pytest.mark.quick
def test_the_smaller_of_two_effects_must_be_borne_out_by_manoeuvres_and_contradicted_by_none():
    first, both = tried(8.0, gain=200.0, bent=8.0), ("quadratic_drag", "slope")
    pair = replace(tried(0.0, effects=both, gain=280.0, own=(200.0, 90.0)), bent=Left(5.0, 5.0, 0.0))
    odds = -np.log(Thresholds().alpha)
    for raised, names in ((((30.0,), (9.0,)), 2), (((-3.0,), (9.0,)), 2), (((30.0,), (-1.0,)), 1),
                          (((30.0,), (50.0, 0.1 - odds)), 2), (((30.0,), (50.0, -0.1 - odds)), 1)):
        given = findings(28.0, [first, replace(pair, foretold=raised)])
        assert len(given.sets[posterior(given, Thresholds()).chosen].effects) == names


@pytest.mark.quick
def test_the_smaller_of_two_effects_is_not_named_where_it_may_as_well_be_absent():
    first, both = tried(8.0, gain=200.0, bent=8.0), ("quadratic_drag", "slope")
    pair = replace(tried(0.0, effects=both, gain=280.0, own=(200.0, 90.0)), bent=Left(5.0, 5.0, 0.0))
    for surely, names in (((3.0, 0.9), 1), ((3.0, 1.1), 2), ((0.9, 1.1), 2)):
        given = findings(28.0, [first, replace(pair, surely=surely)])
        assert len(given.sets[posterior(given, Thresholds()).chosen].effects) == names


@pytest.mark.quick
def test_evidence_of_an_earlier_number_is_judged_as_it_was():
    first, both = tried(8.0, gain=200.0, bent=8.0), ("quadratic_drag", "slope")
    for end, names in ((9.0, 2), (-1.0, 1)):  # of the 95 % interval, which such a file has of each effect
        pair = replace(tried(0.0, effects=both, gain=280.0, own=(200.0, 90.0)), bent=Left(5.0, 5.0, 0.0))
        content = json.loads(json.dumps(as_json(findings(28.0, [first, pair]))))
        ends = ([30.0], [30.0, end])
        earlier = [{**one, "foretold": of_both} for one, of_both in zip(content["sets"], ends, strict=True)]
        given = from_json({**content, "schema": 1, "sets": earlier})
        assert len(given.sets[posterior(given, Thresholds()).chosen].effects) == names


@pytest.mark.quick
def test_a_set_that_was_refitted_in_both_orders_keeps_its_weight_together():
    pairs = [("quadratic_drag", "slope"), ("slope", "quadratic_drag")]
    given = findings(28.0, [tried(0.0, effects=effects, gain=280.0, own=(200.0, 90.0)) for effects in pairs])
    (weight,) = [weight for name, weight in posterior(given, Thresholds()).weights.items() if "slope" in name]
    assert weight > 0.9
    assert [one["weight"] for one in account(given, Thresholds())["explanations"] if "slope" in one["name"]] == [weight]


@pytest.mark.quick
def test_a_further_effect_must_gain_more_than_days_differ_by():
    for gain, chosen in ((28.0, 0), (38.0, 1)):
        given = findings(28.0, [tried(5.0, gain=23.0), tried(0.0, effects=("quadratic_drag", "slope"), gain=gain)])
        assert posterior(given, Thresholds()).chosen == chosen


@pytest.mark.quick
def test_the_picture_of_a_verdict_says_of_each_explanation_why_it_is_the_verdict_or_not():
    effects = ("quadratic_drag", "slope")
    given = replace(findings(28.0, [tried(8.0, gain=200.0), tried(0.0, effects=effects, gain=280.0, own=(200.0, -1.0)),
                                    tried(20.0, effects=("wind",), gain=80.0)]), noise=("odometry.v",))
    shown = account(given, Thresholds())
    assert {one["name"]: one["outcome"] for one in shown["explanations"]} == {
        "quadratic drag": "named", "quadratic drag and slope": "is wrong about other manoeuvres",
        "wind": "explains less", "nothing but other noise": "", "something unknown": ""}
    assert "two effects stand out" not in shown["looks"]  # pairs were not scanned
    assert "3. Verdict: named, quadratic drag" in draw(shown)
    nothing = account(findings(0.1, []), Thresholds())
    assert [one["name"] for one in nothing["explanations"]] == ["nothing", "something unknown"]
    assert "Verdict: none" in draw(nothing)


@pytest.mark.quick
@pytest.mark.parametrize(("content", "wrong"), [("{}", "kind None"), ("[]", "a JSON object"), ("{", "not valid JSON")])
def test_a_file_without_findings_is_refused_in_one_line(content, wrong, tmp_path):
    (tmp_path / "evidence.json").write_text(content)
    with pytest.raises(ValueError, match=wrong) as refused:
        read(tmp_path / "evidence.json")
    assert "\n" not in str(refused.value)


@pytest.mark.quick
@pytest.mark.parametrize(("name", "value"), [("day", "x"), ("day", 0), ("count", float("nan")), ("excess", True)])
def test_findings_of_other_values_are_refused_by_name(name, value, tmp_path):
    path = tmp_path / "evidence.json"
    write(path, findings(9.0, [tried(0.0, gain=9.0)]))
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(ValueError, match=f"evidence.json: {name} (=|is) "):
        read(path)


@pytest.mark.quick
@pytest.mark.parametrize(("excess", "p", "verdict", "largest"), [
    (99.0, 1e-9, "unexplained", "unknown"), (0.0, 0.5, "none", "none")])
def test_where_no_effect_was_refitted_the_weights_agree_with_the_verdict(excess, p, verdict, largest):
    found = posterior(replace(findings(excess, []), p_scan=p), Thresholds())
    assert found.verdict == verdict and max(found.weights, key=found.weights.get) == largest
    assert sum(found.weights.values()) == pytest.approx(1.0)


@pytest.mark.quick
def test_saved_findings_give_the_same_verdict(tmp_path):
    given = replace(findings(29.0, [tried(0.0, gain=29.0)]), against={"quadratic_drag": ["it grows with the time"]})
    write(tmp_path / "evidence.json", given)
    assert read(tmp_path / "evidence.json") == given
    found = posterior(read(tmp_path / "evidence.json"), Thresholds())
    assert found.verdict == "unexplained" and found.reason.endswith("but it grows with the time")


@pytest.mark.quick
@pytest.mark.parametrize(("gain", "verdict"), [(29.0, "named"), (15.0, "unexplained")])
def test_what_is_contradicted_makes_room_for_the_next_that_explains_enough(gain, verdict):
    sets = [tried(0.0, gain=40.0), tried(0.0, effects=("slope",), gain=gain)]
    assert posterior(findings(39.0, sets), Thresholds()).chosen == 0
    found = posterior(findings(39.0, sets).put_to_test(["quadratic_drag"], ["it grows with the time"]), Thresholds())
    assert found.verdict == verdict and found.chosen == (1 if verdict == "named" else 0)
    assert found.reason.endswith("but it grows with the time") and found.weights.get("quadratic_drag", 0.0) == 0.0
    both = findings(39.0, sets).put_to_test(["quadratic_drag"], ["x"]).put_to_test(["slope"], ["y"])
    assert posterior(both, Thresholds()).verdict == "unexplained"


@pytest.mark.quick
def test_a_pair_is_contradicted_in_whichever_order_its_effects_are_given():
    pair = tried(0.0, effects=("slope", "wind"), gain=40.0)
    given = findings(39.0, [pair]).put_to_test(["wind", "slope"], ["it is not foretold"])
    assert given.contradictions(pair) == ["it is not foretold"]


@pytest.mark.quick
def test_every_hypothesis_vanishes_at_zero():
    spec, params = preset("whill_cr_physical")
    found = hypotheses(spec, params)
    full = with_catalogue(params, found)
    base = base_values(full)
    for one in found:
        values = one.values(np.zeros(len(one.axes)), base)
        for axis in one.axes:
            if axis.form != "moment":
                assert values[axis.parameter] == base[axis.parameter], one.key


@pytest.mark.quick
def test_keys_are_unique():
    spec, params = preset("whill_cr_physical")
    keys = [one.key for one in hypotheses(spec, params)]
    assert len(keys) == len(set(keys))


@pytest.mark.quick
def test_what_only_acts_through_another_axis_has_a_column_of_that_alone():
    """The motion is a (1 + b): at a = 2, b = 2 the second axis adds a, and nothing of what a does by itself."""
    one = Hypothesis("some", (Axis("some.a", 1.0), Axis("some.b", 1.0, dependent=True)))

    def simulate(sets):
        return (sets[:, 0] * (1 + sets[:, 1]))[:, None, None, None]

    columns = signature_columns(SimpleNamespace(simulate=simulate), [one], np.zeros(2), ["some.a", "some.b"],
                                np.zeros((1, 1, 1)))
    [at] = [columns[0, 0, 0, list(each.index)] for each in column_layout([one], 0) if each.level == 2.0]
    np.testing.assert_allclose(at, [1.0, 2.0])


@pytest.mark.quick
def test_a_form_that_an_effect_may_take_does_not_hide_what_it_looks_like():
    """Two effects change the motion alike; one of them may also do something that the other cannot."""
    plain = Hypothesis("plain", (Axis("plain.a", 1.0),))
    formed = Hypothesis("formed", (Axis("formed.a", 1.0), Axis("formed.b", 1.0, dependent=True)))
    motion = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 3.0]])  # (n, columns)
    evidence = SimpleNamespace(base_size=0, products=(motion.T @ motion)[None], precision=np.zeros((0, 0)),
                               columns=(Columns(0, 2.0, (0,)), Columns(1, 2.0, (1, 2))))
    np.testing.assert_allclose(imitation(evidence, (plain, formed)), 1.0)


@pytest.mark.quick
def test_two_effects_that_move_one_parameter_add_up():
    scrub = Hypothesis("scrub", (Axis("scrub.torque", 2.0), Axis("track.error", 0.01, form="along", dependent=True)))
    track = Hypothesis("track", (Axis("track.error", 0.1, signed=True),))
    space = SimpleNamespace(to_values=lambda u: u)
    refitter = SimpleNamespace(values=np.array([1.0, 0.5]), base_index=[], names=["scrub.torque", "track.error"],
                               reference=SimpleNamespace(space=space))
    both = Refitter.values_at(refitter, (track, scrub), np.zeros(0), np.array([1.0, 3.0, 2.0]))
    np.testing.assert_allclose(both, [1.0 + 2 * 3, 0.5 + 0.1 + 0.01 * 3 * 2])


@pytest.mark.quick
def test_replicates_are_driven_round_by_round_of_a_session():
    """Only where the supply drains does it matter when a drive began; where nothing says it, the time is kept."""
    drives = SimpleNamespace(names=(DRAIN, SESSION), began=np.array([0.5 * ROUND, 2.5 * ROUND, np.nan]))
    drained, fresh = (Drives._in_session(drives, np.array([[drain, 7.0]] * 3), np.arange(3)) for drain in (1e-3, 0.0))
    np.testing.assert_allclose(drained[:, 1], [0.5 * ROUND, 2.5 * ROUND, 7.0])
    np.testing.assert_allclose(fresh[:, 1], 7.0)


@pytest.mark.quick
def test_whitener_makes_autocorrelated_noise_white():
    random = np.random.default_rng(0)
    noise = np.zeros((40, 200, 2))
    for k in range(1, 200):
        noise[:, k] = 0.9 * noise[:, k - 1] + random.standard_normal((40, 2)) @ np.array([[1.0, 0.5], [0.0, 0.2]])
    mask = np.ones_like(noise)
    white = fit_whitener(noise, mask).apply(noise, mask)[:, 20:]
    assert abs(white.std() - 1) < 0.05
    assert abs(np.mean(white[:, 1:, 0] * white[:, :-1, 0])) < 0.03
    assert abs(np.mean(white[..., 0] * white[..., 1])) < 0.03


@pytest.mark.quick
def test_a_channel_that_was_not_measured_is_no_rougher():
    series = np.random.default_rng(0).standard_normal((3, 100, 2))
    mask = np.ones_like(series)
    mask[..., 1] = 0
    level = np.repeat([[0] * 50 + [3] * 50], 3, axis=0)
    factors = fit_roughness(series * np.where(level == 3, 4.0, 1.0)[..., None] * mask, mask, level)
    assert np.allclose(factors[:, 1], 1.0)
    assert 3 < factors[3, 0] < 5 and factors[0, 0] == 1


@pytest.mark.quick
@pytest.mark.parametrize("named", [False, True])
def test_base_parameters_that_the_drives_do_not_determine_went_nowhere(monkeypatch, named):
    """A fit to whole poses is free in them: of what no outside pose shows, say, it makes anything."""
    spec, params = preset("whill_cr_physical")
    names = ("body.com_x", "torque_drive.kp", "torque_drive.ki", "slip_traction.mu")
    space = make_space(params, spec, names)
    u, spread = space.to_unit(space.initial), np.full(4, 0.01)
    columns = np.zeros((2, 3, 6))
    columns[0, 0, 0] = columns[0, 1, 1] = columns[0, 1, 2] = columns[0, 2, 3] = columns[0, 2, 4] = 1e4
    columns[1, 0, 5] = 1.0
    fits = {"final": Refit((), u, np.zeros(2), 0.0, np.zeros((2, 3)), columns, u),
            "base": Refit((), u, np.zeros(0), 0.0, np.zeros((2, 3)), columns[..., :4], u)}
    result = SimpleNamespace(
        reference=SimpleNamespace(space=space, spread=np.diag(spread**2), u=u, params=params),
        evidence=SimpleNamespace(precision=np.diag(spread**-2.0)),
        search=SimpleNamespace(verdict="named" if named else "none", **fits))
    away = np.array([0.05, 0.05, -0.05, 0.05])  # the second and third as one, and the fourth as an effect does
    moved = set_values(params, names, space.to_values(u + away))
    monkeypatch.setattr("sysid.pages.loop_tables.fitted_before", lambda _: moved)
    monkeypatch.setattr("sysid.pages.loop_tables.fitted_after", lambda _: moved)
    found = [row["away"] for row in base_table(result)]
    np.testing.assert_allclose(found, [5.0, 0.0, 0.0, 0.0 if named else 5.0], atol=0.05)
    columns[...] = 0.0  # as of a channel that is left out
    np.testing.assert_allclose([row["away"] for row in base_table(result)], 0.0, atol=1e-9)
    assert shifts(base_table(result)) == []


@dataclass(frozen=True)
class Known:
    """Of a `Reference`, what `as_shown` looks at; and of a `Prepared`."""

    leftovers: tuple = ()
    remark: str = "one day"
    reference: object = None


@pytest.mark.parametrize(("columns", "channel", "said"), [
    ((0, 1), "ground_truth", "no reference drive has outside pose"),
    ((2, 3, 4), "odometry", "no reference drive has odometry"), (range(5), "", ""),
])
def test_what_no_reference_drive_measured_is_left_out_of_the_drives_in_question(columns, channel, said):
    """A channel without noise of its own would be taken for exact, and its least error for a missing effect."""
    mask = np.zeros((9, 5))
    mask[3:, list(columns)] = 1.0
    ready = Known(reference=Known((SimpleNamespace(mask=np.zeros((7, 5))), SimpleNamespace(mask=mask))))
    log = load_log(Path(sysid.__file__).parent / "data" / "chair")
    kept, later = as_shown(log, ready)
    assert all((getattr(trial, channel) is None) == (not trial.held_out) for trial in kept.trials) if channel else (
        kept is log)
    assert len(kept.trials) == len(log.trials) and said in later.reference.remark
    if channel:
        other = {"odometry": "ground_truth", "ground_truth": "odometry"}[channel]
        first, *rest = log.trials
        alone = replace(log, trials=(replace(first, **{other: None}), *rest))
        assert len(as_shown(alone, ready)[0].trials) == len(log.trials) - 1
        with pytest.raises(ValueError, match="alone, which no reference drive has"):
            as_shown(replace(log, trials=alone.trials[:1]), ready)
