"""Tasks: where episodes start, what is rewarded, and when they end.

What tasks of your own are made from is below; docs/tasks.md shows how. `parts` and `terms` hold the pieces.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from whill_mjx.tasks.base import Budget as Budget
    from whill_mjx.tasks.base import Task as Task
    from whill_mjx.tasks.base import World as World
    from whill_mjx.tasks.corridor import Corridor as Corridor
    from whill_mjx.tasks.obstacle_course import ObstacleCourse as ObstacleCourse
    from whill_mjx.tasks.tasks import register_task as register_task

_HOMES = {
    "Budget": "whill_mjx.tasks.base",
    "Task": "whill_mjx.tasks.base",
    "World": "whill_mjx.tasks.base",
    "Corridor": "whill_mjx.tasks.corridor",
    "ObstacleCourse": "whill_mjx.tasks.obstacle_course",
    "register_task": "whill_mjx.tasks.tasks",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
