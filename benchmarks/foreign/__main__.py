"""Drive a policy in foreign rooms: `python -m benchmarks.foreign --policy NAME=FOLDER --drives 200 --out FILE`.

Needs MUJOCO_GL=egl or osmesa where there is no display. Drives are spread over processes.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from benchmarks.foreign.drivers import CONTROLS, WITH_STOP, load
from benchmarks.foreign.plan import PLANS
from benchmarks.foreign.room import VARIANTS
from benchmarks.foreign.run import Job, drive_all
from bridge.nodes.options import Parser, whole
from whill_mjx.io.command_line import guarded


def main() -> None:
    """Drive, print and write."""
    parser = Parser(prog="python -m benchmarks.foreign", description=__doc__)
    parser.add_argument("--policy", nargs="*", default=[], metavar="NAME=FOLDER", help="policy files")
    parser.add_argument("--controls", nargs="*", default=[], choices=CONTROLS, help="of the first policy")
    parser.add_argument("--with-stop", action="store_true", help="drive each policy with the limits of its file too")
    parser.add_argument("--task", choices=PLANS, help="whose ground plan; without it, the task of the policies")
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--drives", type=whole(), default=200, help="of each policy in each variant")
    parser.add_argument("--first-seed", type=whole(0), default=5000)
    parser.add_argument("--processes", type=whole(), default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=Path("foreign.json"))
    options = parser.parse_args()
    named = [text.split("=", 1) for text in options.policy]
    drivers = ["policy", *([WITH_STOP] if options.with_stop else [])]
    policies = {source: load(source, drivers[-1]) for _, source in named}  # refused before anything is driven
    task = options.task or task_of({source: one.contract.task for source, one in policies.items()})
    jobs: list[Job] = []
    for variant in options.variants:
        for seed in range(options.first_seed, options.first_seed + options.drives):
            jobs += [(task, variant, seed, name, source, driver) for name, source in named for driver in drivers]
            for control in options.controls:
                sighted = control in ("blank", "frozen")
                name, source = named[0] if sighted else (control, "")
                jobs.append((task, variant, seed, name if sighted else control, source, control))
    results = drive_all(jobs, options.processes, options.out)
    for line in table(results):
        print(line)


def task_of(tasks: dict[str, str]) -> str:
    """The task that all policies have learned, by their folders; the corridor where there are none.

    Raises:
        ValueError: there is no room for a task, or the tasks differ.
    """
    for source, task in tasks.items():
        if task not in PLANS:
            raise ValueError(f"{source}/policy.json: task is {task!r}; there are rooms for {', '.join(PLANS)}. Choose "
                             "one of them with --task.")
        if task != next(iter(tasks.values())):
            both = ", ".join(f"{source} {task}" for source, task in tasks.items())
            raise ValueError(f"the policies have learned different tasks ({both}). Drive those of one task, or choose "
                             "it with --task.")
    return next(iter(tasks.values()), "corridor")


def table(results: list[dict[str, Any]]) -> list[str]:
    """One line for every driver and variant."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for one in results:
        groups.setdefault((one["policy"], one["driver"], one["variant"]), []).append(one["end"])
    lines = []
    for (policy, driver, variant), ends in sorted(groups.items()):
        known = ("arrived", "collided", "timeout", *(["stopped"] if driver == WITH_STOP else []))
        shares = ", ".join(f"{end} {ends.count(end) / len(ends):.1%}" for end in known)
        lines.append(f"{policy:12s} {driver:9s} {variant:10s} {len(ends):4d} drives: {shares}")
    return lines


if __name__ == "__main__":
    with guarded():
        main()
