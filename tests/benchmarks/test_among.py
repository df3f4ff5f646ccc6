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


@pytest.mark.quick
def test_a_sight_that_lacks_is_judged_and_the_others_stay_as_they_were(tmp_path, monkeypatch):
    options = among.Options(runs=("lidar:0",), out=tmp_path, results=tmp_path / "results", **TINY)
    ends = dict(arrived=0.25, collided=0.5, timeout=0.25, bumped=0.0)
    took = {"decisions": 8, "training_s": 1.0, "updates": 1, "device": "cpu"}
    judged = {"blank": ends, "freeze": ends, "lost": ends}
    with among.held_run(options, "lidar", 0) as folder:
        (folder / "training.json").write_text(json.dumps(took))
        (folder / "result.json").write_text(json.dumps({"sights": judged}))
    monkeypatch.setattr(among, "weights_of", lambda *given: None)
    monkeypatch.setattr(among, "write_policy", lambda *given: None)
    monkeypatch.setattr(among, "judge", lambda options, preset, params, sights: {
        **{sight: {**ends, "arrived": 1.0} for sight in sights}, "maps": {"made:7": ends}})
    among.main(dataclasses.replace(options, sights=("open",)))
    found = json.loads((folder / "result.json").read_text())["sights"]
    assert {sight: found[sight]["arrived"] for sight in among.SIGHTS} == {
        "open": 1.0, "blank": 0.25, "freeze": 0.25, "lost": 0.25}
    figures = json.loads((tmp_path / "results" / "environment.json").read_text())["figures"]
    assert figures["among_lidar_arrived"]["value"] == 1.0 and figures["among_lidar_blinded"]["value"] == 0.25


def test_a_run_is_named_by_senses_and_seed_and_sights_by_their_names(tmp_path):
    with pytest.raises(OptionError, match="--runs radar:0"):
        among.main(among.Options(runs=("radar:0",), out=tmp_path))
    for sights in ((), ("blank",), ("open", "dark")):
        with pytest.raises(OptionError, match="give open first, then some of open, blank, freeze, lost"):
            among.main(among.Options(runs=("lidar:0",), sights=sights, out=tmp_path))
