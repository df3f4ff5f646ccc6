"""Timing and result files shared by the benchmarks."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from whill_mjx import __version__, share_results

share_results()  # every benchmark imports this before JAX starts

RESULTS = Path(__file__).parent / "results"


def device_name() -> str:
    """The accelerator as the runtime reports it, or "cpu, CORES cores, MODEL"."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return str(device.device_kind)
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return f"cpu, {len(os.sched_getaffinity(0))} cores, {model}"


def time_calls(call: Callable[[], Any], repeats: int = 5, warm_up: int = 1) -> list[float]:
    """Seconds of each of `repeats` calls, after `warm_up` untimed ones; every call is waited for."""
    for _ in range(warm_up):
        jax.block_until_ready(call())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return seconds


def figure(repeats: list[float], unit: str, device: str | None = None) -> dict[str, Any]:
    """One entry of "figures": the median of `repeats` and the repeats themselves."""
    value = statistics.median(repeats)
    return {"value": value, "unit": unit, "device": device or device_name(), "repeats": list(repeats)}


def record(
    stem: str, claim: str, figures: dict[str, dict[str, Any]], folder: Path = RESULTS,
    replacing: str | tuple[str, ...] | None = None,
) -> Path:
    """Merge `figures` into `folder/stem.json` and return its path. Figures of other names in the file are kept, but for
    those that begin with `replacing`: they are of an earlier run which had others. A figure measured elsewhere may have
    `versions` of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{stem}.json"
    old = json.loads(path.read_text()) if path.exists() else {}
    stamp = provenance()
    kept = {name: one for name, one in old.get("figures", {}).items()
            if replacing is None or not name.startswith(replacing)}  # fmt: skip
    merged = {**kept, **{name: {**stamp, **value} for name, value in figures.items()}}
    content = {"claim": claim, **stamp, "figures": merged}
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    os.replace(temporary, path)
    return path


def provenance() -> dict[str, Any]:
    """Command, release, versions, commit and date of what is running."""
    return {"command": " ".join(["python", "-m", _module_name(), *map(portable, sys.argv[1:])]), "release": __version__,
            "versions": versions(), "commit": _commit(), "date": datetime.date.today().isoformat()}


def versions() -> dict[str, str]:
    """Of the packages that figures depend on."""
    return {name: _version(name) for name in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "numpy")}


def portable(word: str) -> str:
    """An argument as result files have it: of an absolute path what lies inside the tree, else the name alone. Where a
    machine keeps a file says nothing."""
    if not os.path.isabs(word):
        return word
    path, root = Path(os.path.abspath(word)), RESULTS.parent.parent
    return str(path.relative_to(root)) if path.is_relative_to(root) else path.name


def _module_name() -> str:
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    return spec.name if spec else Path(sys.argv[0]).name


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def _commit() -> str:
    if "COMMIT" in os.environ:  # for machines that hold the tree without its history
        return os.environ["COMMIT"]
    answer = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=RESULTS.parent)
    return answer.stdout.strip() if answer.returncode == 0 else "unknown"
