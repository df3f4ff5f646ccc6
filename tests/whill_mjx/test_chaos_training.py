"""Trainings that are killed at random moments end in the bits of one that is left alone, or in a clear refusal."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from killed import Process, killed_again_and_again, left_alone
from warm_starter import Warm

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
REAL = ["--preset", "smoke", "--vehicle", "whill_cr_ramp", "--steps", "800", "--episodes", "2", "--no-planner",
        "--videos", "0", "--checkpoint-every-s", "1"]  # fmt: skip


def steps_of(out):
    return max((int(path.name) for path in (out / "checkpoints").glob("[0-9]*")), default=0)


def assert_same_arrays(one, other):
    with np.load(one) as one, np.load(other) as other:
        assert one.files == other.files
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name])


def log(out):
    """The lines of a log without what depends on time."""
    lines = [json.loads(text) for text in (out / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if not name.endswith("_s")} for line in lines]


def straight_and_broken(start, module, words, last, kills, folder):
    """Folders of a training that was left alone, and of one that was ended and begun again; another seed is refused.

    `last` is the name of a file that it writes at the end of its work.
    """
    said, straight, broken = (folder / name for name in ("said", "straight", "broken"))
    alone = start(module, [*words, "--out", str(straight)], said)
    most, seconds = left_alone(alone, said, partial(steps_of, straight))
    again = partial(start, module, [*words, "--out", str(broken)], said)
    killed_again_and_again(again, broken / last, kills, partial(steps_of, broken), most, seconds, said)
    assert again().wait() == 0, said.read_text()
    assert start(module, [*words, "--out", str(broken), "--seed", "3"], said).wait() == 2
    assert "seed is 0 there and 3 here" in said.read_text()
    return straight, broken


def test_a_training_killed_three_times_by_each_signal_ends_in_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ["PYTHONPATH"]]))
    with Warm("half_lit") as warm:
        straight, broken = straight_and_broken(warm.start, "half_lit", [], "result.npz", 3, tmp_path)
    assert_same_arrays(straight / "result.npz", broken / "result.npz")
    assert log(broken) == log(straight)
    assert not [path for path in broken.rglob(".*") if path.name not in (".lock", ".training.lock")]


@pytest.mark.long
@pytest.mark.parametrize("learner", ["dreamer", "ppo"])
def test_the_real_command_killed_ten_times_by_each_signal_ends_in_the_same_bits(learner, tmp_path):
    words = [*REAL, "--learner", learner]
    straight, broken = straight_and_broken(Process, "whill_mjx.train", words, "evaluation.json", 10, tmp_path)
    assert_same_arrays(straight / "policy" / "weights.npz", broken / "policy" / "weights.npz")
    evaluations = [json.loads((out / "evaluation.json").read_text()) for out in (straight, broken)]
    assert evaluations[0]["policy"] == evaluations[1]["policy"]


@pytest.mark.long
def test_two_commands_at_once_in_one_folder_give_one_training_and_one_refusal(tmp_path):
    said = [tmp_path / name for name in ("one", "other")]
    children = [Process("whill_mjx.train", [*REAL, "--out", str(tmp_path / "run")], each) for each in said]
    assert sorted(child.wait() for child in children) == [0, 2]
    assert sum("writes there" in each.read_text() for each in said) == 1
