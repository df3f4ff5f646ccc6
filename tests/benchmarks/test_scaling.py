"""Scaling over devices: what is counted, how it is divided, and what is refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import scaling
from benchmarks.scaling import Options, Program

ROOT = Path(__file__).parents[2]
PROGRAM = """
  %a = f32[4,2]{1,0} all-reduce(%x), replica_groups={{0,1}}
  %b = (u8[8]{0}, bf16[3]{0}) all-gather(%y, %z), dimensions={0}
  %c = f32[] add(%a, %b)
"""
TWO_DEVICES = """
import jax
from benchmarks import scaling
options = scaling.sized(scaling.Options(tiny=True))
program = scaling.learner_program(options, 2)
shards = [len(leaf.addressable_shards) for leaf in (program.state.replay.obs, program.state.agent.updates)]
split = program.state.replay.obs.addressable_shards[0].data.shape[1]
for _ in range(2):
    program.state = program.run(program.state)
print(program.work, int(program.state.agent.updates), split, *shards, int(program.state.env_steps))
"""


@pytest.fixture
def machine(monkeypatch):
    """Two devices by name, and programs that only take turns; the order of their calls."""
    calls = []

    def make(options, count):
        def run(state):
            calls.append(count)
            return state + 1

        return Program(run, 0, 1000 * count, 0.5)

    monkeypatch.setattr(scaling, "counts_of", lambda options: (1, 2))
    monkeypatch.setattr(scaling, "env_program", make)
    monkeypatch.setattr(scaling, "learner_program", make)
    return calls


@pytest.mark.quick
def test_efficiencies_are_the_rates_over_so_many_times_that_of_one_device(machine, tmp_path):
    scaling.main(Options(out=tmp_path))
    content = json.loads((tmp_path / "scaling.json").read_text())
    figures = {name: one["value"] for name, one in content["figures"].items()}
    for part, unit in (("env", "steps_per_s"), ("learner", "replayed_steps_per_s")):
        share = figures[f"{part}_{unit}_2"] / (2 * figures[f"{part}_{unit}_1"])
        assert figures[f"{part}_efficiency_2"] == pytest.approx(share)
        assert figures[f"{part}_compile_s_2"] == 0.5


@pytest.mark.quick
def test_device_counts_take_turns_block_by_block(machine, tmp_path):
    scaling.main(Options(out=tmp_path, parts=("learner",), blocks=5))
    assert machine == [1, 2] * 6  # one round is not counted
    figures = json.loads((tmp_path / "scaling.json").read_text())["figures"]
    assert len(figures["learner_replayed_steps_per_s_2"]["repeats"]) == 5


@pytest.mark.quick
def test_more_devices_than_there_are_are_refused():
    with pytest.raises(ValueError, match="devices = 4096, but there are"):
        scaling.main(Options(devices=(1, 4096)))


@pytest.mark.quick
def test_what_devices_send_each_other_is_read_from_the_program():
    assert scaling.exchange(PROGRAM) == {"all-reduce": (1, 32), "all-gather": (1, 14)}


def test_a_block_on_two_devices_makes_the_updates_that_it_counts():
    flags = "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"}
    command = [sys.executable, "-c", TWO_DEVICES]
    answer = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr[-3000:]
    work, updates, streams, *rest = map(int, answer.stdout.splitlines()[-1].split())
    assert work == 2 * 2 * 4 * 2  # devices, sequences, steps, updates
    assert (updates, streams, rest) == (2 * 2, 2, [2, 2, 0])
