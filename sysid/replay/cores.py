"""What runs side by side on the host's cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from whill_mjx.processor import cores

_Part = TypeVar("_Part")
_Done = TypeVar("_Done")


def on_processor() -> bool:
    """Whether replays run on the host's own cores; an accelerator takes as long for a few rows as for thousands."""
    return jax.default_backend() == "cpu"


def on_all_cores(work: Callable[[_Part], _Done], parts: Sequence[_Part]) -> list[_Done]:
    """What `work` gives for each of `parts`, side by side on all cores."""
    workers = min(cores(), len(parts))
    if workers < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(workers) as threads:
        return list(threads.map(work, parts))
