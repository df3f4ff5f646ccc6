"""What loops over ROS 2 found, beside what was true."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.bridge import CLAIM
from benchmarks.harness import figure, record
from benchmarks.plant.effects import EFFECTS
from whill_mjx.io.command_line import OptionError


def summary(out: Path) -> dict[str, Any]:
    """What a run found and what was true: the only place where the answer is read."""
    answers = out / "answers.json"
    truth = json.loads(answers.read_text())["effects"] if answers.exists() else {}
    found: dict[str, Any] = {"truth": truth, "stages": {}}
    done = sorted((out / "stages").glob("*.json"), key=lambda path: path.stat().st_mtime)
    found["stages"] = {path.stem: json.loads(path.read_text()) for path in done}
    for stage in ("loop", "loop_again"):
        path = out / stage / "report.json"
        if path.exists():
            report = json.loads(path.read_text())
            found[stage] = {"verdict": report["verdict"], "effects": report["effects"],
                            "named": any((EFFECTS[name].covered or name) in one["class"]
                                         for name in truth for one in report["effects"]),
                            "held_out_removed": removed(report)}
    return found


def removed(report: dict[str, Any]) -> float | None:
    """Share of the error on held-out drives, beyond what repeats of them differ by, that the loop removed.

    Where one replicate gives no such floor, it counts as 0.
    """
    before, after = (report[name]["held_out"].get("ground_truth") for name in ("before", "after"))
    if not before or not after:
        return None
    floor = (before.get("noise_floor") or {}).get("trajectory") or 0.0
    excess = before["trajectory"] - floor
    return 1 - (after["trajectory"] - floor) / excess if excess > 0 else None


def collect(runs: tuple[Path, ...]) -> None:
    """Record how often the effect was named, and the held-out error that was removed."""
    found = [summary(run) for run in runs]
    last = [one.get("loop_again") or one.get("loop") or {} for one in found]
    for path, verdict in zip(runs, last, strict=True):
        if not verdict:
            raise OptionError(f"--collect {path}: has no verdict. Finish its loop first.")
    named = [float(one["named"]) for one in last]
    gains = [one["held_out_removed"] for one in last if one["held_out_removed"] is not None]
    draws = [f"{name} {size:.3g}" for one in found for name, size in one["truth"].items()]
    about = {"count": len(runs), "draws": draws, "verdicts": [one["verdict"] for one in last], "named": named}
    figures = {
        "loop_named": {**figure([sum(named)], f"of {len(runs)} draws: the effect is in the class of a named one"),
                       **about},
        "loop_heldout_removed": {
            **figure(gains, "share of the held-out position error, beyond what replicates differ by"), **about},
    }
    if len(runs) == 10:
        figures["loop_named_of_10"] = figures["loop_named"]
    print(record("bridge", CLAIM, figures))
