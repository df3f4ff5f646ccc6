"""Over which sets of reference days the benchmark of undeclared effects deals its nulls, and how often it fits them."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

pytest.importorskip("mujoco")

from benchmarks import undeclared, undeclared_figures  # noqa: E402
from benchmarks import undeclared_plant as contact  # noqa: E402
from benchmarks import undeclared_reference as days  # noqa: E402
from sysid.follow_up import power  # noqa: E402
from sysid.verdict.result import LoopConfig  # noqa: E402

pytestmark = pytest.mark.quick


def dealt(nulls, sets, count):
    return [contact.null_jobs(nulls, f"{part + 1}/{count}", sets) for part in range(count)]


@pytest.mark.parametrize(("sets", "count", "most"), [(1, 4, 1), (4, 4, 1), (4, 12, 1), (3, 7, 1), (8, 3, 3)])
def test_every_null_has_one_process_and_a_process_few_sets_of_reference_days(sets, count, most):
    parts = dealt(60, sets, count)
    assert sorted(job.label for part in parts for job in part) == [job.label for job in contact.null_jobs(60, "1/1")]
    assert all(job.reference == int(job.label.removeprefix("null_")) % sets for part in parts for job in part)
    assert max(len({job.reference for job in part}) for part in parts) <= most
    assert max(map(len, parts)) <= 2 * max(min(map(len, parts)), 1)


def test_a_null_is_the_same_log_whatever_set_it_is_judged_against():
    assert [job.seed for job in contact.null_jobs(9, "1/1", 4)] == [job.seed for job in contact.null_jobs(9, "1/1")]


@pytest.fixture
def driven(monkeypatch):
    """Folders and seeds of the days that are driven, without driving them."""
    seen = {}

    def drive(path, experiment):
        seen[path] = experiment.seed
        path.mkdir(parents=True)

    monkeypatch.setattr(days, "make_log", drive)
    monkeypatch.setattr(days, "load_log", lambda path: SimpleNamespace(sha256=str(path), spec="chair"))
    return seen


def test_sets_of_reference_days_share_no_drive(tmp_path, driven):
    for number in (0, 1, 2):
        days.reference_days(tmp_path, number=number)
    assert list(driven.values())[: days.DAYS] == [11001, 11002, 11003, 11004, 11005, 11006]
    assert len(set(driven.values())) == len(driven) == 3 * days.DAYS
    days.reference_days(tmp_path, number=1)  # nothing is driven again
    assert len(driven) == 3 * days.DAYS


def test_another_draw_shares_no_seed_name_or_pair_with_the_first(tmp_path, driven, monkeypatch):
    monkeypatch.setattr(contact, "make_log", lambda path, experiment: driven.update({path: experiment.seed}))
    nothing = SimpleNamespace(search=SimpleNamespace(verdict="none"))
    monkeypatch.setattr(contact, "find_missing", lambda *_, **__: nothing)
    monkeypatch.setattr(contact, "brief", lambda _: {})
    monkeypatch.setattr(contact, "load_log", str)
    asked = {"nulls": 3, "scales": (2.0, 4.0), "pairs": 9, "sensor_noise": (2.0,), "noisy_nulls": 3}
    draws = [undeclared.Benchmark(**asked, draw=draw, work=tmp_path) for draw in (0, 1, 2)]
    logs, seeds = [undeclared.wanted(one) for one in draws], []
    for settings, listed in zip(draws, logs, strict=True):
        driven.clear()
        days.reference_days(settings.work, settings.driven)
        for job in listed:
            contact.judge(job, None, settings.work, LoopConfig(), False, settings.driven)
        assert len(driven) == days.DAYS + len(listed)
        seeds += driven.values()
    assert len(set(seeds)) == len(seeds)
    assert len({job.label for listed in logs for job in listed}) == 3 * len(logs[0])
    assert len({str([job.effects for job in listed if job.stage == "pair"]) for listed in logs}) == 3


def test_a_draw_is_not_judged_against_the_days_of_another_in_the_same_folder(tmp_path, driven):
    first = {day.sha256 for day in days.reference_days(tmp_path)}
    assert first.isdisjoint(day.sha256 for day in days.reference_days(tmp_path, days.Driven(draw=1)))
    assert len(set(driven.values())) == len(driven) == 2 * days.DAYS


def test_a_log_of_another_draw_is_asked_for_by_its_name_in_the_first(tmp_path):
    one = undeclared.Benchmark(nulls=3, draw=4, labels=("null_002",), work=tmp_path)
    assert [job.label for job in undeclared.wanted(one)] == ["null_002_draw_4"]


def test_a_set_beyond_the_seeds_is_refused(tmp_path):
    with pytest.raises(ValueError, match="fewer sets"):
        days.reference_days(tmp_path, number=days.SETS)
    assert days.FIRST_SEED + days.SEEDS * days.SETS < contact.null_jobs(1, "1/1")[0].seed


def test_a_set_is_fitted_once_for_all_processes_and_again_for_other_settings(tmp_path, driven, monkeypatch):
    fits = []
    monkeypatch.setattr(days, "reference_of", lambda logs, config: fits.append(config) or f"fit {len(fits)}")
    monkeypatch.setattr(days, "prepare", lambda reference, spec, config: reference)
    assert [days.prepared(tmp_path, 1, days.USUAL, LoopConfig()) for _ in range(2)] == ["fit 1", "fit 1"]
    assert days.prepared(tmp_path, 1, days.USUAL, LoopConfig(seed=1)) == "fit 2"
    assert days.prepared(tmp_path, 0, days.USUAL, LoopConfig()) == "fit 3"  # other days
    monkeypatch.setattr(days, "code_hashes", lambda: {"sysid": "changed"})
    assert days.prepared(tmp_path, 0, days.USUAL, LoopConfig()) == "fit 4"


def test_a_process_makes_only_the_sets_of_its_own_nulls(tmp_path, monkeypatch):
    made, judged = [], []
    monkeypatch.setattr(undeclared, "prepared", lambda work, number, driven, config: made.append(number) or number)

    def judge(job, ready, *_):
        judged.append((job.reference, ready))
        return {"verdict": "none", "effects": [], "share": 0.0, "p_value": 0.5, "seconds": 0.0}

    monkeypatch.setattr(contact, "judge", judge)
    undeclared.plant(undeclared.Benchmark(nulls=24, reference_sets=4, part="2/2", work=tmp_path))
    assert made == [1, 3]
    assert len(judged) == 12 and all(one == ready for one, ready in judged)


def nulls_of(p_values, sets):
    return [{"verdict": "none", "p_value": float(p), "reference": i % sets} for i, p in enumerate(p_values)]


def test_uniformity_is_told_of_the_sets_that_did_not_calibrate():
    skewed = stats.beta.ppf((np.arange(200) + 0.5) / 200, *power.shape())  # uniform when calibrated
    even, odd = np.full(200, 1e-3), skewed
    found = undeclared_figures.of_nulls(nulls_of(np.stack([even, odd], 1).ravel(), 4))
    assert found["null_ks_p"]["unit"] == "of 200 logs over 2 sets of reference days"
    assert found["null_ks_p"]["value"] > 0.9 > 0.05 > found["null_ks_p_uncalibrated"]["value"]
    assert found["false_alarms"]["unit"] == "of 400 logs with nothing in them"


def test_another_draw_calibrates_nothing_and_has_sets_of_its_own():
    nulls = [{**one, "draw": 1 + i % 3} for i, one in enumerate(nulls_of(np.linspace(0.1, 0.9, 9), 1))]
    found = undeclared_figures.of_nulls(nulls)
    assert found["false_alarms"]["sets"] == 3
    assert found["null_ks_p"]["unit"] == "of 9 logs over 3 sets of reference days"


def test_calibration_finds_the_distribution_that_p_values_follow(tmp_path, monkeypatch):
    monkeypatch.setattr(undeclared_figures, "FILE", tmp_path / "null_p.json")
    monkeypatch.setattr(power, "FILE", tmp_path / "null_p.json")
    for folder in ("verdicts", "truth"):
        (tmp_path / folder).mkdir()
    drawn = np.random.default_rng(5).beta(0.6, 0.8, 600)
    for i, one in enumerate(nulls_of(drawn, 6)):
        (tmp_path / "truth" / f"null_{i}.json").write_text("{}")
        (tmp_path / "verdicts" / f"null_{i}.json").write_text(json.dumps(one))
    undeclared_figures.calibrate(tmp_path)
    power.shape.cache_clear()
    try:
        assert power.shape() == pytest.approx((0.6, 0.8), rel=0.2)
        assert stats.kstest([power.calibrated(p) for p in drawn[1::2]], "uniform").pvalue > 0.05
        assert stats.kstest(drawn[1::2], "uniform").pvalue < 1e-3
    finally:
        power.shape.cache_clear()


def test_calibration_asks_for_enough_logs(tmp_path):
    with pytest.raises(SystemExit, match="0 logs with nothing in them, judged against sets 0, 2, 4 .*; 30 are needed"):
        undeclared_figures.calibrate(tmp_path)


def test_logs_with_sets_of_their_own_share_neither_set_nor_seed_with_others():
    own, dealt = contact.own_set_jobs(60, "1/1"), contact.null_jobs(200, "1/1", 44)
    assert len({job.reference for job in own}) == len({job.seed for job in own}) == 60
    assert not {job.reference for job in own} & {job.reference for job in dealt}
    assert not {job.seed for job in own} & {job.seed for job in dealt}
    assert [job for part in ("1/2", "2/2") for job in contact.own_set_jobs(4, part)] == [own[0], own[2], own[1], own[3]]


def test_processes_that_share_a_folder_judge_every_log_once(tmp_path, monkeypatch):
    monkeypatch.setattr(undeclared, "prepared", lambda work, number, driven, config: number)
    judged = []

    def judge(job, *_):
        judged.append(job.label)
        if len(judged) == 3:  # another process comes in between
            undeclared.plant(undeclared.Benchmark(own_sets=8, share=True, work=tmp_path))
        return {"verdict": "none", "effects": [], "share": 0.0, "p_value": 0.5, "seconds": 0.0}

    monkeypatch.setattr(contact, "judge", judge)
    undeclared.plant(undeclared.Benchmark(own_sets=8, share=True, work=tmp_path))
    assert sorted(judged) == [job.label for job in contact.own_set_jobs(8, "1/1")]
