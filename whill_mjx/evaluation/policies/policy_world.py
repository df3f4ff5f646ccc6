"""The world that a policy was trained in: task, fields of the task, vehicle and camera, as its files say."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bridge.policy import AGENT_KIND, KIND, AgentContract, SensorInput, pacer_of, read_policy
from whill_mjx.evaluation.policies.policy_file import sensors_of, vehicle_file
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.fields import PRESET, RUN, TASK, check, check_table
from whill_mjx.io.folders import RUN_FILE
from whill_mjx.io.reading import read_json
from whill_mjx.tasks.tasks import Task, find_task, make_task, source_of

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
    senses: dict[str, tuple[Any, SensorInput]] = field(default_factory=dict)
    """Sensors by name that the policy reads, as of the simulator and as of its file; none: the camera image alone."""
    unpacked: tempfile.TemporaryDirectory | None = None
    """Folder of the vehicle file of a zip; it lives as long as this record."""


def find_policy(path: str | Path) -> Path:
    """Folder of the policy that is given by itself or by the folder of its training.

    Raises:
        OptionError: the training has not exported its policy yet.
    """
    path = Path(path)
    inside = path / POLICY
    if (path / "policy.json").is_file():
        return path
    if (path / RUN_FILE).is_file() and not inside.exists():
        raise OptionError(f"{path}: there is no policy in this folder. A training exports it at its end: wait for it, "
                          "give its command again to go on, or give the folder of a training.")
    return inside if (inside / "policy.json").is_file() else path


def read_world(path: str | Path, task: str | None = None) -> PolicyWorld:
    """The world of a policy, or of the policy of a training; its vehicle and sensors in that of another task, if given.

    Raises:
        PolicyFileError: there is no policy, or it is damaged.
        ValueError: its task is unknown, or the run.json beside it is damaged.
    """
    folder = find_policy(path)
    checked = read_policy(folder, (KIND, AGENT_KIND))
    contract = checked.contract
    commands, pacer = contract.commands, pacer_of(contract.sensors)
    if commands is None or pacer is None:
        raise OptionError(f"{folder}: the policy drives no vehicle, or its file does not say by which sensors. Export "
                          "it again (whill_mjx.train writes them).")
    name = task or contract.task
    try:
        find_task(name)
    except ValueError as error:
        raise OptionError(f"--task {task}: {error}" if task else f"{folder}: {error} Give --task.") from error
    limits = {"v_min": commands.low[0], "v_max": commands.high[0], "omega_max": commands.high[1],
              "action_repeat": commands.action_repeat}  # fmt: skip
    vehicle, unpacked = vehicle_file(folder, checked)
    fields = {**trained_fields(folder, name), **limits} if name == contract.task else {}
    senses: dict[str, tuple[Any, SensorInput]] = {}
    if isinstance(contract, AgentContract):
        sensors = sensors_of(contract, make_task(name, **fields))
        senses = {name: (sensors[name], about) for name, about in contract.sensors.items()}
    height, width = pacer.size if pacer.kind == "camera" else (64, 64)
    return PolicyWorld(name, fields, vehicle, height, width, senses, unpacked)


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


def has_changed(policy: Path, task: Task) -> bool:
    """Whether a task's own file is another one than in the training of a policy, whose run.json lies beside it."""
    run = policy.parent / RUN_FILE
    identity = read_json(run, "missing.", "Train again.").get("identity") if run.is_file() else None
    then = identity.get("task_file") if isinstance(identity, dict) else None
    return then is not None and then != source_of(task)


def _hashable(value: Any) -> Any:
    """A JSON value as a field of a task: lists become tuples."""
    return tuple(_hashable(one) for one in value) if isinstance(value, list) else value
