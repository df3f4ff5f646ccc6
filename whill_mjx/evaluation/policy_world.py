"""The world that a policy was trained in: task, fields of the task, vehicle and camera, as its files say."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from whill_mjx.command_line import OptionError
from whill_mjx.folders import RUN_FILE
from whill_mjx.tasks.tasks import TASKS

POLICY = "policy"
"""Folder of the policy within that of its training."""


@dataclass(frozen=True)
class PolicyWorld:
    """What a simulator needs, so that a policy meets what it was trained for."""

    task: str
    fields: dict[str, Any]
    """Fields of the task: those of the training where its run.json lies beside the policy, and the policy's limits."""
    vehicle: Path | None
    """Vehicle file inside the policy; its camera is the policy's."""
    height: int
    """Of the camera image [pixels]."""
    width: int


def find_policy(path: str | Path) -> Path:
    """Folder of the policy that is given by itself or by the folder of its training."""
    path = Path(path)
    inside = path / POLICY
    return inside if (inside / "policy.json").is_file() and not (path / "policy.json").is_file() else path


def read_world(path: str | Path) -> PolicyWorld:
    """The world of a policy, or of the policy of a training.

    Raises:
        OptionError: there is no policy, it is damaged, or its task is unknown.
    """
    folder = find_policy(path)
    file = folder / "policy.json"
    if not file.is_file():
        raise OptionError(f"{path}: holds neither policy.json nor policy/policy.json. Give the folder of a policy or "
                          "of a training; unpack a zip first.")
    try:
        table = json.loads(file.read_text(encoding="utf-8"))
        task, (height, width) = str(table["task"]), (int(table["image"][name]) for name in ("height", "width"))
        low, high = ([float(x) for x in table["action"][name]] for name in ("low", "high"))
        limits = {"v_min": low[0], "v_max": high[0], "omega_max": high[1], "action_repeat": int(table["action_repeat"])}
    except (ValueError, KeyError, TypeError, IndexError):
        raise OptionError(f"{file}: task, image, action and action_repeat cannot be read. Export the policy again."
                          ) from None  # fmt: skip
    if task not in TASKS:
        raise OptionError(f"{file}: unknown task {task!r} (known: {', '.join(TASKS)}). Export the policy again.")
    vehicle = folder / "vehicle.toml"
    fields = {**trained_fields(folder, task), **limits}
    return PolicyWorld(task, fields, vehicle if vehicle.is_file() else None, height, width)


def trained_fields(policy: Path, task: str) -> dict[str, Any]:
    """Fields of a policy's task from the run.json of its training, which lies beside it; empty where none does.

    Raises:
        OptionError: the run.json is damaged.
    """
    run = policy.parent / RUN_FILE
    if not run.is_file():
        return {}
    try:
        saved = dict(json.loads(run.read_text(encoding="utf-8"))["preset"]["task"])
    except (ValueError, KeyError, TypeError):
        raise OptionError(f"{run}: does not say how the policy's task was set. Move the policy to another folder and "
                          "give the fields with --set.") from None  # fmt: skip
    known = {field.name for field in dataclasses.fields(TASKS[task])}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in saved.items() if name in known}
