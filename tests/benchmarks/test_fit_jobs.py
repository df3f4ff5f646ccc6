"""The fit's benchmark split over processes: which jobs are whose, what is kept, and what is counted."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import fit, fit_coverage, fit_searches
from benchmarks.fit_jobs import (
    RememberedCosts,
    compile_once,
    labels_of,
    on_device,
    read_results,
    run_jobs,
    staged,
    write_result,
)
from benchmarks.fit_settings import Benchmark
from benchmarks.plant.chair import VEHICLES, Chair
from sysid.errors.space import Space, make_space, searched
from sysid.intervals.independence import Information
from sysid.replay.models import measured_effects, with_effects
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR, in_proportion


@pytest.mark.quick
def test_parts_share_all_jobs_and_none_twice():
    labels = [f"log_{n}" for n in range(10)]
    parts = [labels_of(f"{i}/4", labels) for i in range(1, 5)]
    assert sorted(sum(parts, [])) == labels
    for wrong in ("0/4", "5/4", "3", "a/b"):
        with pytest.raises(ValueError, match="I/N"):
            labels_of(wrong, labels)


@pytest.mark.quick
def test_what_is_done_is_not_done_again_and_what_failed_is_left_out(tmp_path):
    calls = []

    def job(label):
        calls.append(label)
        if label == "bad":
            raise ValueError("diverged")
        return {"cost": len(label)}

    assert run_jobs(tmp_path, ["a", "bad"], job) == 2
    assert run_jobs(tmp_path, ["a", "bad", "abc"], job) == 1
    assert calls == ["a", "bad", "abc"]
    assert [one["cost"] for one in read_results(tmp_path)] == [1, 3]
    assert "diverged" in json.loads((tmp_path / "bad.json").read_text())["error"]


def row(truth, low, high, identifiable=True):
    return {"truth": truth, "value": (low + high) / 2, "low": low, "high": high, "identifiable": identifiable}


@pytest.mark.quick
def test_coverage_counts_a_parameter_only_where_a_log_tells_it():
    results = [{"seconds": 1.0, "parameters": {"a": row(1.0, 0.9, 1.2), "b": row(0.0, 1.0, 2.0),
                                               "c": row(5.0, 0.0, 9.0, identifiable=False)}},
               {"seconds": 3.0, "parameters": {"a": row(1.0, 1.1, 1.5), "b": row(0.0, 1.0, 2.0, identifiable=False),
                                               "c": row(5.0, 0.0, 9.0, identifiable=False)}}]
    found = {name: one["value"] for name, one in fit_coverage.summarise(results).items()}
    assert found["coverage_90_a"] == 0.5 and found["coverage_90_b"] == 0.0
    assert "coverage_90_c" not in found and found["identifiable_c"] == 0.0
    assert (found["coverage_90_min"], found["coverage_90_max"]) == (0.0, 0.5)
    assert found["half_width_90_a"] == pytest.approx(0.175) and found["seconds_coverage_log"] == 2.0


@pytest.mark.quick
def test_intervals_of_a_kept_search_are_made_anew(tmp_path):
    random = np.random.default_rng(0)
    space = Space(("a", "b"), np.zeros(2), np.array([1.0, 10.0]), np.array([0.5, 2.0]), np.zeros(2, bool))
    blocks = np.tile(1e3 * np.eye(2), (12, 8, 1, 1))
    scores = 1e3**0.5 * random.standard_normal((12, 8, 2))
    evidence = Information(np.array([0.4, 0.3]), scores - scores.mean((0, 1)), blocks, np.arange(12) // 2, 1.0, 1.0,
                        np.eye(2), 1.0)
    found = {"label": "synthetic_000", "parameters": {"b": row(3.1, 0.0, 9.0)}, "seconds": 1.0}
    with pytest.raises(ValueError, match="synthetic_000.*run the job again"):
        fit_coverage.judged_again(found, tmp_path)
    fit_coverage.save_evidence(tmp_path / "evidence" / "synthetic_000.npz", evidence, space)
    (name, again), = fit_coverage.judged_again(found, tmp_path)["parameters"].items()
    sd = 10 / (12 * 8 * 1e3) ** 0.5
    assert name == "b" and again["truth"] == 3.1 and again["value"] == pytest.approx(3.0) and again["identifiable"]
    assert again["high"] - again["low"] == pytest.approx(2 * 1.645 * sd, rel=0.3)


@pytest.mark.quick
def test_searches_that_were_kept_are_told_again_and_counted(tmp_path, monkeypatch):
    """Of the logs that are asked for only those whose search is there, and figures are of what is told now."""
    settings = Benchmark(parts=("coverage",), told_again=True, logs=5, plant_logs=0, work=tmp_path)
    for number in (0, 3):
        write_result(tmp_path / "coverage" / f"synthetic_{number:03d}.json", {
            "label": f"synthetic_{number:03d}", "parameters": {"a": row(1.0, 2.0, 3.0)}, "seconds": 1.0})
    monkeypatch.setattr(fit_coverage, "told_again", lambda kept, compiled: {
        **kept, "parameters": {"a": row(1.0, 0.5, 3.0 if kept["label"].endswith("3") else 0.9)}})
    monkeypatch.setattr(fit, "share_compilations", lambda folder: None)
    recorded = {}
    monkeypatch.setattr(fit, "record", lambda name, claim, figures, replacing: recorded.update(figures))
    for collect in (False, True):
        fit.coverage(dataclasses.replace(settings, collect=collect))
    assert recorded["coverage_90_a"]["value"] == 0.5 and recorded["coverage_logs"]["value"] == 2.0


@pytest.mark.quick
def test_drawn_vehicles_lie_within_the_bounds_and_differ():
    start = fit_coverage.typical_vehicle()
    space = make_space(start, WHILL_CR, searched(start))
    drawn = np.stack([fit_coverage.draw_truth(space, np.random.default_rng(n)) for n in range(50)])
    assert (drawn > space.low).all() and (drawn < space.high).all()
    assert (np.ptp(drawn, axis=0) > 0.01 * (space.high - space.low)).sum() > 5
    kp = drawn[:, space.names.index("torque_drive.kp")]
    assert np.log(kp).std() == pytest.approx(fit_coverage.SPREAD, rel=0.4)


@pytest.mark.quick
def test_values_of_the_contact_plant_are_per_nominal_inertia():
    """Twice the mass with the same torques is, to the model of nominal mass, nearly half the torques."""
    light, heavy = (fit_coverage.plant_values(Chair(mass=mass), WHILL_CR) for mass in (54.0, 108.0))
    assert heavy["torque_drive.kp"] == pytest.approx(light["torque_drive.kp"] / 2, rel=0.1)
    assert light["torque_drive.ki"] / light["torque_drive.kp"] == pytest.approx(Chair().ki / Chair().kp)
    assert light["torque_drive.kp"] / light["torque_drive.limit"] == pytest.approx(Chair().kp / Chair().torque_limit)
    assert light["torque_drive.period"] == 0.004  # s, a tick of its controller
    assert light["command_delay.delay"] == 0.02 and light["body.com_y"] == pytest.approx(0.0, abs=1e-6)
    assert 0.1 < light["body.com_z"] < 0.167  # wheels are lower than the frame's 0.167 m above the axle
    # The centre of mass is ahead of the driven axle by a bit less than that of the frame alone.
    assert 0.12 < light["body.com_x"] - WHILL_CR.rear_x < 0.2
    assert 2.0 < light["body.yaw_inertia"] < 8.0


@pytest.mark.quick
@pytest.mark.parametrize("vehicle", ["scooter", "robot"])
def test_known_values_of_the_plants_vehicles_lie_within_the_bounds_of_their_fit(vehicle):
    """Coverage is of no use where a truth cannot be reached."""
    nominal = VEHICLES[vehicle].nominal
    spec = in_proportion(WHILL_CR, vehicle, nominal.radius, nominal.track, nominal.wheelbase, nominal.mass)
    start = preset_params(spec, "physical")
    start = with_effects(start, measured_effects(start, spec, ()))
    space = make_space(start, spec, searched(start))
    known = fit_coverage.plant_values(VEHICLES[vehicle], spec)
    searched_too = [name for name in known if name in space.names]
    assert len(searched_too) >= 10
    for name in searched_too:
        i = space.names.index(name)
        assert space.low[i] < known[name] < space.high[i], name
    assert set(fit_coverage.KINDS) == {"synthetic", "plant", "scooter", "robot"}


@pytest.mark.quick
def test_starts_agree_within_a_share_of_the_best_cost():
    results = [{"cost": cost, "seconds": 1.0} for cost in (1.0, 1.009, 1.02, 1.2)]
    found = fit_searches.summarise_starts(results, "")
    assert found["starts_agreeing_of_32"]["value"] == 2
    assert found["starts_within_10_percent_of_32"]["value"] == 3


@pytest.mark.quick
def test_batches_are_judged_by_the_median_of_searches_one_by_one():
    batched = [{"cost": cost, "seconds": 2.0} for cost in (1.0, 1.04, 1.2)]
    sequential = [{"cost": cost} for cost in (0.9, 1.0, 1.3)]
    found = fit_searches.summarise_tpe(batched, sequential, "gpu")
    assert found["tpe500_gpu_seconds"]["value"] == 2.0
    assert found["tpe500_j_over_sequential"]["value"] == pytest.approx(1.04)
    assert found["tpe500_within_5_percent"]["value"] == 1.0
    assert "tpe500_j_over_sequential" not in fit_searches.summarise_tpe(batched, [], "cpu")


@pytest.mark.quick
def test_a_search_that_was_stopped_asks_for_nothing_again(tmp_path):
    """Its costs are kept with the time that they took; a torn last line is what the stop cut off."""
    calls = []

    class Objective:
        def paper_cost(self, u):
            calls.append(u)
            return u.sum(-1)

    points = np.random.default_rng(0).uniform(size=(4, 2, 3))
    first = RememberedCosts(Objective(), tmp_path / "kept.jsonl")
    for u in points[:3]:
        first.paper_cost(u)
    with open(tmp_path / "kept.jsonl", "a") as file:
        file.write('{"u": [[0.1')
    again = RememberedCosts(Objective(), tmp_path / "kept.jsonl")
    np.testing.assert_allclose([again.paper_cost(u) for u in points], points.sum(-1))
    assert len(calls) == 4
    assert again.seconds > json.loads((tmp_path / "kept.jsonl").read_text().splitlines()[2])["seconds"] > 0
    with pytest.raises(ValueError, match="other points"):
        RememberedCosts(Objective(), tmp_path / "kept.jsonl").paper_cost(points[1])


@pytest.mark.quick
def test_a_stage_of_a_job_is_not_done_again(tmp_path):
    assert staged(tmp_path / "a.json", lambda: {"u": [1.0]}) == {"u": [1.0]}
    assert staged(tmp_path / "a.json", lambda: pytest.fail("done again")) == {"u": [1.0]}


@pytest.mark.quick
def test_one_process_compiles_for_all(tmp_path):
    calls = []
    for _ in range(2):
        compile_once(tmp_path, "replay", lambda: calls.append(1))
    compile_once(tmp_path, "other", lambda: calls.append(2))
    assert calls == [1, 2]


@pytest.mark.quick
def test_figures_are_said_to_be_of_the_device_that_did_the_jobs():
    figures = {"a": {"value": 1.0, "device": "here"}}
    assert on_device(figures, [{"device": "there"}])["a"]["device"] == "there"
    assert on_device(figures, [{}])["a"]["device"] == "here" and on_device(figures, [{}])["a"]["versions"] == {}
    assert on_device(figures, [{"versions": {"jax": "9"}}])["a"]["versions"] == {"jax": "9"}


def test_ends_of_starts_are_compared_in_the_noise_of_the_best(monkeypatch):
    """In its own noise every end costs 1: only one noise for all tells which is nearest the truth, 0.2."""
    class Bins:
        counted = 1

        def __init__(self, noise=1.0):
            self.noise = noise

        def renewed(self, u):
            return Bins(abs(float(u[0]) - 0.2))

        def residuals(self, u):
            return (u[:, None, :] - 0.2) / self.noise

    monkeypatch.setattr(fit_searches, "make_features_objective", lambda *_: Bins())
    ends = np.array([[0.5], [0.3], [0.25], [0.9]])
    costs = fit_searches.common_costs(SimpleNamespace(objective=None), 0.5, ends)
    np.testing.assert_allclose(costs[1:3], [4.0, 1.0])
    assert costs.argmin() == 2 and costs[3] > costs[0] > 8.0
