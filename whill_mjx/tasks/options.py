"""Tasks and their fields as options of a command; what is wrong becomes one line."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

from whill_mjx.io.command_line import OptionError
from whill_mjx.tasks.base import Task
from whill_mjx.tasks.check import check_task
from whill_mjx.tasks.tasks import find_task

KINDS = {int: "whole number", float: "number", tuple: "list of numbers", bool: "true or false"}


def named_task(name: str, option: str = "--task") -> Task:
    """The task that an option of a command names; OptionError says what is wrong."""
    try:
        task = find_task(name)
        if type(task).for_vehicle is Task.for_vehicle:  # else `make_env` checks it, which knows the vehicle
            check_task(task)
        return task
    except (ValueError, TypeError) as error:
        text = str(error).removeprefix(f"task {name!r}: ").replace(f"unknown task {name!r}", "unknown")
        raise OptionError(f"{option} {name}: {text}") from error


def read_fields(task: Task, texts: Iterable[str], option: str = "--set") -> dict[str, Any]:
    """Fields of a task by name from NAME=VALUE texts; OptionError says what is wrong."""
    known = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    changes: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise OptionError(f"{option}: {text!r} is not NAME=VALUE. Write it so.")
        if name not in known:
            raise OptionError(f"{option} {text}: task {task.name!r} has no field {name!r} (known: "
                              f"{', '.join(sorted(known))}). Correct it.")
        if name == "layout":
            raise OptionError(f"{option} {text}: the layout has an option of its own. Give --layout {value}.")
        if name in changes:
            raise OptionError(f"{option} {text}: {name} is given twice. Leave one out.")
        changes[name] = _parse(value, known[name], f"{option} {text}")
    return changes


def _parse(text: str, like: Any, whole: str) -> Any:
    """A field's value from text, of the same type as its default."""
    try:
        if isinstance(like, bool):
            return {"true": True, "false": False}[text.lower()]
        parts = tuple(float(part) for part in text.split(",")) if isinstance(like, tuple) else ()
        value = parts or (text if like is None else type(like)(text))
    except (ValueError, KeyError) as error:
        kind = KINDS.get(type(like), type(like).__name__)
        raise OptionError(f"{whole}: {text!r} is no {kind}. Correct it.") from error
    if parts and len(parts) != len(like):
        raise OptionError(f"{whole}: {len(parts)} numbers where {len(like)} are needed. Correct it.")
    if not all(math.isfinite(one) for one in parts or (value,) if isinstance(one, float)):
        raise OptionError(f"{whole}: must be finite. Correct it.")
    return value
