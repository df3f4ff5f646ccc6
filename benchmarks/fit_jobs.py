"""Jobs of a benchmark that several processes share: one small file for each result, so that what was killed goes on.

A part "I/N" does every N-th job that has no result yet; the parts need nothing but the folder in common.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax


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
    done = 0
    for label in labels:
        path = folder / f"{label}.json"
        if path.exists():
            continue
        began = time.perf_counter()
        try:
            result = job(label)
        except (ValueError, FloatingPointError) as error:
            result = {"error": f"{type(error).__name__}: {error}"}
        write_result(path, {"label": label, "job_seconds": time.perf_counter() - began, **result})
        done += 1
        print(f"{label}: {result.get('error', 'done')}, {time.perf_counter() - began:.1f} s", flush=True)
    return done


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


def share_compilations(folder: Path) -> None:
    """Let all processes on this machine use what one of them has compiled."""
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
