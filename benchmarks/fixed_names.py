"""Figures under the names by which they are compared over time: `python -m benchmarks.fixed_names`.

Benchmarks name what they measure by its variants, such as the seed set or the last effect of a ladder. A fixed name
stays the same, whichever variant it is taken from. Each is copied with command, commit, date and device of its source;
a few are counted in the sources or follow from several figures.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.harness import RESULTS, figure, provenance
from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded
from whill_mjx.logs.dataset import write_json

ROOT = Path(__file__).parent.parent
SAME: dict[str, dict[str, str]] = {
    "environment": {"crowd_success": "among_lidar_arrived", "crowd_collisions": "among_lidar_collided",
                    "crowd_blinded": "among_lidar_blinded"},
    "logs": {"small_robot_named_of_10": "own_robot_loop_right"},
    "measured": {"changed_named_of_3": "changed_named", "blocks_false_of_10": "half_false"},
    "sight": {"foreign_stopped_plain": "foreign_with_stop_plain_stopped",
              "rich_wallclock_ratio": "rich_step_time_ratio"},
    "undeclared": {"class_accuracy_2x_noisy": "class_accuracy_2x_noise_2",
                   "interval_width_ratio": "interval_width_ratio_fresh",
                   "noise_factor_coverage": "noise_factor_coverage_noise"},
}  # fmt: skip
"""Of each file, the fixed names of figures that have another name too."""
ELSEWHERE: dict[str, dict[str, tuple[str, str]]] = {
    "speed": {"start_warm_s": ("fit", "cpu_seconds_compiled"), "loop_cpu_s": ("undeclared", "cpu_seconds"),
              "loop_gpu_s": ("undeclared", "gpu_seconds")},
}  # fmt: skip
"""Of each file, the fixed names of figures in other files."""
ON_ANY_DEVICE = ("first_step_cold_s", "first_step_warm_s", "course_cold_s", "course_warm_s", "ppo_99_cold_s",
                 "ppo_99_warm_s")
"""Figures of `speed` that a processor stands in for until an accelerator has measured them."""
Figures = dict[str, dict[str, Any]]


def ladder(figures: Figures) -> Figures:
    """The last rung of the ladder on drive_norlab, and it over the best model that knows nothing of the vehicle."""
    rungs = {int(found[1]): name for name in figures
             if (found := re.fullmatch(r"ladder_all_position_with_(\d+)_\w+", name))}
    if not rungs:
        return {}
    last = figures[rungs[max(rungs)]]
    position = {**last, "of": [rungs[max(rungs)]]}
    peers = [name for name in figures if re.fullmatch(r"peer_\w+_position", name) and name != "peer_ideal_position"]
    if not peers:
        return {"ladder_position": position}
    best = min(peers, key=lambda name: figures[name]["value"])
    ratio = last["value"] / figures[best]["value"]
    over = {**last, **figure([ratio], "ratio", last["device"]), "of": [rungs[max(rungs)], best]}
    return {"ladder_position": position, "ladder_over_best_peer": over}


def lowest_srcc(figures: Figures) -> Figures:
    """The lowest rank correlation of all foreign worlds that were driven in."""
    found = [name for name in figures if re.fullmatch(r"srcc_\w+", name)]
    if not found:
        return {}
    lowest = min(found, key=lambda name: figures[name]["value"])
    return {"srcc": {**figures[lowest], "of": found}}


def standing_in(figures: Figures) -> Figures:
    """Seconds of a processor, where no accelerator has measured them."""
    return {name: {**figures[f"cpu_{name}"], "of": [f"cpu_{name}"]} for name in ON_ANY_DEVICE
            if f"cpu_{name}" in figures and (name not in figures or figures[name]["device"].startswith("cpu"))}


def code_lines(tree: ast.AST) -> int:
    """Lines of code below a node, without those of docstrings."""
    lines = {line for node in ast.walk(tree) if isinstance(node, ast.expr | ast.stmt) and hasattr(node, "lineno")
             for line in (node.lineno, node.end_lineno)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def counted_in_examples(figures: Figures) -> Figures:
    """Lines of the task in examples/parking.py, and files that name the sensor of examples/bumper.py."""
    parking = ast.parse((ROOT / "examples/parking.py").read_text())
    parts = [node for node in parking.body if isinstance(node, ast.Import | ast.ImportFrom | ast.ClassDef)]
    [sensor] = [node for node in ast.parse((ROOT / "examples/bumper.py").read_text()).body
                if isinstance(node, ast.ClassDef)]
    naming = [path for package in ("whill_mjx", "sysid", "dreamer", "bridge")
              for path in (ROOT / package).rglob("*.py") if re.search(rf"\b{sensor.name}\b", path.read_text())]
    return {"own_task_lines": figure([float(sum(map(code_lines, parts)))], "count", "counted"),
            "files_per_new_sensor": figure([1.0 + len(naming)], "count", "counted")}


DERIVED: dict[str, Callable[[Figures], Figures]] = {
    "measured": ladder, "sight": lowest_srcc, "environment": counted_in_examples, "speed": standing_in,
}  # fmt: skip
"""Of each file, what follows from its figures or from the sources."""


def read_figures(stem: str) -> Figures:
    """The figures of a result file."""
    return dict(json.loads((RESULTS / f"{stem}.json").read_text())["figures"])


def fixed(stem: str, figures: Figures) -> Figures:
    """The figures of a file under their fixed names."""
    same = {name: {**figures[source], "of": [source]} for name, source in SAME.get(stem, {}).items()
            if source in figures}
    for name, (other, source) in ELSEWHERE.get(stem, {}).items():
        there = read_figures(other)
        if source in there:
            same[name] = {**there[source], "of": [f"{other}: {source}"]}
    return {**same, **DERIVED.get(stem, lambda _: {})(figures)}


def main(arguments: list[str] | None = None) -> None:
    """Write the fixed names into all result files."""
    Parser(prog="python -m benchmarks.fixed_names", description=__doc__).parse_args(arguments)
    for stem in sorted({*SAME, *ELSEWHERE, *DERIVED}):
        path = RESULTS / f"{stem}.json"
        content = json.loads(path.read_text())
        found = fixed(stem, content["figures"])
        for name, one in found.items():
            print(f"{stem}: {name} {one['value']:.4g} {one['unit']}")
        content["figures"].update({name: {**provenance(), **one} for name, one in found.items()})
        write_json(path, content)


if __name__ == "__main__":
    with guarded():
        main()
