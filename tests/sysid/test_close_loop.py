"""The closed loop on drives with known contents: named, none, the effect in the file, held-out trials closed."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.planted_logs import Schedule, write_dataset
from sysid.close_loop import Arguments, main
from sysid.errors.features import CHANNELS, make_features
from sysid.errors.noise import deviations, replicate_groups
from sysid.fit import Arguments as FitArguments
from sysid.fit import main as fit_main
from sysid.follow_up.trust import advice, as_good_as_repeats, beside_still_base, warnings
from sysid.follow_up.unnamed import vehicle_of, with_start_angles
from sysid.follow_up.wrench_tables import WrenchTable
from sysid.logs.log import load_log
from sysid.logs.metrics import own_floor, score
from sysid.missing.catalogue import base_values
from sysid.missing.drives import make_drives
from sysid.missing.refit import without_each
from sysid.pages.loop_report import effects, make_report, manifest, write_run
from sysid.pages.loop_tables import replay
from sysid.pages.loop_words import shifts
from sysid.replay.models import with_effects
from sysid.replay.records import Measured
from sysid.replay.rollout import vehicle_plant
from sysid.verdict.falsification import course_of, put_to_test
from sysid.verdict.null_refits import checked
from sysid.verdict.null_refits import run as run_null_refits
from sysid.verdict.pipeline import check_logs, find_missing, guarded
from sysid.verdict.posterior import Findings, posterior, read
from sysid.verdict.preparation import expected_steps
from sysid.verdict.result import LoopConfig
from sysid.verdict.rounds import Asked
from sysid.verdict.search import settle
from sysid.verdict.search_record import NullRefits
from sysid.verdict.vehicles import (
    drives_of,
    fitted_alone,
    fitted_before,
    refit_poses,
    refitter_of,
    vehicle_after,
    vehicle_before,
)
from whill_mjx.effects import make_effect
from whill_mjx.effects.card import Falsifier
from whill_mjx.effects.unnamed import KNOTS
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import describe, set_values
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle

DRIVES = ("straight", "circle", "s_curve")
CONFIG = LoopConfig(quick=True, physics_dt=0.01, iterations=6, draws=200, poses=False)


def day(seed):
    """The chair on one day: gains and friction a few percent off."""
    spec, params = preset("whill_cr_physical")
    random = np.random.default_rng(seed)
    names = ["torque_drive.kp", "torque_drive.limit", "rolling_resistance.mu_r"]
    base = base_values(params)
    return spec, set_values(params, names, np.array([base[n] * (1 + 0.02 * random.standard_normal()) for n in names]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("drives")


@pytest.fixture(scope="module")
def drives(folder):
    """Two reference days, a day with nothing, and one on a slope."""
    scenario = Scenario(length=4.0)
    logs = {}
    for number, name in enumerate(("reference_1", "reference_2", "plain", "sloping")):
        spec, params = day(number)
        if name == "sloping":
            params = VehicleParams(params.body, (*params.effects, make_effect("slope", along_x=0.03)))
        write_dataset(folder / name, spec, params,
                      Schedule(manoeuvres=(*DRIVES, "figure_eight"), replicates=3, scenario=scenario, seed=number),
                      plant=vehicle_plant(spec, VehicleConfig(physics_dt=0.01)))
        logs[name] = load_log(folder / name)
    return logs


@pytest.fixture(scope="module")
def stages():
    """What the progress bar was told: steps and stage."""
    return []


@pytest.fixture(scope="module")
def sloping(drives, stages):
    return find_missing(drives["sloping"], (drives["reference_1"], drives["reference_2"]), CONFIG,
                      progress=lambda steps, stage: stages.append((steps, stage)))


@pytest.fixture(scope="module")
def report(sloping):
    return make_report(sloping)


def test_names_the_slope_and_its_size(sloping):
    assert sloping.search.verdict == "named"
    one = sloping.search.accepted[0]
    assert one.hypothesis.effect in ("slope", "wind")  # a constant pull in the room: no drive on one floor splits them
    assert "slope" in sloping.search.classes[0]


def test_the_progress_bar_tells_the_stage_and_does_not_run_over(sloping, stages):
    seen = [stage.split(",")[0] for _, stage in stages]
    order = ["base fit", "signatures", "base refit", "scan", "scan of pairs", "refits"]
    assert [seen.index(one) for one in order] == sorted(seen.index(one) for one in order)
    assert sum(steps for steps, _ in stages) <= expected_steps(CONFIG, 2)


def test_a_fit_may_close_the_loop_with_the_same_references(folder, drives, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("sysid.fit.fit_dataset", lambda *_, **__: {
        "prior": None, "dataset": {"notes": []}, "summary": {"held_out": {}}})
    monkeypatch.setattr("sysid.fit.parameter_table", lambda _: "")
    monkeypatch.setattr("sysid.fit.table", lambda _: "")
    monkeypatch.setattr("sysid.verdict.pipeline.watched", lambda *given: given)
    monkeypatch.setattr("sysid.pages.loop_report.write_result", lambda *given: asked.append(given))
    fit_main(FitArguments(dataset=folder / "sloping", out=tmp_path, close_loop=True, reference=(folder / "plain",)))
    [(out, (log, references, config, vehicle))] = asked
    assert (log.name, [one.name for one in references], out) == ("sloping", ["plain"], tmp_path / "close_loop")
    assert (config.seed, config.with_effects, vehicle) == (0, (), None)
    spec, params = day(0)
    file = save_vehicle(tmp_path / "old.toml", replace(spec, wheelbase=0.7), params)
    fit_main(FitArguments(dataset=folder / "sloping", out=tmp_path / "again", close_loop=True, vehicle=file,
                          effects=("incline",)))
    log, _, config, vehicle = asked[1][1]
    assert config.with_effects == ("incline",) and log.spec.wheelbase == 0.7
    assert describe(vehicle.params).keys() == describe(params).keys()


def test_a_drive_counts_once_whatever_its_name_and_whichever_folder_it_lies_in(drives):
    log, one, other = (drives[name] for name in ("plain", "reference_1", "reference_2"))
    check_logs(log, (one, other))
    with pytest.raises(ValueError, match="among the drives in question already"):
        check_logs(log, (one, replace(other, sha256="other", trials=(*other.trials, replace(log.trials[0], name="x")))))
    with pytest.raises(ValueError, match="among those of reference 1"):
        check_logs(log, (one, replace(one, name="copy", sha256="other")))


def test_finds_nothing_where_nothing_is(drives, sloping):
    result = find_missing(drives["plain"], (), CONFIG, reference=sloping.reference)
    assert result.search.verdict == "none"


def noisier(log, yaw_rate):
    """A log with more white noise on the reported yaw rate [rad/s]."""
    random = np.random.default_rng(5)
    trials = [replace(one, odometry=replace(one.odometry, omega=one.odometry.omega + yaw_rate * random.standard_normal(
        len(one.odometry.t)))) for one in log.trials]
    return replace(log, trials=tuple(trials))


def test_a_noisier_sensor_is_no_missing_effect_and_hides_none(drives, sloping):
    result = find_missing(noisier(drives["plain"], 0.04), (), CONFIG, reference=sloping.prepared)
    changed = {name for name, one in result.noise.report().items() if one["changed"]}
    assert (result.search.verdict, changed) == ("none", {"odometry.omega"})
    low, high = result.noise.interval(1)
    assert low < 17**0.5 < high  # beside the 0.01 rad/s of the reference days
    result = find_missing(noisier(drives["sloping"], 0.04), (), CONFIG, reference=sloping.prepared)
    assert result.search.verdict == "named"
    assert "slope" in result.search.classes[0]


def test_an_effect_that_is_not_looked_for_is_not_named_but_missed(drives, sloping):
    config = replace(CONFIG, without=("slope", "wind"))
    result = find_missing(drives["sloping"], (), config, reference=sloping.prepared)
    assert result.search.verdict != "none"
    assert not {"slope", "wind"} & {one.hypothesis.effect for one in result.search.accepted}
    with pytest.raises(ValueError, match="there is no effect 'slop' .known: "):
        sloping.prepared.without(("slop",))


@pytest.mark.long
def test_simulated_days_are_refitted_and_take_back_what_they_show_too(drives, sloping):
    result = find_missing(drives["sloping"], (), replace(CONFIG, refit_nulls=4), reference=sloping.prepared)
    assert result.search.verdict == "named"
    nulls = result.null_refits
    assert nulls.alarms == 0 and np.all(nulls.p > 1e-3)  # with nothing in them they look nothing like the slope
    assert nulls.p_of(result.search.p_value) == 1 / 5
    assert make_report(result)["missing"]["null_refits"]["count"] == 4
    often = NullRefits(np.zeros(200), 150)  # had such drives always shown as much
    weak = replace(result.search, excess=(0.0, 0.0))
    assert checked(weak, often, result.prepared.wander, CONFIG.thresholds).verdict == "none"
    assert not weak.accepted


def asked_of(result):
    return Asked(result.evidence, result.hypotheses, refitter_of(result), result.prepared.wander, CONFIG.thresholds,
                 result.search.base, result.search.scan, np.eye(len(result.hypotheses)))


def test_simulated_days_come_out_alike_replayed_together_or_one_by_one(sloping, monkeypatch):
    def days():
        return run_null_refits(asked_of(sloping), settle, None, 3).p

    together = days()
    monkeypatch.setattr("sysid.verdict.null_refits.TOGETHER", 1)
    np.testing.assert_allclose(days(), together, rtol=1e-6)


@pytest.mark.parametrize("accepted", [True, False])
def test_a_simulated_day_that_two_effects_explain_together_is_a_false_alarm(sloping, monkeypatch, accepted):
    def rounds(*_):
        return [([sloping.search.accepted[0]], 1e-4)] if accepted else []

    monkeypatch.setattr("sysid.verdict.null_refits.scan_again", lambda first, *_: replace(first, p=np.zeros(1)))
    monkeypatch.setattr("sysid.verdict.search.pair_round", rounds)
    monkeypatch.setattr(Findings, "able", lambda *_: True)
    monkeypatch.setattr(Findings, "log_weight", lambda *_: 9.0)
    nulls = run_null_refits(asked_of(sloping), settle, sloping.search.pairs, 2)
    assert nulls.alarms == (2 if accepted else 0)
    assert (nulls.p == 1e-4).all() == accepted


def test_the_noise_floor_is_that_of_the_same_manoeuvres(sloping):
    """A single held-out drive has its replicates among the training trials."""
    trials = (*sloping.log.training, *sloping.log.held_out)
    single = next(t for t in sloping.log.training if t.manoeuvre == "circle")
    kept = tuple(replace(t, held_out=True) if t is single else t for t in sloping.log.training)
    circles = own_floor(tuple(replace(t, held_out=True) for t in trials if t.manoeuvre == "circle"), True)
    assert own_floor(kept, True)["ground_truth"] == pytest.approx(circles["ground_truth"])
    eights = tuple(t for t in trials if t.held_out)
    assert own_floor(trials, True)["odometry"] == pytest.approx(own_floor(eights, True)["odometry"])
    assert own_floor((single,), False) == {}


def test_a_name_that_leaves_more_than_days_differ_by_comes_with_a_warning(sloping):
    limit = sloping.prepared.wander.excess_limit(CONFIG.thresholds.alpha)
    for left, text in ((0.9 * limit, None), (1.1 * limit, "another form here")):
        search = replace(sloping.search, excess=(sloping.search.excess[0], left))
        said = warnings(replace(sloping, search=search))
        assert not said if text is None else len(said) == 1 and text in said[0]
    assert not warnings(replace(sloping, search=replace(sloping.search, verdict="none", excess=(1.0, 1.0))))
    crowded = replace(sloping.search, excess=(1.0, 0.0), crowd=["backlash"])
    assert "backlash cannot be separated from it either" in warnings(replace(sloping, search=crowded))[0]


@pytest.mark.parametrize(("by", "outcome", "warns"), [("speed", "untold", True), ("speed", "holds", False),
                                                      ("time in the drive", "untold", False)])
def test_a_name_whose_law_the_drives_did_not_put_to_test_comes_with_a_warning(sloping, by, outcome, warns):
    first = sloping.stood[0]
    tested = replace(first.falsifiers[0], falsifier=Falsifier("grows as its law says", by), outcome=outcome)
    said = warnings(replace(sloping, stood=(replace(first, falsifiers=(tested,)),)))
    assert any("do not show whether slope grows as its law says" in one for one in said) == warns


def test_report_and_vehicle_file(sloping, report, tmp_path):
    write_run(tmp_path, sloping, report)
    read = json.loads((tmp_path / "report.json").read_text())
    assert read["verdict"] == "named"
    assert read["noise_sentence"] is None
    assert {name for name, one in read["noise"].items() if not one["changed"]} == set(CHANNELS)
    assert read["effects"][0]["name"] in ("slope", "wind")
    values = read["effects"][0]["parameters"]
    if "slope.along_x" in values:
        low, high = values["slope.along_x"]["interval"]
        assert low - 0.01 < 0.03 < high + 0.01
    before, refitted, alone, after = (read[key]["held_out"]["ground_truth"]["trajectory"]
                                      for key in ("before", "refitted", "alone", "after"))
    assert after < before and alone < refitted and after < refitted
    shown = read["shown"]
    assert shown["held_out"] and shown["errors"]["after"]["position"] < shown["errors"]["before"]["position"]
    page, method = ((tmp_path / name).read_text() for name in ("report.html", "method.html"))
    assert "<h1>Missing: " in page and "the vehicle as it was" in page and "refitted before" in method
    assert "alpha" in method and "alpha" not in page  # thresholds have a page of their own
    assert all({"reference", "before", "after", "spread", "away", "unit"} <= set(row) for row in read["base"])
    assert read["manifest"]["sha256"]
    _, params, provenance = load_vehicle(tmp_path / "vehicle.toml")
    assert read["effects"][0]["name"] in [effect.name for effect in params.effects]
    assert provenance["verdict"] == "named"
    assert "<html" in (tmp_path / "report.html").read_text()


def test_before_is_the_vehicle_as_it_was_and_no_parameter_of_it_moved(sloping, report):
    trials = (*sloping.log.training, *sloping.log.held_out)
    as_it_was = replay(sloping, sloping.reference.params, trials)
    errors = [score(trial, one)["ground_truth"]["trajectory"] for trial, one in zip(trials, as_it_was, strict=True)
              if trial.held_out]
    assert report["before"]["held_out"]["ground_truth"]["trajectory"] == pytest.approx(np.mean(errors))


def test_a_doubt_about_what_is_left_asks_for_nothing_where_drives_are_predicted_as_well_as_they_repeat(sloping):
    limit = sloping.prepared.wander.excess_limit(CONFIG.thresholds.alpha)
    search = replace(sloping.search, excess=(sloping.search.excess[0], 1.1 * limit))
    doubtful = replace(sloping, search=search)
    assert len(warnings(doubtful)) == 1 and advice(doubtful, True) == []
    assert "Take the name as a hint" in advice(doubtful, False)[0]
    assert as_good_as_repeats(np.array([0.01, 0.02]), 0.015) and not as_good_as_repeats(np.array([0.03, 0.04]), 0.015)


def test_where_only_what_was_named_may_move_the_base_stays_as_it_was(sloping):
    before, alone = (base_values(one) for one in (fitted_before(sloping), fitted_alone(sloping)))
    named = {axis.parameter for one in sloping.search.final.hypotheses for axis in one.axes}
    assert named and {name: value for name, value in alone.items() if name in before and name not in named} == {
        name: value for name, value in before.items() if name not in named}
    assert all(alone[name] != 0 for name in named)


def test_base_parameters_far_from_the_reference_are_said():
    row = {"name": "slip_traction.mu", "unit": "-", "reference": 0.8, "before": 0.6, "after": 0.5, "away": -6.0}
    assert shifts([row, {**row, "away": 0.5}]) == ["slip_traction.mu 0.8 -> 0.5 - (-6.0 spreads)"]


def test_base_parameters_that_went_far_widen_the_interval_of_an_effect(sloping):
    usual = effects(sloping)[0]["parameters"]
    final, reference = sloping.search.final, sloping.reference
    assert not beside_still_base(replace(sloping, search=replace(sloping.search, final=replace(
        final, u=reference.u.copy()))))
    far = replace(final, u=reference.u + 3.5 * np.sqrt(np.diag(reference.spread)))
    moved = replace(sloping, search=replace(sloping.search, final=far))
    [still] = beside_still_base(moved)
    away = (still.u - reference.u) / np.sqrt(np.diag(reference.spread))
    assert np.abs(away).max() <= 1.001 < 3.5
    for name, one in effects(moved)[0]["parameters"].items():
        low, high = one["interval"]
        assert low <= usual[name]["interval"][1] and high >= usual[name]["interval"][0]


def test_the_report_says_what_a_named_effect_stood(report):
    evidence = report["effects"][0]["evidence"]
    assert {"heading along x", "heading along y"} <= {one["by"] for one in evidence["falsifiers"]}
    assert all(one["outcome"] != "falsified" for one in evidence["falsifiers"])
    assert "holds" in {one["outcome"] for one in evidence["falsifiers"]}  # it changes sign with the heading
    assert evidence["left_out_total"] > 0 and evidence["heterogeneity"]["manoeuvres"] >= 2
    assert not report["contradicted"] and report["missing"]["p_pairs"] < 0.01
    assert 0 <= report["missing"]["p_search"] < report["missing"]["p_value"] < 0.05
    [power] = report["operating"]["power"]
    assert power["sizes"][-1]["noticed"] > 0.9
    assert report["operating"]["false_alarms"]["rate"] < 0.1
    gone = {row["manoeuvre"] for row in report["by_manoeuvre"]
            if (row["part"], row["channel"], row["metric"]) == ("held_out", "ground_truth", "trajectory")
            and row["interval"][1] < 0}
    assert gone == {"figure_eight"}
    assert all(row["interval"][0] > 0 for row in report["worse"])


def test_a_pull_that_does_not_turn_with_the_room_is_no_slope(sloping):
    """The fit of a slope to drives that were given another one in each half of the headings is contradicted."""
    search = sloping.search
    assert not sloping.stood[0].against(CONFIG.thresholds)
    refitter = refitter_of(sloping)
    fit = search.final
    half = without_each(fit, refitter)[0]
    seen = refitter.drives.simulate(np.stack([fit.values, half]))
    course = course_of(sloping.log.training, seen[0], sloping.reference.width, sloping.log.spec.track)
    wrong = np.sign(np.cos(course.heading))[..., None] * (seen[0] - seen[1]) - (seen[0] - seen[1])
    moved = replace(fit, residual=fit.residual + refitter.white(wrong))
    [tested] = put_to_test(moved, refitter, sloping.log.training, sloping.evidence.groups, sloping.log.spec.track,
                              sloping.prepared.wander.p_excess)
    assert [one.outcome for one in tested if one.falsifier.by == "heading along x"] == ["falsified"]


def test_what_the_drives_contradict_gives_way_to_what_looks_like_it(sloping):
    first = sloping.search.effects
    search = replace(sloping.search, rounds=[*sloping.search.rounds])
    wrong = [replace(one, interval=(-2.0, -1.0)) for one in sloping.stood]  # about manoeuvres that were held back
    found = guarded(search, wrong, CONFIG.thresholds)
    assert found.verdict == "named" and {*first, *found.effects} == {"slope", "wind"} and first != found.effects
    assert tuple(one.effect for one in found.final.hypotheses) == found.effects
    assert first[0] not in found.classes[0] and f"{first[0]} is wrong about" in found.reason
    assert guarded(found, [replace(one, effect=found.effects[0]) for one in wrong], CONFIG.thresholds
                   ).verdict == "unexplained"


def test_everything_fixed_beforehand_is_in_the_manifest(sloping):
    written = manifest(CONFIG, sloping.hypotheses, sloping.reference)
    assert {one["effect"] for one in written["catalogue"]} == {one.effect for one in sloping.hypotheses}
    assert written["settings"]["seed"] == 0 and written["thresholds"]["alpha"] == 0.005
    assert set(written["bounds"]) == set(sloping.reference.space.names)
    assert set(written["falsifiers"]) >= {one.effect for one in sloping.hypotheses}
    other = manifest(replace(CONFIG, seed=1), sloping.hypotheses, sloping.reference)
    assert json.dumps(other, default=str) != json.dumps(written, default=str)


def test_the_command_writes_the_run(sloping, report, folder, tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr("sysid.verdict.pipeline.find_missing",
                        lambda *given: asked.append(given) or sloping)
    monkeypatch.setattr("sysid.pages.loop_report.make_report", lambda result: report if result is sloping else None)
    report = main(Arguments(dataset=folder / "sloping", reference=(folder / "reference_1",), out=tmp_path / "run"))
    [(log, references, config, vehicle, _)] = asked
    assert (log.name, [one.name for one in references], vehicle) == ("sloping", ["reference_1"], None)
    assert config.seed == 0
    assert json.loads((tmp_path / "run/report.json").read_text())["verdict"] == report["verdict"] == "named"
    assert "verdict: named" in capsys.readouterr().out
    again = posterior(read(tmp_path / "run/evidence.json"), CONFIG.thresholds)
    assert (again.verdict, again.reason, again.weights) == ("named", report["reason"], report["weights"])
    assert "something unknown" in (tmp_path / "run/report.html").read_text()
    slope = next(one for one in report["effects"] if one["name"] == "slope")["parameters"]["slope.along_x"]
    low, high = load_intervals(tmp_path / "run/vehicle.toml")["slope.along_x"]  # of 90 %, as in all vehicle files
    assert slope["interval"][0] < low < slope["value"] < high < slope["interval"][1]
    assert high - low == pytest.approx(1.645 / 1.96 * np.diff(slope["interval"])[0], rel=1e-3)
    assert load_vehicle(tmp_path / "run/vehicle.toml")[2]["interval_confidence"] == 0.9
    main(Arguments(dataset=folder / "sloping", reference=(folder / "plain",), vehicle=tmp_path / "run/vehicle.toml",
                   out=tmp_path / "again"))
    *_, vehicle, _ = asked[-1]
    assert not vehicle.kept and set(describe(vehicle.params)) >= set(describe(sloping.reference.params))


def test_refit_to_poses_lowers_the_training_error(drives, sloping):
    few = replace(drives["plain"], trials=drives["plain"].training[::3])
    plain = replace(sloping, log=few, search=replace(sloping.search, verdict="none"))

    def error(vehicle):
        pairs = zip(few.trials, replay(plain, vehicle, few.trials), strict=True)
        return np.mean([score(trial, prediction)["ground_truth"]["trajectory"] for trial, prediction in pairs])

    before = vehicle_before(plain)
    unknown = replace(plain, prepared=replace(plain.prepared, reference=replace(plain.reference, known=False)))
    alone = refit_poses(unknown, before, iterations=4)
    assert error(alone) < error(before)
    beside = refit_poses(plain, before, iterations=4)
    added = {one.name for one in beside.effects} - {one.name for one in before.effects}
    assert added == {"axle_pivot", "lateral_damping", "suspension", "sensor_delay", "wheel_inertia"}
    assert error(beside) < error(before) and float(beside.body.com_z) != float(before.body.com_z)
    assert {one.name for one in alone.effects} == {one.name for one in before.effects}


def test_a_wrench_without_a_name_is_there_when_its_vehicle_is_replayed(drives, sloping):
    """Refits to poses replay like this too: without the wrench, base parameters would move to stand for it."""
    trials = tuple(one for one in drives["plain"].training if one.name == "straight_1")
    push = WrenchTable("speed", "push", -1.0, 1.0).parameters(np.repeat([-20.0, 0.0], KNOTS), 0.0)
    pushed = vehicle_of(sloping, {f"unnamed.{name}": value for name, value in push.items()})
    [free], [held] = (replay(sloping, one, trials) for one in (sloping.reference.params, pushed))
    ends = [np.array([one.ground_truth.x[-1], one.ground_truth.y[-1]]) for one in (free, held)]
    assert np.linalg.norm(ends[1] - ends[0]) > 0.01


def test_replicates_start_at_their_own_angle_of_a_wheel_that_is_out_of_balance(drives, sloping):
    trials = tuple(one for one in drives["plain"].training if one.name in ("straight_1", "straight_2"))
    force = 40 * np.sin(np.arange(KNOTS) * 2 * np.pi / KNOTS)
    push = WrenchTable("left wheel's angle", "push", 0.0, 1.0).parameters(np.concatenate([force, np.zeros(KNOTS)]), 0.0)
    pushed = vehicle_of(sloping, {f"unnamed.{name}": value for name, value in push.items()})
    speeds = []
    for angles in ([0.0, 0.0], [0.0, np.pi]):
        plant = with_start_angles(sloping.plant, trials, np.array(angles))
        turned = replace(sloping, prepared=replace(sloping.prepared, plant=plant))
        speeds.append([one.odometry.v for one in replay(turned, pushed, trials)])
    (first, second), (same, other) = speeds
    np.testing.assert_allclose(same, first, atol=1e-5)
    assert np.abs(other - second).max() > 0.01


def test_held_out_trials_cannot_change_the_verdict(drives, sloping):
    log = drives["sloping"]
    altered = []
    for trial in log.trials:
        if trial.held_out:
            truth = trial.ground_truth
            trial = replace(trial, ground_truth=replace(truth, x=truth.x + 3 * truth.t), odometry=None)
        altered.append(trial)
    again = find_missing(replace(log, trials=tuple(altered)), (), CONFIG, reference=sloping.reference)
    assert again.search.verdict == sloping.search.verdict
    assert np.array_equal(again.search.final.values, sloping.search.final.values)


def test_vehicle_after_has_only_the_accepted_effect(sloping):
    names = [effect.name for effect in vehicle_after(sloping).effects]
    extra = set(names) - {effect.name for effect in sloping.reference.params.effects}
    assert extra == {sloping.search.accepted[0].hypothesis.effect}


def test_replicates_move_alike_unless_the_room_does_something(drives, sloping):
    """For every hypothesis: simulating one trial of a course for all gives what each trial by itself gives."""
    ready = sloping.prepared
    base = base_values(ready.full)
    values = [list(base.values())]
    for one in ready.hypotheses:
        row = {**base, **one.values(np.ones(len(one.axes)), base)}
        values.append([row[name] for name in base])
    made = make_drives(ready.vehicle, drives["plain"].training, paths=ready.paths)
    once = made.simulate(np.array(values))
    every = replace(made, courses=replace(made.courses, shared=False)).simulate(np.array(values))
    assert len(made.courses.first) == 3 < len(made.trials)
    assert np.abs(once - every).max() < 2e-3
    assert np.sqrt(np.square(once - every).mean()) < 1e-4


@pytest.mark.long
def test_an_accelerator_replays_the_same_in_large_calls(sloping, monkeypatch):
    made = refitter_of(sloping).drives
    every = np.arange(len(made.trials))
    values = np.array([list(base_values(sloping.full).values())] * len(every))
    usual = sloping.prepared.paths(values, made.batch, every)
    for module in ("rollout", "one_drive"):
        monkeypatch.setattr(f"sysid.replay.{module}.on_processor", lambda: False)
    monkeypatch.setattr("sysid.replay.rollout.FETCHED", 2)
    large = copy.copy(sloping.prepared.paths)
    for large.rows in (len(every) - 2, len(every) + 5):  # the second one has rows to spare, of which one is fetched
        paths = large(values, made.batch, every)
        np.testing.assert_allclose(paths, usual, atol=2e-3)
        assert len(paths) == len(every)


def test_vehicles_with_the_same_effects_share_what_was_compiled(sloping):
    trials = sloping.log.training
    wider = with_effects(sloping.reference.params, ("lateral_damping", "axle_pivot"))
    assert not set(base_values(wider)) <= set(sloping.names)
    first, values = drives_of(sloping, trials, wider)
    mass = values[list(first.names).index("body.mass")]
    heavier = set_values(wider, ["body.mass"], np.array([1.5 * mass], np.float32))
    again, moved = drives_of(sloping, trials, heavier)
    assert again.paths is first.paths
    assert moved[list(again.names).index("body.mass")] == pytest.approx(1.5 * mass)
    assert np.abs(again.simulate(moved[None]) - first.simulate(values[None])).max() > 1e-3
    named, _ = drives_of(sloping, trials, with_effects(wider, ("slope",)))  # that every vehicle of the result may have
    assert named.paths is first.paths
    other, _ = drives_of(sloping, trials, with_effects(sloping.reference.params, ("axle_pivot",)))
    assert other.paths is not first.paths


def test_wander_is_what_days_show(sloping):
    """Days that differ in gains and friction alone make no effect wander by much, and gains by something."""
    sizes = {}
    columns = zip(sloping.evidence.columns, sloping.prepared.wander.covariance, strict=True)
    for one, covariance in columns:
        hypothesis = sloping.hypotheses[one.hypothesis]
        sizes[hypothesis.key, one.level] = float(np.sqrt(np.diag(covariance).max()))
    assert sizes["track_width", 1.0] < 0.5
    assert sizes["slope", 1.0] < 0.5
    assert max(sizes.values()) > 0


@pytest.mark.quick
def test_features_do_not_depend_on_the_start_pose(drives):
    trials = drives["plain"].training[:2]
    features = make_features(trials)
    pose = np.zeros((2, 200, 3))
    t = np.arange(200) * 0.05
    pose[0] = np.stack([0.4 * t, 0.1 * t, 0.2 * t], axis=-1)
    turn = np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    pose[1, :, :2] = pose[0, :, :2] @ turn.T + [3.0, -2.0]
    pose[1, :, 2] = pose[0, :, 2] + 1.0
    seen = features.of(Measured(pose, np.ones_like(pose), np.zeros((2, 200, 5)), np.ones((2, 200, 5))))
    assert np.allclose(seen[0], seen[1], atol=1e-9)
    assert seen.shape[-1] == len(CHANNELS)


@pytest.mark.quick
def test_deviations_have_the_size_of_the_noise(drives):
    trials = drives["plain"].training
    groups = replicate_groups(trials)
    assert sorted(len(group) for group in groups) == [3, 3, 3]
    random = np.random.default_rng(1)
    shared = random.standard_normal((len(trials), 500, 3))
    for group in groups:
        shared[group] = shared[group[0]]
    out = deviations(shared + 0.3 * random.standard_normal(shared.shape), groups)
    assert abs(out.std() - 0.3) < 0.02


@pytest.mark.quick
def test_a_reference_of_another_vehicle_is_refused(drives):
    other = drives["reference_1"]
    other = replace(other, spec=replace(other.spec, track=0.6))
    with pytest.raises(ValueError, match="track is 0.6.*same vehicle"):
        find_missing(drives["plain"], (other,), CONFIG)
