"""Writes benchmarks/README.md from benchmarks/results/*.json: `python -m benchmarks.tables`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from benchmarks.harness import RESULTS

HEAD = """# Benchmarks

One script per claim. Each writes `results/<name>.json` (claim, command, versions, commit, every repeat); this page is
made from those files by `python -m benchmarks.tables`. Values are medians; machines are shared, so ratios say more than
single times.

| script | what it measures |
|---|---|
| `python -m benchmarks.physics` | physics steps/s of the free chassis with the paper's and the physical base model |
| `python -m benchmarks.camera` | 64x64 RGB frames/s of the camera in plain JAX, 32 boxes |
| `python -m benchmarks.environment` | control steps/s of the obstacle course, image included |
| `python -m benchmarks.learner` | DreamerV3 updates/s |
| `python -m benchmarks.course` | trainings of the obstacle course, every seed; the ground-truth planner |
| `python -m benchmarks.fit` | fits against planted truth, contact-plant logs and measured robots |
| `python -m benchmarks.bridge` | latencies, stops and losses of the ROS 2 bridge |

All run on a CPU as well, in smaller sizes. The logs of measured robots are other people's: the script reads them from
the folder that `--shared` names.
"""
TITLES = {
    "physics": "Physics",
    "camera": "Camera",
    "environment": "Environment",
    "learner": "Learner",
    "course": "Obstacle course",
    "fit": "Fit: planted truth and contact-plant logs",
    "measured": "Fit: measured robots",
    "bridge": "Bridge",
}
PICTURES = "course_*.png"


def table(content: dict[str, Any]) -> str:
    """Markdown table of the figures of one result file."""
    rows = ["| figure | value | unit | repeats | device | commit |", "|---|---|---|---|---|---|"]
    for name, entry in sorted(content["figures"].items()):
        repeats = entry["repeats"]
        shown = ", ".join(number(value) for value in repeats) if 1 < len(repeats) <= 5 else str(len(repeats))
        commit = entry.get("commit", content["commit"])[:7]
        rows.append(f"| {name} | {number(entry['value'])} | {entry['unit']} | {shown} | {entry['device']} | {commit} |")
    return "\n".join(rows)


def number(value: float) -> str:
    """Four significant digits; thousands separated."""
    if value is None:
        return "-"
    if abs(value) >= 10_000:
        return f"{value:,.0f}"
    return f"{value:.4g}"


def page(results: Path) -> str:
    """The whole page."""
    parts = [HEAD]
    for stem, title in TITLES.items():
        path = results / f"{stem}.json"
        if path.exists():
            content = json.loads(path.read_text())
            commands = sorted({entry.get("command", content["command"]) for entry in content["figures"].values()})
            made = "Made by " + "; ".join(f"`{command}`" for command in commands) + "."
            parts.append(f"## {title}\n{content['claim']}.\n\n{table(content)}\n\n{made}\n")
            if stem == "course":
                parts += [f"![{picture.stem}](results/{picture.name})\n" for picture in sorted(results.glob(PICTURES))]
    return "\n".join(parts)


def main() -> None:
    """Write the page."""
    path = RESULTS.parent / "README.md"
    temporary = path.with_suffix(".tmp")
    temporary.write_text(page(RESULTS))
    os.replace(temporary, path)
    print(path)


if __name__ == "__main__":
    main()
