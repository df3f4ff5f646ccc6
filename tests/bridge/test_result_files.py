"""Result files of the bridge: an option names one, and one of somebody is not replaced."""

from __future__ import annotations

import argparse
import json
from collections import deque
from types import SimpleNamespace

import pytest

from bridge.nodes.options import result_file
from bridge.simulation.simulate_node import RESULTS, SimulateNode

pytestmark = pytest.mark.quick


def test_a_results_file_replaces_only_an_earlier_one_of_its_command(tmp_path):
    path, read = tmp_path / "results.json", result_file("counts", "reason")
    assert read(str(path)) == path
    path.write_text(json.dumps({"counts": {"frames": 3}, "reason": ""}))
    assert read(str(path)) == path
    for other in ("", "mine", "[]", "{}", '{"counts": 1}', '{"counts": 1, "reason": "", "mine": 2}', "[" * 100_000):
        path.write_text(other)
        with pytest.raises(argparse.ArgumentTypeError, match="results.json: exists already"):
            read(str(path))
        assert path.read_text() == other


def test_the_results_of_a_simulation_are_known_by_their_keys():
    ended = SimpleNamespace(command_log=deque([(0.0, 0.1, 0.0)]), episodes=[], image_times=deque(), delays=deque())
    assert set(SimulateNode.results(ended)) == set(RESULTS)
