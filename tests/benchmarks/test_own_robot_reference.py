"""When the benchmark of a robot of one's own makes its reference anew."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

pytest.importorskip("mujoco")

from benchmarks import own_robot, undeclared_reference  # noqa: E402
from sysid.verdict.result import LoopConfig  # noqa: E402


@dataclass(frozen=True)
class Vehicle:
    """What `load_fitted` gives, as far as it is read here."""

    kept: bool = True


@pytest.mark.quick
def test_a_reference_is_kept_for_the_same_days_settings_code_and_robot_only(tmp_path, monkeypatch):
    made = []

    def reference_for(day, days, loop, vehicle):
        made.append((len(days), loop.quick))
        return f"reference {len(made)}"

    monkeypatch.setattr(own_robot, "drive", lambda folder, *_: folder)
    monkeypatch.setattr(own_robot, "load_log", lambda path: SimpleNamespace(sha256=path.name, spec="small"))
    monkeypatch.setattr(own_robot, "of_file", lambda day, *_: day)
    monkeypatch.setattr(own_robot, "load_fitted", lambda _: ("small", Vehicle()))
    monkeypatch.setattr(own_robot, "reference_for", reference_for)
    monkeypatch.setattr(own_robot, "prepare", lambda reference, *_: reference)
    fitted = tmp_path / "fit" / "vehicle.toml"
    fitted.parent.mkdir()
    fitted.write_text("one")

    def ready(days=4, quick=False):
        return own_robot.ready_robot(own_robot.Benchmark(out=tmp_path, days=days), LoopConfig(quick=quick))[0]

    assert [ready(), ready()] == ["reference 1"] * 2
    assert [ready(days=2), ready(quick=True), ready()] == ["reference 2", "reference 3", "reference 1"]
    assert made == [(4, False), (2, False), (4, True)]
    fitted.write_text("another")
    assert ready() == "reference 4"
    monkeypatch.setattr(undeclared_reference, "code_hashes", lambda: {"sysid": "later"})
    assert ready() == "reference 5"
