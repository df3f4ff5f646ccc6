"""The benchmark of policies among people, at a size that shows only that it runs."""

from __future__ import annotations

import dataclasses
import json

import pytest

from benchmarks import among
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.folders import FolderRefused

TINY = dict(trained=("made:0",), made=0, unseen=("made:7", "made:8"), minutes=0.01, instances=2, episodes=4,
            set=("people=2", "max_steps=20"),
            change=("rollout=4", "minibatches=2", "epochs=1", "width=16", "channels=[8, 8, 8]"))  # fmt: skip


def test_a_run_is_trained_judged_and_not_made_again(tmp_path):
    options = among.Options(runs=("lidar:0",), out=tmp_path / "runs", results=tmp_path / "results", **TINY)
    among.main(options)
    figures = json.loads((tmp_path / "results" / "environment.json").read_text())["figures"]
    result = json.loads((tmp_path / "runs/lidar_0/result.json").read_text())
    for sight in among.SIGHTS:
        ends = result["sights"][sight]
        assert ends["arrived"] + ends["collided"] + ends["timeout"] == pytest.approx(1.0)
        assert ends["people"] == 2.0
    assert {place: one["episodes"] for place, one in result["sights"]["maps"].items()}.keys() <= set(options.unseen)
    assert sum(one["episodes"] for one in result["sights"]["maps"].values()) == 4
    assert figures["among_lidar_arrived"]["value"] == result["sights"]["open"]["arrived"]
    assert (tmp_path / "runs/lidar_0/policy/policy.json").exists()
    changed = {**result, "sights": {**result["sights"], "open": {**result["sights"]["open"], "arrived": 0.625}}}
    (tmp_path / "runs/lidar_0/result.json").write_text(json.dumps(changed))
    among.main(options)
    figures = json.loads((tmp_path / "results" / "environment.json").read_text())["figures"]
    assert figures["among_lidar_arrived"]["value"] == 0.625


@pytest.mark.quick
@pytest.mark.parametrize("name, value", [
    ("minutes", 0.02), ("instances", 4), ("trained", ("made:1",)), ("unseen", ("made:7",)), ("episodes", 8),
    ("set", ()), ("change", ()), ("made", 1), ("seed", 5)])
def test_a_run_of_other_options_is_refused_before_any_training(tmp_path, monkeypatch, name, value):
    monkeypatch.setattr(among, "train", lambda *given: pytest.fail("trained"))
    options = among.Options(runs=("lidar:0",), out=tmp_path, results=tmp_path / "results", **TINY)
    with among.held_run(options, "lidar", 0) as folder:
        (folder / "training.json").write_text("{}")
    asked = dataclasses.replace(options, runs=("both:0", "lidar:0"), **{name: value})
    with pytest.raises(FolderRefused, match=f"lidar_0: holds another run: {name} is"):
        among.main(asked)
    with among.held_run(dataclasses.replace(options, runs=(), results=tmp_path), "lidar", 0):
        pass  # where figures go and which runs are made changes no result


def test_a_run_is_named_by_senses_and_seed(tmp_path):
    with pytest.raises(OptionError, match="--runs radar:0"):
        among.main(among.Options(runs=("radar:0",), out=tmp_path))
