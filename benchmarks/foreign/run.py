"""One drive in a foreign room, and many of them spread over processes."""

from __future__ import annotations

import json
import multiprocessing
import random as stdlib_random
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.camera import Camera
from benchmarks.foreign.drive import SteppedPlant
from benchmarks.foreign.drivers import Planner, Sighted, load
from benchmarks.foreign.room import VARIANTS, make_room
from benchmarks.plant.chair import Chair

STEPS = 300
"""Commands of a drive at most."""
MOUNT = {"x": 0.532, "y": 0.0, "z": 0.682, "roll": 0.0, "pitch": 0.15, "yaw": 0.0, "fov_y": 1.2}
"""Camera of the drivers that need none."""


def drive(
    variant: str, seed: int, driver: str, policy: Any = None, frames: list | None = None, task: str = "corridor"
) -> dict[str, Any]:
    """One drive: how it ended, after how many commands, and what was seen, if `frames` is a list.

    It ends as "stopped" where the policy stopped for good, and nothing was reached or touched after that.
    """
    room = make_room(variant, seed, task)
    goal = room.plan.goal
    random = np.random.default_rng([seed, 13])
    plant = SteppedPlant(Chair().on_day(random), room.plan.start, random)
    mount = MOUNT if policy is None else dict(policy.contract.camera)
    camera = Camera(room.model, mount, variant == "plain", np.random.default_rng([seed, 14, VARIANTS.index(variant)]))
    planner = Planner(room) if driver == "planner" else None
    sighted = None if policy is None else Sighted(policy, driver)
    size = 64 if policy is None else policy.contract.height
    novelty: list[float] = []
    end, steps, image = "timeout", 0, np.zeros((size, size, 3), np.uint8)
    try:
        while steps < STEPS:
            steps += 1
            pose = plant.pose()
            camera.place(pose)
            if camera.touches():
                end = "collided"
                break
            if (pose.x - goal[0]) ** 2 + (pose.y - goal[1]) ** 2 <= 1.0:
                end = "arrived"
                break
            if frames is not None or (sighted is not None and sighted.looks):
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
            plant.drive_period(*command)
        if end == "timeout" and sighted is not None and sighted.stopped:
            end = "stopped"
    finally:
        camera.close()
    return {"task": task, "variant": variant, "seed": seed, "driver": driver, "end": end, "steps": steps,
            "novelty": novelty}  # fmt: skip


_POLICIES: dict[str, Any] = {}


Job = tuple[str, str, int, str, str, str]
"""Task, variant, seed, name and folder of the policy, driver."""


def _job(job: Job) -> dict[str, Any]:
    task, variant, seed, name, source, driver = job
    if source and source not in _POLICIES:
        _POLICIES[source] = load(source, driver)
    policy = _POLICIES.get(source)
    return {**drive(variant, seed, driver, policy, task=task), "policy": name}


def drive_all(jobs: Sequence[Job], processes: int, out: Path) -> list[dict[str, Any]]:
    """Results of all jobs, in any order; `out` holds those so far, so that an interrupted run is not lost."""
    began, results = time.perf_counter(), []
    mixed = stdlib_random.Random(0).sample(list(jobs), len(jobs))  # so that those so far are of all kinds
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for result in pool.imap_unordered(_job, mixed, chunksize=1):
            results.append(result)
            if len(results) % 10 == 0 or len(results) == len(jobs):
                content = {"seconds": time.perf_counter() - began, "planned": len(jobs), "drives": results}
                partial = out.with_suffix(".partial")
                partial.write_text(json.dumps(content))
                partial.replace(out)
    return results
