"""Several devices and several processes give the run of one device."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dreamer.training import parallel

SCRIPT = Path(__file__).parent / "run_parallel.py"


def start(devices, *arguments):
    """A fresh process with so many simulated devices."""
    # Nothing here is timed, so the compiler may save its own time.
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process):
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output[-3000:]


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """A short run on one of eight devices and on all of them: its parameters, and what was told of it."""
    out = tmp_path_factory.mktemp("several") / "out.npz"
    finish(start(8, "devices", out))
    return np.load(out), json.loads(out.with_suffix(".json").read_text())


def test_eight_devices_give_the_run_of_one(several):
    result, told = several
    assert told["many"]["updates"] == told["alone"]["updates"] == 2
    assert (told["shards"], told["columns"], told["replicated"], told["reduces"]) == (8, 1, True, True)
    np.testing.assert_allclose(result["many"], result["alone"], atol=1e-6)
    assert np.abs(result["alone"]).max() > 0.1
    for name, value in told["alone"].items():
        np.testing.assert_allclose(told["many"][name], value, rtol=1e-3, atol=1e-3, err_msg=name)


def test_eight_devices_share_the_arithmetic_of_one(several):
    _, told = several
    rest = 0.25  # what each does with the whole parameters and replay, which counts in so small a net
    assert told["flops"] < (1 + rest) * told["flops_alone"] / 8


def test_what_the_whole_batch_tells_is_that_of_one_device(several):
    result, _ = several
    np.testing.assert_allclose(result["statistics_many"], result["statistics_alone"], rtol=1e-5, atol=1e-6)


def test_each_of_eight_devices_draws_its_own_sequences_anew(several):
    result, _ = several
    np.testing.assert_array_equal(result["drawn_many"], result["drawn_alone"])
    assert len(np.unique(result["drawn_alone"][:, :, 0, 0, 0] % 128)) > 8


@pytest.mark.long
def test_two_processes_train_save_and_restore_like_one(several, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    for process in [start(1, "process", tmp_path / "out.npz", port, index) for index in (0, 1)]:
        finish(process)
    result = np.load(tmp_path / "out.npz")
    np.testing.assert_allclose(result["many"], several[0]["alone"], atol=1e-6)
    np.testing.assert_array_equal(result["restored"], result["many"])
    lines = [json.loads(text) for text in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [(line["env_steps"], line["updates"], line["eval/x"]) for line in lines] == [(72, 2, 0.0)]
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == [f"{72:012d}"]


@pytest.mark.quick
def test_uneven_splits_are_refused():
    with pytest.raises(ValueError, match="3 instances do not split evenly over 2"):
        parallel.make_mesh([None, None], 3, 2)
    with pytest.raises(ValueError, match="5 sequences of a batch"):
        parallel.make_mesh([None, None], 4, 5)
    assert parallel.make_mesh([None], 3, 5) is None
