"""The world that a policy was trained in: task, fields of the task, vehicle and camera, as its files say."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.policy import Contract, read_policy
from whill_mjx.evaluation.policy_file import vehicle_file
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.fields import PRESET, RUN, TASK, check, check_table
from whill_mjx.io.folders import RUN_FILE
from whill_mjx.io.reading import read_json
from whill_mjx.tasks.tasks import find_task

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
    unpacked: tempfile.TemporaryDirectory | None = None
    """Folder of the vehicle file of a zip; it lives as long as this record."""


def find_policy(path: str | Path) -> Path:
    """Folder of the policy that is given by itself or by the folder of its training."""
    path = Path(path)
    inside = path / POLICY
    return inside if (inside / "policy.json").is_file() and not (path / "policy.json").is_file() else path


def read_world(path: str | Path) -> PolicyWorld:
    """The world of a policy, or of the policy of a training.

    Raises:
        PolicyFileError: there is no policy, or it is damaged.
        ValueError: its task is unknown, or the run.json beside it is damaged.
    """
    folder = find_policy(path)
    checked = read_policy(folder)
    contract = checked.contract
    assert isinstance(contract, Contract)
    try:
        find_task(contract.task)
    except ValueError as error:
        raise OptionError(f"{folder}: {error} Give --task.") from error
    limits = {"v_min": contract.low[0], "v_max": contract.high[0], "omega_max": contract.high[1],
              "action_repeat": contract.action_repeat}  # fmt: skip
    vehicle, unpacked = vehicle_file(folder, checked)
    fields = {**trained_fields(folder, contract.task), **limits}
    return PolicyWorld(contract.task, fields, vehicle, contract.height, contract.width, unpacked)


def trained_fields(policy: Path, task: str) -> dict[str, Any]:
    """Fields of a policy's task from the run.json of its training, which lies beside it; empty where none does.

    Raises:
        ValueError: the run.json is damaged; names file, field, value, rule and remedy.
    """
    run = policy.parent / RUN_FILE
    if not run.is_file():
        return {}
    hint = "Put the file of the training there, or move the policy to another folder and give the fields with --set."
    content = read_json(run, f"missing. {hint}", hint)
    preset = check_table(str(run), RUN, content, others=True)["preset"]
    saved = check_table(str(run), PRESET, preset, "preset", others=True)["task"]
    rows = {field.name: field for field in TASK}
    known = {field.name for field in dataclasses.fields(find_task(task))}
    return {name: check(str(run), rows[name], value, f"preset.task.{name}") if name in rows else _hashable(value)
            for name, value in saved.items() if name in known}


def _hashable(value: Any) -> Any:
    """A JSON value as a field of a task: lists become tuples."""
    return tuple(_hashable(one) for one in value) if isinstance(value, list) else value
