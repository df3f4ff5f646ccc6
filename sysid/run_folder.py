"""The folder of a run: one process at a time, one identity, and steps from which a stopped command goes on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax

from sysid.pages.report import code_hashes
from sysid.replay.cores import cores
from sysid.replay.models import Model
from sysid.search.studies import without_secrets
from whill_mjx.io.folders import claim_folder
from whill_mjx.io.steps import keep_steps
from whill_mjx.vehicle.vehicle_file import ROBOT_FILES

STEPS = "steps"  # folder of the steps, in that of the run


@contextmanager
def run_folder(
    out: Path, kind: str, outputs: Iterable[str], identity: Mapping[str, Any], more: Mapping[str, Any] | None = None
) -> Iterator[None]:
    """Hold the folder of a run while the block fills it; its steps are kept until the block ends well.

    Args:
        kind: the command, such as "sysid.fit".
        outputs: names that it writes besides the results that all commands share.
        identity: name -> JSON value of what makes this run the same one; another is refused (FolderRefused).
        more: what the steps depend on besides, where the run may be given it later.
    """
    device = jax.devices()[0]
    machine = {"device": device.device_kind, "cores": cores(), "x64": bool(jax.config.values["jax_enable_x64"])}
    with claim_folder(out, kind, outputs) as claim:
        begun = any(path.name not in (".lock", "run.json") for path in out.iterdir())
        claim.settle(identity, begun)
        with keep_steps(out / STEPS, {**identity, **(more or {}), **code_hashes(), **machine}):
            yield


def settings_of(config: Any, without: Iterable[str] = (), model: Model | None = None) -> dict[str, Any]:
    """Name -> value of a settings dataclass for an identity, passwords hidden; files by their content, those too of
    which a `model` was made."""
    found = {name: value for name, value in asdict(config).items() if name not in without}
    for name in {"vehicle", "model"} & set(found):
        found[name] = file_label(found[name])
    if (file := Path(str(getattr(config, "model", None)))).suffix in ROBOT_FILES and file.is_file():
        found["model_parts"] = parts_label(file)
    elif model is not None and model.files:
        found["model_parts"] = files_label(part for one in model.files for part in (one, *_parts(one)))
    if "storage" in found:
        found["storage"] = without_secrets(found["storage"])
    return found


def file_label(path: Path | str | None) -> str | None:
    """Name of a file with a checksum of its content; the text itself where there is no such file."""
    if not path:
        return None
    text = str(path)
    file = Path(text.partition(".py:")[0] + ".py" if ".py:" in text else text)
    if not file.is_file():
        return text
    return f"{Path(text).name} {hashlib.sha256(file.read_bytes()).hexdigest()[:12]}"


def parts_label(path: Path) -> str:
    """`files_label` of those that a robot file includes and of its meshes."""
    return files_label(_parts(path))


def _parts(path: Path) -> list[Path]:
    """Files that are part of a robot file besides it; none of another one."""
    from sysid.replay.robot_files import read_robot

    return read_robot(path).parts if path.suffix in ROBOT_FILES else []


def files_label(files: Iterable[Path]) -> str:
    """Number of files, with a checksum of names and contents."""
    parts = sorted((one.name, hashlib.sha256(one.read_bytes()).hexdigest()) for one in files)
    return f"{len(parts)} files {hashlib.sha256(repr(parts).encode()).hexdigest()[:12]}"
