"""Trainings that are killed at random moments end in the bits of one that is left alone, or in a clear refusal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random

import numpy as np
import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
ROOT = Path(__file__).parents[2]
TINY = [sys.executable, str(Path(__file__).with_name("half_lit.py"))]
REAL = [sys.executable, "-m", "whill_mjx.train", "--preset", "smoke", "--vehicle", "whill_cr_ramp", "--steps", "800",
        "--episodes", "2", "--no-planner", "--videos", "0", "--checkpoint-every-s", "1"]  # fmt: skip
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def started(command, out, *more):
    """A process of the command that has taken its signals over."""
    child = start(command, out, *more)
    while child.poll() is None and not catches(child.pid, signal.SIGTERM):
        time.sleep(0.01)
    return child


def catches(pid, number):
    """Whether a process has a handler for a signal, as the operating system has it."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask, 16) >> (number - 1) & 1)


def start(command, out, *more):
    return subprocess.Popen([*command, "--out", str(out), *more], cwd=ROOT, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip


def finished(command, out, *more):
    child = started(command, out, *more)
    told = child.communicate()[1]
    return child.returncode, told


def steps_of(out):
    return max((int(path.name) for path in (out / "checkpoints").glob("[0-9]*")), default=0)


def check_whole(out):
    """Every file with a final name can be read."""
    for path in out.rglob("*.json"):
        json.loads(path.read_text())
    for path in out.rglob("*.npz"):
        if not path.name.startswith("."):
            np.load(path).files  # noqa: B018


def killed_again_and_again(command, out, kills, last):
    """Start the command and end it at a random moment, `kills` times with each signal."""
    random = Random(5)
    signals = [number for number in SIGNALS for _ in range(kills)]
    random.shuffle(signals)
    for index, number in enumerate(signals):
        wanted = (index + 1) * last // (len(signals) + 1) if index % 3 else 0  # some fall into its start
        child = started(command, out)
        deadline = time.monotonic() + 300
        while wanted and child.poll() is None and steps_of(out) < wanted and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 3.0) if not wanted else random.uniform(0.0, 0.1))
        child.send_signal(number)
        told = child.communicate()[1]
        if number == signal.SIGKILL:
            assert child.returncode in (-number, 0), told
        else:
            assert child.returncode in (130, 0), told
            assert "Traceback" not in told
            assert child.returncode == 0 or told.strip().splitlines()[-1].startswith("stopped")
        check_whole(out)


def assert_same_arrays(one, other):
    with np.load(one) as one, np.load(other) as other:
        assert one.files == other.files
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name])


def log(out):
    """The lines of a log without what depends on time."""
    lines = [json.loads(text) for text in (out / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if not name.endswith("_s")} for line in lines]


def test_a_training_killed_three_times_by_each_signal_ends_in_the_same_bits(tmp_path):
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    assert finished(TINY, straight)[0] == 0
    killed_again_and_again(TINY, broken, kills=3, last=steps_of(straight))
    assert finished(TINY, broken)[0] == 0
    code, told = finished(TINY, broken, "--seed", "3")
    assert code == 2 and "seed is 0 there and 3 here" in told
    assert_same_arrays(straight / "result.npz", broken / "result.npz")
    assert log(broken) == log(straight)
    assert not [path for path in broken.rglob(".*") if path.name not in (".lock", ".training.lock")]


@pytest.mark.long
@pytest.mark.parametrize("learner", ["dreamer", "ppo"])
def test_the_real_command_killed_ten_times_by_each_signal_ends_in_the_same_bits(learner, tmp_path):
    command = [*REAL, "--learner", learner]
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    assert finished(command, straight)[0] == 0
    killed_again_and_again(command, broken, kills=10, last=steps_of(straight))
    assert finished(command, broken)[0] == 0
    assert_same_arrays(straight / "policy" / "weights.npz", broken / "policy" / "weights.npz")
    evaluations = [json.loads((out / "evaluation.json").read_text()) for out in (straight, broken)]
    assert evaluations[0]["policy"] == evaluations[1]["policy"]
    code, told = finished(command, broken, "--seed", "3")
    assert code == 2 and "seed is 0 there and 3 here" in told


@pytest.mark.long
def test_two_commands_at_once_in_one_folder_give_one_training_and_one_refusal(tmp_path):
    children = [start(REAL, tmp_path / "run") for _ in range(2)]
    told = [child.communicate()[1] for child in children]
    assert sorted(child.returncode for child in children) == [0, 2]
    assert sum("writes there" in text for text in told) == 1
