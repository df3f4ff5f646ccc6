"""A policy brings its world: simulator and evaluation take task, gates, vehicle and camera from it or its training."""

from __future__ import annotations

import json

import marker_seeker
import pytest

from bridge.policy import PolicyFileError
from bridge.simulate import parse_arguments
from bridge.simulation.simulator_choice import make_vehicle
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.policies.policy_file import load_policy
from whill_mjx.evaluation.policies.policy_world import find_policy, read_world
from whill_mjx.evaluation.preparation import choose_task


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training with one gate, a fixed layout and images of 48 x 48, and its policy."""
    run = tmp_path_factory.mktemp("training")
    marker_seeker.write(run / "policy", size=48)
    task = {"gates": 1, "layout": "fixed", "v_min": -0.5, "action_repeat": 5, "no_field_any_more": 3}
    (run / "run.json").write_text(json.dumps({"kind": "x", "identity": {}, "preset": {"task": task}}))
    return run


class Simulator:
    """Stands for a simulator and keeps what it was made with."""

    def __init__(self, **given):
        self.given = given


@pytest.fixture
def simulate(monkeypatch):
    monkeypatch.setattr("bridge.simulation.chair_simulator.ChairSimulator", Simulator)
    return lambda *words: make_vehicle(parse_arguments([str(word) for word in words])).given


@pytest.mark.parametrize("place", ["policy", "."])
def test_the_simulator_takes_the_world_of_the_policy_or_of_its_training(trained, simulate, place):
    given = simulate(trained / place)
    assert given["task"] == "obstacle_course" and given["size"] == (48, 48)
    assert given["gates"] == 1 and given["layout"] == "fixed"
    assert given["v_min"] == marker_seeker.LOW[0]  # the policy's own limits count
    assert "no_field_any_more" not in given


def test_options_of_the_simulator_come_before_the_policys_world(trained, simulate):
    given = simulate(trained, "--set", "gates=2", "--vehicle", "husky")
    assert given["gates"] == 2 and given["vehicle"] == "husky" and given["layout"] == "fixed"
    other = simulate(trained, "--task", "corridor")
    assert other["task"] == "corridor" and "gates" not in other


def test_without_a_policy_the_simulator_serves_the_corridor(simulate):
    assert simulate() == {"task": "corridor", "vehicle": None}


def test_an_evaluation_takes_the_layout_of_the_training_too(trained):
    policy = load_policy(find_policy(trained))
    task = choose_task(EvaluateOptions(str(trained)), policy)
    assert (task.gates, task.layout, task.action_repeat) == (1, "fixed", 2)
    assert choose_task(EvaluateOptions(str(trained), layout="randomised"), policy).layout == "randomised"


def test_the_world_of_no_policy_is_refused_and_so_is_a_damaged_note(trained, tmp_path):
    with pytest.raises(PolicyFileError, match="policy.json"):
        read_world(tmp_path)
    marker_seeker.write(tmp_path / "policy")
    assert read_world(tmp_path).fields == {"v_min": 0.0, "v_max": marker_seeker.HIGH[0], "omega_max": 1.0,
                                           "action_repeat": 2}  # fmt: skip
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ValueError, match="run.json: not valid JSON"):
        read_world(tmp_path / "policy")
