"""What makes a training the same one: vehicle, data, seed, task, learner, and every setting that changes its result."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from whill_mjx.learning.setup import Preset
from whill_mjx.logs.dataset import plain
from whill_mjx.tasks.tasks import source_of
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams

KIND = "whill_mjx.train"
OUTPUTS = ("config.json", "best", "best.json", "policy_best", "policy_last", "drives.npz", "stopped.json",
           "reward_curve.png", "drives.png", "failures.png", "camera.mp4", "failures.mp4", "prediction.gif",
           "index.html", "tensorboard")  # fmt: skip
"""Names that a training writes besides the results that all commands share."""
LATER = ("y", "roll", "yaw")
"""Fields of the camera that older vehicles do not have; at zero they change nothing."""
NEUTRAL = ("rolling_resistance_speed.growth",)
"""Parameters of effects likewise."""
SETTINGS = ("task", "safety", "instances", "eval_every", "eval_episodes", "exploring_starts", "second_tries",
            "looks", "spread", "vary")
"""Fields of a preset that change the result of both learners; evaluations choose the best parameters."""


def identity_of(preset: Preset, learner: str, seed: int, vehicle: str, data: str | None) -> dict[str, Any]:
    """Name -> value of everything that changes the result of a training.

    Args:
        preset: with the options' changes.
        learner: "dreamer" or "ppo".
        seed: of the training.
        vehicle: from `vehicle_label`.
        data: SHA-256 of the log that the vehicle was fitted to; None for a given vehicle.
    """
    chosen = plain(preset)
    settings = {name: chosen[name] for name in SETTINGS}
    if learner == "ppo":
        settings |= {"ppo": chosen["ppo"], "total_steps": chosen["total_steps"]}  # its learning rate spans the run
    else:
        settings["dreamer"] = chosen["learner"]
        settings |= {"from_outline": True} if preset.from_outline else {}  # older runs do not have it
    known = {"learner": learner, "seed": seed, "task": preset.task.name, "vehicle": vehicle, "data": data}
    source = source_of(preset.task)
    files = {"task_file": source, "task_data": preset.task.checksum()}
    return known | {name: value for name, value in files.items() if value} | dict(_flat(settings))


def vehicle_label(spec: VehicleSpec, params: VehicleParams) -> str:
    """Name of a vehicle with a checksum of its spec, effects and parameters, whatever else its file says."""
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    values = {jax.tree_util.keystr(path): float(np.float32(leaf)) for path, leaf in leaves}
    for index, effect in enumerate(params.effects):
        for name in (one.partition(".")[2] for one in NEUTRAL if one.startswith(f"{effect.name}.")):
            if not values[f".effects[{index}].{name}"]:
                del values[f".effects[{index}].{name}"]
    about = dataclasses.asdict(spec)
    about["camera"] = {name: value for name, value in about["camera"].items() if value or name not in LATER}
    content = [about, [effect.name for effect in params.effects], values]
    return f"{spec.name} {hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]}"


def _flat(table: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
