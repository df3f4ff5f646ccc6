"""Over which sets of reference days the benchmark of undeclared effects deals its nulls, and how often it fits them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip("mujoco")

from benchmarks import undeclared, undeclared_figures  # noqa: E402
from benchmarks import undeclared_plant as contact  # noqa: E402
from benchmarks import undeclared_reference as days  # noqa: E402
from sysid.close_loop import LoopConfig  # noqa: E402

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

    def drive(path, seed, **_):
        seen[path] = seed
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


def test_the_uniformity_of_nulls_says_over_how_many_sets_it_was_seen():
    nulls = [{"verdict": "none", "p_value": (i + 0.5) / 40, "reference": i % 4} for i in range(40)]
    assert undeclared_figures.of_nulls(nulls)["null_ks_p"]["unit"] == "of 40 logs over 4 sets of reference days"
