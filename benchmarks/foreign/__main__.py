"""Drive a policy in foreign corridors: `python -m benchmarks.foreign --policy NAME=FOLDER --drives 200 --out FILE`.

Needs MUJOCO_GL=egl or osmesa where there is no display. Drives are spread over processes.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.drivers import CONTROLS
from benchmarks.foreign.room import GOAL, VARIANTS

STEPS = 300
"""Commands of a drive at most."""
MOUNT = {"x": 0.532, "y": 0.0, "z": 0.682, "roll": 0.0, "pitch": 0.15, "yaw": 0.0, "fov_y": 1.2}
"""Camera of the drivers that need none."""


def drive(variant: str, seed: int, driver: str, policy: Any = None, frames: list | None = None) -> dict[str, Any]:
    """One drive: how it ended, after how many commands, and what was seen, if `frames` is a list."""
    from benchmarks.foreign.camera import Camera
    from benchmarks.foreign.drive import SteppedPlant
    from benchmarks.foreign.drivers import Planner, Sighted
    from benchmarks.foreign.room import make_room
    from benchmarks.plant.chair import Chair

    room = make_room(variant, seed)
    random = np.random.default_rng([seed, 13])
    plant = SteppedPlant(Chair().on_day(random), room.start, random)
    mount = MOUNT if policy is None else dict(policy.contract.camera)
    camera = Camera(room.model, mount, variant == "plain", np.random.default_rng([seed, 14, VARIANTS.index(variant)]))
    planner = Planner(room) if driver == "planner" else None
    sighted = None if policy is None else Sighted(policy, driver if driver in ("blank", "frozen") else "policy")
    size = 64 if policy is None else policy.contract.height
    novelty: list[float] = []
    end, steps, image = "timeout", 0, np.zeros((size, size, 3), np.uint8)
    try:
        for steps in range(1, STEPS + 1):
            pose = plant.pose()
            camera.place(pose)
            if camera.touches():
                end = "collided"
                break
            if (pose.x - GOAL[0]) ** 2 + (pose.y - GOAL[1]) ** 2 <= 1.0:
                end = "arrived"
                break
            looks = driver == "policy" or (driver == "frozen" and steps == 1)
            if frames is not None or looks:
                image = camera.image(size)
                if frames is not None:
                    frames.append(image)
            if planner is not None:
                command = planner.command(pose)
            elif sighted is not None:
                command = sighted.command(image)
                novelty.append(round(float(getattr(policy, "novelty", 0.0)), 3))
            else:
                command = (0.3, 0.0)
            plant.advance(*command)
    finally:
        camera.close()
    return {"variant": variant, "seed": seed, "driver": driver, "end": end, "steps": steps, "novelty": novelty}


_POLICIES: dict[str, Any] = {}


def _job(job: tuple[str, int, str, str, str]) -> dict[str, Any]:
    variant, seed, name, source, driver = job
    from benchmarks.foreign.drivers import load

    if source and source not in _POLICIES:
        _POLICIES[source] = load(source)
    policy = _POLICIES.get(source)
    return {**drive(variant, seed, driver, policy), "policy": name}


def main() -> None:
    """Drive, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.foreign", description=__doc__)
    parser.add_argument("--policy", nargs="*", default=[], metavar="NAME=FOLDER", help="policy files")
    parser.add_argument("--controls", nargs="*", default=[], choices=CONTROLS, help="of the first policy")
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--drives", type=int, default=200, help="of each policy in each variant")
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=Path("foreign.json"))
    options = parser.parse_args()
    named = [text.split("=", 1) for text in options.policy]
    jobs: list[tuple[str, int, str, str, str]] = []
    for variant in options.variants:
        for seed in range(options.first_seed, options.first_seed + options.drives):
            jobs += [(variant, seed, name, source, "policy") for name, source in named]
            for control in options.controls:
                sighted = control in ("blank", "frozen")
                name, source = named[0] if sighted else (control, "")
                jobs.append((variant, seed, name if sighted else control, source, control))
    began = time.perf_counter()
    context = multiprocessing.get_context("spawn")
    with context.Pool(options.processes) as pool:
        results = list(pool.imap_unordered(_job, jobs, chunksize=2))
    options.out.write_text(json.dumps({"seconds": time.perf_counter() - began, "drives": results}))
    for line in table(results):
        print(line)


def table(results: list[dict[str, Any]]) -> list[str]:
    """One line for every driver and variant."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for one in results:
        groups.setdefault((one["policy"], one["driver"], one["variant"]), []).append(one["end"])
    lines = []
    for (policy, driver, variant), ends in sorted(groups.items()):
        shares = ", ".join(f"{end} {ends.count(end) / len(ends):.1%}" for end in ("arrived", "collided", "timeout"))
        lines.append(f"{policy:12s} {driver:9s} {variant:10s} {len(ends):4d} drives: {shares}")
    return lines


if __name__ == "__main__":
    main()
