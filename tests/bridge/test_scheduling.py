"""A node in real time keeps the processor awake, says what it may not do, and starts no other process so."""

import os
import struct
import subprocess
import sys

import numpy as np
import pytest
from tiny_policy import write

from bridge.nodes import scheduling
from bridge.policy import Policy

pytestmark = pytest.mark.quick


@pytest.fixture
def requests(monkeypatch):
    made = []
    monkeypatch.setattr(scheduling, "_requests", made)
    yield made
    for one in made:
        os.close(one)


def test_the_processor_is_asked_once_to_wake_at_once(tmp_path, requests, capsys):
    latency = tmp_path / "cpu_dma_latency"
    latency.touch()
    scheduling.stay_awake("bridge.drive", latency)
    scheduling.stay_awake("bridge.drive", latency)
    assert latency.read_bytes() == struct.pack("i", 0)
    assert len(requests) == 1
    assert capsys.readouterr().err == ""


def test_a_kernel_without_such_states_needs_no_request(tmp_path, requests, capsys):
    scheduling.stay_awake("bridge.drive", tmp_path / "none")
    assert not requests
    assert capsys.readouterr().err == ""


def test_a_request_that_is_not_permitted_is_named_with_its_remedy(tmp_path, requests, capsys):
    scheduling.stay_awake("bridge.drive", tmp_path)  # a folder cannot be written, not by root either
    said = capsys.readouterr().err
    assert said.startswith(f"bridge.drive: {tmp_path}: ") and "docs/deploy.md" in said


def test_a_priority_that_is_none_leaves_the_usual_scheduling(requests, capsys):
    assert not scheduling.set_realtime("bridge.drive", 100)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    assert not requests
    assert "--realtime 100" in capsys.readouterr().err


def test_the_trial_of_a_policy_leaves_real_time():
    program = """
import os, sys
from bridge.policy.trial import leave_realtime
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
except PermissionError:
    sys.exit(77)
leave_realtime()
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    if done.returncode == 77:
        pytest.skip("real-time scheduling is not permitted here")
    assert done.stdout == "True\n", done.stderr


def test_two_threads_compute_the_same_steps(tmp_path):
    folder = write(tmp_path / "policy")
    one, two = Policy.load(folder), Policy.load(folder, threads=2)
    rng = np.random.default_rng(0)
    for _ in range(5):
        image = rng.integers(0, 256, one.zeros()["image"].shape, np.uint8)
        np.testing.assert_allclose(two.step(image), one.step(image), rtol=0, atol=1e-6)
