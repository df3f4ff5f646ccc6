"""Steps of long work are kept: what was stopped goes on after its last step, to the same bits."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random

import numpy as np
import pytest
import tiny_steps
from killed import SIGNALS
from warm_starter import Warm

from whill_mjx.io import steps
from whill_mjx.io.steps import keep_steps, step, steps_of_rows

pytestmark = pytest.mark.quick
IDENTITY = {"data": "a", "seed": 0}


class Stop(BaseException):
    """Stands for a kill."""


def walk(folder, most, identity=IDENTITY, start=1.0):
    """Three steps, of which `most` may be computed; returns the last state and how many were."""
    computed = 0

    def double(state):
        nonlocal computed
        if computed == most:
            raise Stop
        computed += 1
        return [2 * state, np.arange(3)[::-1].reshape(3, 1)]

    state = np.array(start)
    with keep_steps(folder, identity):
        for _ in range(3):
            state, _ = step("double", lambda state=state: double(state), state)
        if most < 99:
            raise Stop
    return float(state), computed


def stopped(folder, most, **more):
    with pytest.raises(Stop):
        walk(folder, most, **more)


def test_steps_that_were_done_are_not_computed_again(tmp_path):
    stopped(tmp_path / "steps", 2)
    assert walk(tmp_path / "steps", 99) == (8.0, 1)
    assert not (tmp_path / "steps").exists()


@pytest.mark.parametrize("more", [{"identity": {**IDENTITY, "data": "b"}}, {"start": 3.0}])
def test_steps_of_another_run_or_of_other_inputs_are_not_used(more, tmp_path):
    stopped(tmp_path / "steps", 3)
    assert walk(tmp_path / "steps", 99, **more)[1] == 3


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:50], lambda data: data[:-40] + b"x" * 40,
                                    lambda data: bytes(len(data)), lambda data: b"[1, 2]"])  # fmt: skip
def test_a_damaged_step_is_computed_again_and_so_is_no_step_before_it(damage, tmp_path):
    stopped(tmp_path / "steps", 3)
    path = tmp_path / "steps" / "000001.npz"
    path.write_bytes(damage(path.read_bytes()))
    assert walk(tmp_path / "steps", 99) == (8.0, 1)


def test_an_array_has_the_same_bytes_and_order_whether_computed_or_found(tmp_path):
    def arrays():
        return [np.arange(6.0).reshape(2, 3).T, np.float32(0.1), np.array([], int), np.bool_(True)]

    found = []
    for _ in range(2):
        with pytest.raises(Stop), keep_steps(tmp_path / "steps", IDENTITY):
            found.append(step("arrays", arrays))
            raise Stop
    for one, other, plain in zip(*found, step("arrays", arrays), strict=True):
        assert one.dtype == other.dtype == plain.dtype and one.strides == other.strides == plain.strides
        assert one.tobytes() == other.tobytes() == plain.tobytes()


def test_inner_steps_are_found_after_a_stop_and_vanish_with_the_end_of_the_outer_one(tmp_path):
    inner = []

    def outer(most):
        for number in range(3):
            if len(inner) == most:
                raise Stop
            step("inner", lambda number=number: inner.append(number) or [number])
        return [1]

    with pytest.raises(Stop), keep_steps(tmp_path / "steps", IDENTITY):
        step("outer", lambda: outer(2))
    with pytest.raises(Stop), keep_steps(tmp_path / "steps", IDENTITY):
        step("outer", lambda: outer(99))
        assert [path.name for path in (tmp_path / "steps").iterdir()] == ["000000.npz"]
        raise Stop
    assert inner == [0, 1, 2]


def test_of_many_rows_only_the_last_few_are_computed_again(tmp_path):
    rows, computed = np.arange(20.0).reshape(10, 2), []

    def compute(part):
        if len(computed) == 2:
            raise Stop
        computed.append(len(part))
        return [2 * part, part.sum(1)]

    def work():
        with keep_steps(tmp_path / "steps", IDENTITY):
            return step("outer", lambda: steps_of_rows("inner", compute, rows, 3), rows)

    with pytest.raises(Stop):
        work()
    computed.pop()
    doubled, sums = work()
    assert computed == [4, 3]
    assert np.array_equal(doubled, 2 * rows) and np.array_equal(sums, rows.sum(1))


def test_work_stopped_at_random_steps_ends_in_the_bits_of_uninterrupted_work(tmp_path, monkeypatch):
    whole, random, kept = tiny_steps.work(3), Random(1), steps.whole_file
    left = 0

    def stopping(path):
        nonlocal left
        left -= 1
        if not left:
            raise Stop
        return kept(path)

    monkeypatch.setattr(steps, "whole_file", stopping)
    for _ in range(200):
        left = random.randint(1, 15)
        try:
            with keep_steps(tmp_path / "steps", IDENTITY):
                state = tiny_steps.work(3)
            break
        except Stop:
            pass
    np.testing.assert_array_equal(state, whole)


def test_a_full_disk_keeps_the_steps_before_and_the_error_says_where(tmp_path):
    code = f"""if True:
        import resource
        import numpy as np
        from whill_mjx.io.steps import keep_steps, step
        from pathlib import Path
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            with keep_steps(Path({str(tmp_path / "steps")!r}), {{}}):
                step("small", lambda: [np.zeros(10)])
                step("large", lambda: [np.zeros(10_000)])
        except OSError as error:
            print(error.strerror, *error.__notes__)
        """
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.startswith("File too large") and f"is in {tmp_path / 'steps'}" in said.stdout
    assert [path.name for path in (tmp_path / "steps").glob("*")] == ["000000.npz"]


def test_a_command_killed_three_times_by_each_signal_ends_in_the_same_bits(tmp_path, monkeypatch):
    straight, broken, said, random = *(tmp_path / name for name in ("straight", "broken", "said")), Random(7)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ["PYTHONPATH"]]))
    with Warm("tiny_steps") as warm:
        def start(out, *words):
            return warm.start("tiny_steps", ["--out", str(out), *words], said)

        assert start(straight, "--pause", "0").wait() == 0, said.read_text()
        for number in SIGNALS * 3:
            child = start(broken)
            time.sleep(random.uniform(0.0, 0.4))
            child.send_signal(number)
            code, told = child.wait(), said.read_text()
            if code == 0:
                break
            assert code == (-number if number == signal.SIGKILL else 130), told
            assert number == signal.SIGKILL or told.strip().splitlines()[-1].startswith("stopped")
            if (broken / "result.npy").exists():
                break  # it was stopped between its last file and its end
        assert start(broken).wait() == 0, said.read_text()
        np.testing.assert_array_equal(np.load(broken / "result.npy"), np.load(straight / "result.npy"))
        assert start(broken, "--seed", "3").wait() == 2
    assert "seed is 0 there and 3 here" in said.read_text()
    assert sorted(path.name for path in broken.iterdir()) == [".lock", "result.npy", "run.json"]
