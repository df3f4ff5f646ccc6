"""Batched simulator of micromobility vehicles on MuJoCo MJX.

`python -m whill_mjx` lists the commands. What users import is below and in docs/api.md; everything else is internal.
"""

from __future__ import annotations

import os
import sys


def _look_last_in_the_current_folder() -> None:
    """Of a command: a user's random.py or json.py must not stand for Python's own."""
    try:
        here, source = os.getcwd(), os.path.join(os.path.dirname(__file__), os.pardir)
        if sys.argv[:1] == ["-m"] and sys.path[:1] == [here] and not os.path.samefile(here, source):
            sys.path.append(sys.path.pop(0))
    except OSError:  # the folder is gone
        pass


_look_last_in_the_current_folder()

from importlib import import_module  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

if TYPE_CHECKING:
    from whill_mjx.batch import make_batch as make_batch
    from whill_mjx.effects import EFFECTS as EFFECTS
    from whill_mjx.effects import make_effect as make_effect
    from whill_mjx.effects import register as register
    from whill_mjx.env import make_env as make_env
    from whill_mjx.env import reset as reset
    from whill_mjx.env import step as step
    from whill_mjx.evaluation.policies.policy_file import load_policy as load_policy
    from whill_mjx.gym import WhillEnv as WhillEnv
    from whill_mjx.gym.vector import WhillVectorEnv as WhillVectorEnv
    from whill_mjx.processor import device_per_core as device_per_core
    from whill_mjx.processor import share_results as share_results
    from whill_mjx.tasks.tasks import Budget as Budget
    from whill_mjx.tasks.tasks import Corridor as Corridor
    from whill_mjx.tasks.tasks import ObstacleCourse as ObstacleCourse
    from whill_mjx.tasks.tasks import Task as Task
    from whill_mjx.tasks.tasks import World as World
    from whill_mjx.tasks.tasks import register_task as register_task
    from whill_mjx.vehicle.config import VehicleConfig as VehicleConfig
    from whill_mjx.vehicle.parameters import describe as describe
    from whill_mjx.vehicle.parameters import get_values as get_values
    from whill_mjx.vehicle.parameters import set_values as set_values
    from whill_mjx.vehicle.presets import preset as preset
    from whill_mjx.vehicle.specs import CameraMount as CameraMount
    from whill_mjx.vehicle.specs import VehicleSpec as VehicleSpec
    from whill_mjx.vehicle.types import VehicleParams as VehicleParams
    from whill_mjx.vehicle.vehicle_file import load_vehicle as load_vehicle
    from whill_mjx.vehicle.vehicle_file import save_vehicle as save_vehicle

__version__ = "0.2.0"

_HOMES = {
    "make_env": "whill_mjx.env",
    "reset": "whill_mjx.env",
    "step": "whill_mjx.env",
    "make_batch": "whill_mjx.batch",
    "WhillEnv": "whill_mjx.gym",
    "ObstacleCourse": "whill_mjx.tasks.tasks",
    "Corridor": "whill_mjx.tasks.tasks",
    "VehicleSpec": "whill_mjx.vehicle.specs",
    "VehicleConfig": "whill_mjx.vehicle.config",
    "VehicleParams": "whill_mjx.vehicle.types",
    "preset": "whill_mjx.vehicle.presets",
    "load_vehicle": "whill_mjx.vehicle.vehicle_file",
    "save_vehicle": "whill_mjx.vehicle.vehicle_file",
    "describe": "whill_mjx.vehicle.parameters",
    "get_values": "whill_mjx.vehicle.parameters",
    "set_values": "whill_mjx.vehicle.parameters",
    "EFFECTS": "whill_mjx.effects",
    "make_effect": "whill_mjx.effects",
    "register": "whill_mjx.effects",
    "load_policy": "whill_mjx.evaluation.policies.policy_file",
    "share_results": "whill_mjx.processor",
}
_EXTENDING = {
    "device_per_core": "whill_mjx.processor",
    "Task": "whill_mjx.tasks.tasks",
    "World": "whill_mjx.tasks.tasks",
    "Budget": "whill_mjx.tasks.tasks",
    "register_task": "whill_mjx.tasks.tasks",
    "CameraMount": "whill_mjx.vehicle.specs",
    "WhillVectorEnv": "whill_mjx.gym.vector",
}
"""Names for tasks, vehicles and clients of one's own (docs/tasks.md); `import *` leaves them out."""
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use: importing the package stays quick."""
    home = _HOMES.get(name) or _EXTENDING.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_EXTENDING})
