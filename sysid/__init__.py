"""Identification of vehicle parameters from driving logs.

`python -m sysid` lists the commands. What users import is below and in docs/api.md; everything else is internal.
"""

from __future__ import annotations

import whill_mjx  # noqa: F401  # first: it makes a command search the current folder last

from importlib import import_module  # isort: skip
from typing import TYPE_CHECKING, Any  # isort: skip

if TYPE_CHECKING:
    from sysid.logs.loaders import load_any as load_any
    from sysid.logs.log import load_log as load_log
    from sysid.logs.records import Command as Command
    from sysid.logs.records import Log as Log
    from sysid.logs.records import OdometryStream as OdometryStream
    from sysid.logs.records import PoseStream as PoseStream
    from sysid.logs.records import Trial as Trial
    from sysid.pages.fit_report import fit_dataset as fit_dataset
    from sysid.pages.report import read_report as read_report
    from sysid.replay.mjcf import mjcf_model as mjcf_model
    from sysid.replay.models import function_model as function_model
    from sysid.search.fitting import fit_log as fit_log
    from sysid.search.fitting import predict as predict
    from sysid.search.settings import FitConfig as FitConfig
    from sysid.verdict.pipeline import find_missing as find_missing
    from sysid.verdict.posterior import Thresholds as Thresholds
    from sysid.verdict.preparation import prepare as prepare
    from sysid.verdict.result import LoopConfig as LoopConfig

_HOMES = {name: home for home, names in {
    "sysid.logs.log": ("Log", "Trial", "Command", "OdometryStream", "PoseStream", "load_log"),
    "sysid.logs.loaders": ("load_any",),
    "sysid.search.settings": ("FitConfig",),
    "sysid.search.fitting": ("fit_log", "predict"),
    "sysid.pages.fit_report": ("fit_dataset",),
    "sysid.replay.models": ("function_model",),
    "sysid.replay.mjcf": ("mjcf_model",),
    "sysid.pages.report": ("read_report",),
    "sysid.verdict.result": ("LoopConfig",),
    "sysid.verdict.posterior": ("Thresholds",),
    "sysid.verdict.pipeline": ("prepare", "find_missing"),
}.items() for name in names}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use: importing the package stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
