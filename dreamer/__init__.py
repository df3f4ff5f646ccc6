"""DreamerV3, trained wholly on the device.

`python -m dreamer` lists the commands. What users import is below and in docs/api.md; everything else is internal.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dreamer.config import DreamerConfig as DreamerConfig
    from dreamer.config import preset as preset
    from dreamer.gym import from_gym as from_gym
    from dreamer.policy import Policy as Policy
    from dreamer.policy_files.export import PolicyContract as PolicyContract
    from dreamer.policy_files.export import export_policy as export_policy
    from dreamer.spaces import Box as Box
    from dreamer.spaces import Discrete as Discrete
    from dreamer.train import TrainingOptions as TrainingOptions
    from dreamer.train import TrainResult as TrainResult
    from dreamer.training.checkpoint import CheckpointError as CheckpointError
    from dreamer.types import FunctionalEnv as FunctionalEnv
    from dreamer.types import Mirror as Mirror
    from dreamer.types import Redraw as Redraw
    from dreamer.types import Transition as Transition

_HOMES = {
    "DreamerConfig": "dreamer.config",
    "preset": "dreamer.config",
    "FunctionalEnv": "dreamer.types",
    "Transition": "dreamer.types",
    "Mirror": "dreamer.types",
    "Redraw": "dreamer.types",
    "Box": "dreamer.spaces",
    "Discrete": "dreamer.spaces",
    "from_gym": "dreamer.gym",
    "TrainingOptions": "dreamer.train",
    "TrainResult": "dreamer.train",
    "Policy": "dreamer.policy",
    "PolicyContract": "dreamer.policy_files.export",
    "export_policy": "dreamer.policy_files.export",
    "CheckpointError": "dreamer.training.checkpoint",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use: importing the package stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
