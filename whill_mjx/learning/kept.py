"""Where a training's compiled programs are kept, and the checksum of all that they are made of."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

from dreamer.training import programs
from dreamer.training.programs import Programs
from whill_mjx.learning.identity import identity_of, vehicle_label
from whill_mjx.learning.setup import Preset
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle

PACKAGES = (Path(__file__).parents[1], Path(programs.__file__).parent)
"""Folders of whill_mjx and dreamer."""
FOLDER = "programs"
"""Within the folder of JAX's compilation cache."""
LIBRARIES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
ENVIRONMENT = ("XLA_", "JAX_")
"""Beginnings of the variables that change what is compiled."""


def kept_programs(preset: Preset, learner: str, vehicle: Path, devices: tuple = ()) -> Programs | None:
    """Where the programs of a training are kept.

    None without a compilation cache, on a CPU, with several devices or processes, and for a task or an effect of
    somebody else's: what else their files depend on is not known.

    Args:
        preset: with the options' changes.
        learner: "dreamer" or "ppo".
        vehicle: vehicle file.
        devices: over which the training is split.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    if devices or not folder or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    spec, params, _ = load_vehicle(vehicle)
    ours = all(type(one).__module__.startswith("whill_mjx.") for one in (preset.task, *params.effects))
    if not ours or jax.default_backend() != "gpu" or jax.process_count() > 1:
        return None
    identity = identity_of(preset, learner, 0, vehicle_label(spec, params), None)
    made_of = [identity, load_intervals(vehicle), surroundings(), code()]
    return Programs(Path(folder) / FOLDER, _checksum(json.dumps(made_of, sort_keys=True, default=str).encode()))


def surroundings() -> list[str]:
    """Versions, settings and the device."""
    device = jax.local_devices()[0]
    settings = {name: value for name, value in jax.config.values.items()
                if "cache" not in name and isinstance(value, bool | int | float | str | None)}
    variables = {name: value for name, value in os.environ.items() if name.startswith(ENVIRONMENT)}
    variables.pop("JAX_COMPILATION_CACHE_DIR", None)
    found = [sys.version, device.device_kind, device.client.platform_version, repr(sorted(settings.items())),
             repr(sorted(variables.items()))]
    for library in LIBRARIES:
        try:
            found.append(version(library))
        except PackageNotFoundError:
            found.append("")
    return found


@lru_cache(maxsize=1)
def code() -> str:
    """Checksum of the files of both packages."""
    found = hashlib.sha256()
    for root in PACKAGES:
        for path in sorted(root.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                found.update(f"{path.relative_to(root)} {_checksum(path.read_bytes())}".encode())
    return found.hexdigest()


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
