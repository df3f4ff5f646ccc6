"""The sensors of this package by name: every file of this folder that defines one."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from functools import cache
from pathlib import Path

from whill_mjx.sensors.base import Sensor


@cache
def known_sensors() -> dict[str, type[Sensor]]:
    """Sensor classes by name."""
    files = [info.name for info in pkgutil.iter_modules([str(Path(__file__).parent)])]
    found = {}
    for name in files:
        module = importlib.import_module(f"whill_mjx.sensors.{name}")
        for _, kind in inspect.getmembers(module, inspect.isclass):
            if issubclass(kind, Sensor) and kind.__module__ == module.__name__ and kind.name:
                found[kind.name] = kind
    return found
