"""Models by name: an MJCF, URDF or xacro file, or a Python file that defines one."""

from __future__ import annotations

import hashlib
import importlib
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from sysid.replay.models import Model
from whill_mjx.effects import EFFECTS
from whill_mjx.io.modules import run_file
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.vehicle_file import ROBOT_FILES

_BESIDE = set[str]()  # names of the modules beside the model that was loaded last


def steps_mjx(text: str | None, wheels: Sequence[str] = (), parameters: Sequence[str] = ()) -> bool:
    """Whether `--model TEXT` steps a user's robot by MJX: a robot file, or a Python file that mentions it. The vehicle
    that is fitted in place of a skid-steered robot is stepped by our own physics."""
    path = Path(text.partition(".py:")[0] + ".py" if text and ".py:" in text else text or "")
    if path.suffix in ROBOT_FILES:
        from sysid.replay.robot_loading import count_wheels

        return bool(_inside(parameters)) or count_wheels(path, wheels) <= 2
    if path.suffix != ".py":
        return False
    try:
        source = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False  # `load_model` says so
    return re.search(r"mjcf_model|\bmjx\b", source) is not None


def _inside(parameters: Sequence[str]) -> list[str]:
    """Those that are of a robot's file, and not of effects or a vehicle of the simulator."""
    return [name for name in parameters if name.partition(".")[0] not in EFFECTS]


def load_model(text: str, spec: VehicleSpec, wheels: Sequence[str] = (), parameters: Sequence[str] = ()) -> Model:
    """The model that `--model` names; FileNotFoundError or ValueError where it is none.

    Args:
        text: an MJCF, URDF or xacro file, or FILE.py, or FILE.py:NAME. NAME (by default `model`) is a `Model`, or a
            function that makes one from the log's `VehicleSpec`.
        wheels: of a robot file, joints or actuators of the driven wheels, left and right.
        parameters: of such a file, dotted paths of what to fit.
    """
    file, _, attribute = text.rpartition(":") if ".py:" in text else (text, "", "model")
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such model. Give an MJCF, URDF or xacro file, or a Python file "
                                "that defines one.")
    if path.suffix in ROBOT_FILES:
        from sysid.replay.mjcf import mjcf_model

        inside = _inside(parameters)
        return mjcf_model(path, inside or None, wheels=wheels, wheel_radius=spec.wheel_radius, track=spec.track,
                          calibrate=not inside)
    if path.suffix != ".py":
        raise ValueError(f"{path}: a model is {', '.join(ROBOT_FILES)} or .py. Rename the file or write an adapter.")
    with _modules_beside(path) as beside:
        module = _run(path)
        if not hasattr(module, attribute):
            raise ValueError(f"{path}: defines no {attribute!r}. Give FILE.py:NAME, or name the model `model`.")
        found = getattr(module, attribute)
        found = found if isinstance(found, Model) or not callable(found) else found(spec)
    if not isinstance(found, Model):
        raise ValueError(f"{path}: {attribute} is a {type(found).__name__}; it must be a sysid.replay.models.Model. "
                         "Make it with function_model or mjcf_model.")
    return replace(found, files=(*found.files, *beside))


@contextmanager
def _modules_beside(path: Path) -> Iterator[list[Path]]:
    """Import modules in the folder of a file first, as Python does where it runs one; the list gets their files at the
    end. Those beside a model that was loaded before are read anew: others may have the same names."""
    for name in [one for one in sys.modules if one.partition(".")[0] in _BESIDE]:
        del sys.modules[name]
    _BESIDE.clear()
    folder, before, files = path.resolve().parent, set(sys.modules), list[Path]()
    importlib.invalidate_caches()
    sys.path.insert(0, str(folder))
    try:
        yield files
    finally:
        sys.path.remove(str(folder))
        for name in sys.modules.keys() - before:
            top, file = name.partition(".")[0], Path(getattr(sys.modules[name], "__file__", None) or "")
            if top not in before and file.is_relative_to(folder) and file.relative_to(folder).parts[:1] in (
                    (top,), (f"{top}.py",)):
                files.append(file)
                _BESIDE.add(top)


def _run(path: Path) -> ModuleType:
    """The module of a Python file; ValueError where it does not run."""
    alias = f"model_{path.stem}_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:8]}"
    try:
        return run_file(path, alias)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{path}: ends in {type(error).__name__} when it is run ({error}). Correct it; run it alone "
                         "to see where.") from error
