"""The known tasks by name: those of this package, of installed packages, those that a program registers, and files.

An installed package offers tasks by entry points of the group `whill_mjx.tasks`:

    [project.entry-points."whill_mjx.tasks"]
    my_task = "my_package.my_module:MyTask"

On a command line, `package.module:MyTask` and `path/to/file.py:MyTask` name a task that is not registered.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import inspect
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

import jax

from whill_mjx.io.command_line import one_line
from whill_mjx.io.modules import run_file
from whill_mjx.io.registry import Registry
from whill_mjx.tasks.base import LAYOUTS as LAYOUTS
from whill_mjx.tasks.base import Budget as Budget
from whill_mjx.tasks.base import Task as Task
from whill_mjx.tasks.base import World as World
from whill_mjx.tasks.base import goal_position as goal_position
from whill_mjx.tasks.base import reward_terms as reward_terms
from whill_mjx.tasks.base import scale_action as scale_action
from whill_mjx.tasks.check import check_name
from whill_mjx.tasks.corridor import Corridor as Corridor
from whill_mjx.tasks.obstacle_course import ObstacleCourse as ObstacleCourse

PARTS = ("base", "check", "options", "parts", "starts", "tasks", "terms")
"""Files of this room that hold no task."""


def register_task(task: Any) -> Any:
    """Make a task known by its name to `make_env`, Gymnasium and every command of this process.

    Args:
        task: a task, or its class; so this is also a decorator of the class.

    Returns:
        What was given.

    Raises:
        TypeError: it is no task.
        ValueError: a field is wrong, or another task has its name or its id of Gymnasium.
    """
    name = _as_task(task, "register_task").name
    for other in TASKS:
        if other != name and in_camel(other) == in_camel(name):
            raise ValueError(f"register_task: task {name!r} would have the id of Gymnasium that {other!r} has. Give it "
                             "another name.")
    known = TASKS.add(task, "register_task")
    if "whill_mjx.gym" in sys.modules:  # which gives every task an id, when it is imported
        sys.modules["whill_mjx.gym"].register_id(known)
    return task


def in_camel(name: str) -> str:
    """The name of a task as Gymnasium's ids have it: ObstacleCourse of obstacle_course."""
    return "".join(part.capitalize() for part in name.split("_"))


def unregister_task(name: str) -> None:
    """Forget a task that was registered; KeyError where there is none of this name."""
    TASKS.remove(name)


def find_task(name: str) -> Task:
    """Task with its defaults: a known name, `package.module:NAME` or `path/to/file.py:NAME`.

    Raises:
        ValueError: there is no such task, module or file, or it cannot be imported; one line that lists what is known.
    """
    place, colon, attribute = name.rpartition(":")
    if colon and not place.endswith(".py") and not all(part.isidentifier() for part in (*place.split("."), attribute)):
        raise ValueError(f"task {name!r}: is no name of a task. Give package.module:TASK or path/to/file.py:TASK.")
    if not colon:
        if name not in TASKS:
            if name.endswith(".py"):
                raise ValueError(f"task {name!r}: a task in a file is named too. Give {name}:CLASS.")
            raise ValueError(f"unknown task {name!r} (known: {', '.join(TASKS)}). Correct the name, or give "
                             "package.module:TASK or path/to/file.py:TASK.")
        return TASKS[name]
    module = _import(name, place)
    if not hasattr(module, attribute):
        kinds = [kind.__name__ for kind in _kinds_in(module)]
        there = ", ".join((*kinds, *(one for one, value in vars(module).items() if isinstance(value, Task)))) or "none"
        raise ValueError(f"task {name!r}: {place} has no task {attribute!r} (known: {there}). Correct the name.")
    try:
        task = _as_task(getattr(module, attribute), f"task {name!r}")
    except (Exception, SystemExit) as error:  # no task, a field without a default, or its own checks
        text = one_line(error).removeprefix(f"task {name!r}: ")
        text = text if isinstance(error, (TypeError, ValueError)) else f"{type(error).__name__}: {text}"
        raise ValueError(f"task {name!r}: {text.rstrip('.')}. Correct the file or the name.") from error
    if task.name in TASKS and type(TASKS[task.name]) is not type(task):
        other = type(TASKS[task.name]).__module__
        raise ValueError(f"task {name!r}: it is called {task.name!r}, as one of {other} is. Give it another name.")
    return task


