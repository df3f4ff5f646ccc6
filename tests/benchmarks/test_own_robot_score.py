"""The score of the own robot counts all of its logs."""

from __future__ import annotations

import dataclasses

import pytest

from benchmarks.fit_jobs import run_jobs
from benchmarks.own_robot import TESTED, Benchmark, basis, collect, drop_others
from benchmarks.plant.effects import EFFECTS

pytestmark = pytest.mark.quick


@pytest.fixture
def score(tmp_path):
    return Benchmark(out=tmp_path)


def judge(score, names, failing=()):
    def verdict_on(name):
        if name in failing:
            raise ValueError("no drive moves")
        named = [[EFFECTS[name].covered or name]] if name in TESTED else []
        return {"effect": name, "size": 1.0, "verdict": "named" if named else "none", "named": named,
                "basis": basis(score)}

    run_jobs(score.out / "verdicts", names, verdict_on)


def test_all_logs_are_counted(score):
    judge(score, (*TESTED, "null_1", "null_2"))
    figures = collect(score)
    assert figures["own_robot_loop_logs"]["value"] == figures["own_robot_loop_right"]["value"] == len(TESTED)
    assert figures["own_robot_loop_false"]["value"] == 0.0


def test_a_log_that_failed_or_is_missing_is_named_and_no_score_is_given(score):
    judge(score, (*TESTED, "null_1"), failing=(TESTED[3],))
    with pytest.raises(ValueError, match=rf"no verdict on {TESTED[3]} .failed., null_2 .missing.\. Remove"):
        collect(score)
    (score.out / "verdicts" / f"{TESTED[3]}.json").unlink()
    judge(score, (*TESTED, "null_1", "null_2"))
    assert collect(score)["own_robot_loop_logs"]["value"] == len(TESTED)


def test_a_score_of_some_logs_counts_them_alone(score):
    judge(score, TESTED[:2])
    assert collect(dataclasses.replace(score, only=TESTED[:2]))["own_robot_loop_logs"]["value"] == 2


def test_verdicts_of_a_quick_run_or_of_another_robot_are_no_result_of_this_one(score):
    quick, names = dataclasses.replace(score, quick=True), (*TESTED, "null_1", "null_2")
    judge(quick, names)
    with pytest.raises(ValueError, match=rf"verdicts on .*{TESTED[0]}.* are of other code, other settings .--quick."):
        collect(score)
    assert collect(quick)["own_robot_loop_logs"]["value"] == len(TESTED)
    drop_others(quick, names)
    assert len(list((score.out / "verdicts").glob("*.json"))) == len(names)
    drop_others(score, names[:3])
    assert len(list((score.out / "verdicts").glob("*.json"))) == len(names) - 3
    (score.out / "fit").mkdir()
    (score.out / "fit" / "vehicle.toml").write_text("another robot")
    with pytest.raises(ValueError, match="another robot"):
        collect(quick)
