"""The training command from end to end, in a tiny size: what it leaves behind, resuming, and bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from whill_mjx.train import TrainOptions, main, prepare_vehicle
from whill_mjx.training import find_preset, wilson_interval


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of the smoke preset with a built-in vehicle."""
    options = TrainOptions(
        out=tmp_path_factory.mktemp("run"), vehicle=Path("whill_cr_ramp"), preset="smoke", steps=200, episodes=8
    )
    return options, main(options)


def test_a_run_leaves_everything_a_user_needs(run):
    options, evaluation = run
    left = {path.name for path in options.out.iterdir()}
    assert left >= {
        "config.json", "vehicle.toml", "metrics.jsonl", "reward_curve.png", "drives.png", "camera.mp4", "drives.npz",
        "evaluation.json", "checkpoints", "policy",
    }  # fmt: skip
    assert {"policy.json", "policy.onnx", "weights.npz", "vehicle.toml"} <= {
        path.name for path in (options.out / "policy").iterdir()
    }
    assert json.loads((options.out / "evaluation.json").read_text())["policy"]["episodes"] == 8
    for driver in ("policy", "random"):
        figures = evaluation[driver]
        assert figures["success"] + figures["collision"] + figures["timeout"] + figures["diverged"] == pytest.approx(1)


def test_the_same_command_again_goes_on_from_the_end_and_gives_the_same_policy(run):
    options, before = run
    lines = (options.out / "metrics.jsonl").read_text()
    again = main(options)
    assert again["env_steps"] == before["env_steps"] and again["updates"] == before["updates"]
    assert again["policy"] == before["policy"]
    assert (options.out / "metrics.jsonl").read_text() == lines


def test_the_exported_policy_runs_on_the_bridge_and_gives_commands_within_the_limits(run):
    from bridge.policy import Policy

    options, _ = run
    policy = Policy.load(options.out / "policy")
    policy.reset()
    frames = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    for frame in frames:
        v, omega = policy.step(frame)
        assert 0.0 <= v <= 1.0 and -1.0 <= omega <= 1.0


@pytest.mark.quick
def test_a_bad_vehicle_file_is_refused_before_anything_is_written(tmp_path):
    bad = tmp_path / "vehicle.toml"
    bad.write_text("schema = 9\nkind = 'micromobility-vehicle'\n")
    with pytest.raises(ValueError, match="schema is 9; this version reads schema 1"):
        prepare_vehicle(TrainOptions(out=tmp_path / "run", vehicle=bad))
    assert not (tmp_path / "run").exists()


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "task", "message"), [("gpu", "corridor", "unknown preset"), ("cpu", "x", "unknown task")]
)
def test_unknown_presets_and_tasks_are_named(name, task, message):
    with pytest.raises(ValueError, match=message):
        find_preset(name, task)


@pytest.mark.quick
def test_wilson_interval_known_values():
    """98 of 100: 0.930 to 0.994 (Wilson, 95 %), from the closed form worked by hand."""
    np.testing.assert_allclose(wilson_interval(98, 100), (0.930, 0.9945), atol=5e-4)
    low, high = wilson_interval(0, 20)
    assert low == pytest.approx(0.0, abs=1e-12) and 0.15 < high < 0.17