def make_task(name: str, **changes: Any) -> Task:
    """Task by name, as of `find_task`, with some of its fields changed; ValueError names the known tasks and fields."""
    task = find_task(name)
    known = {field.name for field in dataclasses.fields(task)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise ValueError(f"task {name!r} has no field {unknown[0]!r} (known: {', '.join(sorted(known))}).")
    return dataclasses.replace(task, **changes)


def sample_world(task: Task, key: jax.Array) -> World:
    """World of one episode of a task."""
    return task.sample_world(key)


def tasks_in(module: ModuleType) -> dict[str, Task]:
    """The tasks whose classes a module defines itself, by the names of their classes."""
    return {kind.__name__: _as_task(kind, kind.__name__) for kind in _kinds_in(module)}


def _kinds_in(module: ModuleType) -> list[type[Task]]:
    kinds = [kind for _, kind in inspect.getmembers(module, inspect.isclass) if issubclass(kind, Task)]
    return [kind for kind in kinds if kind.__module__ == module.__name__]


def source_of(task: Task) -> str | None:
    """SHA-256 of the file that defines a task; None for the tasks of this package, which its version identifies."""
    kind = type(task)
    if kind.__module__.startswith("whill_mjx."):
        return None
    try:
        return hashlib.sha256(Path(inspect.getfile(kind)).read_bytes()).hexdigest()
    except (OSError, TypeError):
        return None


def _as_task(value: Any, where: str) -> Task:
    """The task that a value, or a class with defaults for all its fields, is."""
    if isinstance(value, type) and issubclass(value, Task):
        if "__dataclass_params__" not in value.__dict__ or not value.__dataclass_params__.frozen:  # type: ignore[attr-defined]
            raise TypeError(f"{where}: {value.__name__} is no frozen dataclass. Decorate it with "
                            "@dataclasses.dataclass(frozen=True).")
        value = value()
    if not isinstance(value, Task):
        raise TypeError(f"{where}: {value!r} is no task. Derive its class from whill_mjx.Task.")
    hash(value)
    check_name(value)
    return value


def _import(name: str, place: str) -> ModuleType:
    """Module of a dotted name or a file; whatever goes wrong in it becomes one line."""
    is_file = place.endswith(".py")
    try:
        if not is_file:
            return importlib.import_module(place)
        path = Path(place).resolve()
        if path.is_file():
            return _import_file(path)
    except (Exception, SystemExit) as error:
        text, missing = " ".join(str(error).split()).rstrip("."), isinstance(error, ModuleNotFoundError)
        if missing and not is_file and f"{place}.".startswith(f"{error.name}."):  # type: ignore[union-attr]
            raise ValueError(f"task {name!r}: {text}. Give package.module:TASK or path/to/file.py:TASK.") from error
        text = text if missing else f"{type(error).__name__}: {text}"
        remedy = "Install it, or correct the file." if missing else "Correct the file."
        raise ValueError(f"task {name!r}: {place}{_line(place, error)} cannot be imported: {text}. {remedy}") from error
    raise ValueError(f"task {name!r}: no such file {place}. Correct the path.")


def _import_file(path: Path) -> ModuleType:
    """Module of a file; one that is edited is read anew."""
    version = hashlib.sha256(str(path).encode() + path.read_bytes())
    alias = f"task_{path.stem}_{version.hexdigest()[:8]}"
    return sys.modules.get(alias) or run_file(path, alias)


def _line(place: str, error: BaseException) -> str:
    """Where in the file of a module its import failed."""
    stem = f"/{place.replace('.', '/')}"
    ends = (str(Path(place).resolve()),) if place.endswith(".py") else (f"{stem}.py", f"{stem}/__init__.py")
    lines = [one.lineno for one in traceback.extract_tb(error.__traceback__) if one.filename.endswith(ends)]
    return f", line {lines[-1]}:" if lines else ""


TASKS: Registry[Task] = Registry(
    "task", "whill_mjx.tasks", __file__, lambda module: tasks_in(module).values(), _as_task, PARTS
)
"""Every known task by name."""
