"""Seconds until a newcomer has a first result: `python -m benchmarks.first_hour --parts picture vehicle effect`.

The commands are those of README, in a new folder, with no compiled programs kept; the installation is not counted.
Pin the process to two cores to compare (`taskset -c 0,1`). `--parts pages` counts pages with a picture, and the
tutorials whose seconds `benchmarks.tutorials run --record` has written at this release.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.harness import RESULTS, figure, record
from benchmarks.tutorials import CLAIM, ROOT, surroundings, workplace
from bridge.nodes.options import Parser, in_range
from whill_mjx import __version__
from whill_mjx.io.command_line import guarded

PARTS = {
    "picture": ("python -m whill_mjx.look --out runs/look.png",),
    "vehicle": ("python -m sysid.fit sysid/data/chair --out runs/chair",),
    "effect": (
        "for day in 1 2 3; do python -m benchmarks.plant --out logs/day$day --seed $day; done",
        "python -m benchmarks.plant --out logs/today --seed 11 --effects '{\"wheel_radius_difference\": 0.012}'",
        "python -m sysid.close_loop logs/today --reference logs/day1 logs/day2 logs/day3 --quick "
        "--out runs/loop",
    ),
}
"""What README asks a newcomer to type, by the first result that it gives."""


def seconds_of(lines: tuple[str, ...]) -> float:
    """Seconds that the lines take in a new folder, with an empty folder of compiled programs.

    Raises:
        RuntimeError: a line failed.
    """
    with tempfile.TemporaryDirectory() as place, workplace(Path(place)):
        given = {**surroundings(), "XDG_CACHE_HOME": str(Path(place) / "cache")}
        began = time.perf_counter()
        done = subprocess.run(["bash", "-e", "-c", "\n".join(lines)], env=given)
        if done.returncode:
            raise RuntimeError(f"bash ended with {done.returncode}.")
        return time.perf_counter() - began


def counted() -> dict[str, dict]:
    """Figures of what is there: pages with a picture or a diagram, and tutorials that were run at this release."""
    texts = [page.read_text() for page in (ROOT / "docs").rglob("*.md")]
    shown = sum(bool(re.search(r"!\[|^```mermaid", text, re.MULTILINE)) for text in texts)
    path = RESULTS / "people.json"
    known = json.loads(path.read_text())["figures"] if path.exists() else {}
    run = [name for name, one in known.items()
           if re.fullmatch(r"tutorial_\d_s", name) and one["release"] == __version__]  # fmt: skip
    return {"pages_with_picture": figure([shown / len(texts)], "share", "counted"),
            "tutorials_executed": figure([len(run)], "count", "counted")}  # fmt: skip


def main() -> None:
    """Measure and record."""
    parser = Parser(prog="python -m benchmarks.first_hour", description=__doc__,
                    formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument(
        "--parts", nargs="+", choices=[*PARTS, "pages"], default=[*PARTS, "pages"], help="what to measure"
    )
    parser.add_argument("--repeats", type=in_range(1, 100, int), default=1, help="how often each is measured")
    given = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for part in given.parts:
        if part == "pages":
            print(record("people", CLAIM, counted()))
            continue
        repeats = [seconds_of(PARTS[part]) for _ in range(given.repeats)]
        print(record("people", CLAIM, {f"clone_to_{part}_s": figure(repeats, "s")}), part, repeats, flush=True)


if __name__ == "__main__":
    with guarded():
        main()
