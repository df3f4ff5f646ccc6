"""Jobs of a benchmark that several processes share: one small file for each result, so that what was killed goes on.

A part "I/N" does every N-th job that has no result yet; the parts need nothing but the folder in common. One of them
compiles what all need; the others wait for it. Long jobs keep what they have done so far.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from benchmarks.harness import device_name, versions

QUIET = 30.0  # s between two lines of a job's progress


def labels_of(part: str, labels: Sequence[str]) -> list[str]:
    """The labels that part "I/N" (1 <= I <= N) has; ValueError where it is written otherwise."""
    first, _, count = part.partition("/")
    if not (first.isdigit() and count.isdigit() and 1 <= int(first) <= int(count)):
        raise ValueError(f"part {part!r}: must be I/N with 1 <= I <= N, for example 3/16. Correct --part.")
    return list(labels[int(first) - 1 :: int(count)])


def run_jobs(folder: Path, labels: Iterable[str], job: Callable[[str], dict[str, Any]]) -> int:
    """Do the jobs without a result in `folder` and write LABEL.json, whole or not at all; returns how many were done.

    A job that raises ValueError or FloatingPointError leaves {"error": text}: it counts as done, and as failed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    labels = list(labels)
    left = [label for label in labels if not (folder / f"{label}.json").exists()]
    print(f"{folder}: {len(left)} of {len(labels)} jobs to do", flush=True)
    for number, label in enumerate(left, start=1):
        began = time.perf_counter()
        try:
            result = job(label)
        except (ValueError, FloatingPointError) as error:
            result = {"error": f"{type(error).__name__}: {error}"}
        seconds = time.perf_counter() - began
        write_result(folder / f"{label}.json",
                     {"label": label, "job_seconds": seconds, "device": device_name(),
                      "versions": versions(), **result})
        print(f"{number}/{len(left)} {label}: {result.get('error', 'done')}, {seconds:.1f} s", flush=True)
    return len(left)


def write_result(path: Path, result: dict[str, Any]) -> None:
    """Write one result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(result) + "\n")
    os.replace(temporary, path)


def read_results(folder: Path, pattern: str = "*") -> list[dict[str, Any]]:
    """The results in a folder whose labels match, without those that failed, by label."""
    found = [json.loads(path.read_text()) for path in sorted(folder.glob(f"{pattern}.json"))]
    return [one for one in found if "error" not in one]


def on_device(figures: dict[str, dict[str, Any]], results: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The figures, said to be of the device and versions of the first result rather than of where they are collected;
    no version is given where that result noted none."""
    first = results[0]
    return {name: {**one, "device": first.get("device", one["device"]), "versions": first.get("versions", {})}
            for name, one in figures.items()}


def staged(path: Path, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `compute` gave when the job was last here, or gives now."""
    if not path.exists():
        write_result(path, compute())
    return dict(json.loads(path.read_text()))


def reporter(label: str) -> Callable[[int, str], None]:
    """Progress of one job as a line now and then."""
    last, steps = time.monotonic(), 0

    def report(count: int, text: str) -> None:
        nonlocal last, steps
        steps += count
        if time.monotonic() - last > QUIET:
            last = time.monotonic()
            print(f"  {label}: step {steps}, {text}", flush=True)

    return report


class RememberedCosts:
    """Costs J of an objective that are kept in a file: a search that was stopped goes on as if it had not been.

    A search with the same seed asks for the same points again as long as it gets the same costs.
    """

    def __init__(self, objective: Any, path: Path):
        self._objective, self._path = objective, path
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        self._kept = [json.loads(line) for line in lines if line.endswith("\n")]  # the last one may be torn
        self._next, self._before, self._began = 0, 0.0, time.perf_counter()
        path.write_text("".join(json.dumps(one) + "\n" for one in self._kept))

    @property
    def seconds(self) -> float:
        """Time that the search has taken, in all processes that worked on it."""
        return self._before + time.perf_counter() - self._began

    def weighted_cost(self, u: np.ndarray) -> np.ndarray:
        """The other cost, which is not kept."""
        return np.asarray(self._objective.weighted_cost(u))

    def paper_cost(self, u: np.ndarray) -> np.ndarray:
        """J (N,) of unit coordinates (N, P)."""
        if self._next < len(self._kept):
            one = self._kept[self._next]
            if np.allclose(one["u"], u, atol=1e-9):
                self._next, self._before, self._began = self._next + 1, one["seconds"], time.perf_counter()
                return np.array(one["cost"])
            raise ValueError(f"{self._path}: costs of other points than the search asks for. Remove the file.")
        cost = np.asarray(self._objective.paper_cost(u))
        with open(self._path, "a") as file:
            file.write(json.dumps({"u": np.asarray(u).tolist(), "cost": cost.tolist(), "seconds": self.seconds}) + "\n")
        return cost


def compile_once(folder: Path, name: str, compile: Callable[[], Any]) -> None:
    """Let one process fill the cache of `share_compilations` while the others that need the same wait."""
    with open(folder / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / f"{name}.done").exists():
            began = time.perf_counter()
            compile()
            (folder / f"{name}.done").touch()
            print(f"compiled {name}: {time.perf_counter() - began:.1f} s", flush=True)


def share_compilations(folder: Path) -> None:
    """Let all processes on this machine use what one of them has compiled."""
    folder.mkdir(parents=True, exist_ok=True)
    compilation_cache.reset_cache()  # whether one is used is looked up once, at the first thing compiled
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
