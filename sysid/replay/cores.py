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
    """Whether replays run on the host's own cores, each call keeping one busy; an accelerator takes one call after the
    other, and as long for a few rows as for thousands."""
    return jax.default_backend() == "cpu"


def on_all_cores(work: Callable[[_Part], _Done], parts: Sequence[_Part], compiled: bool = True) -> list[_Done]:
    """What `work` gives for each of `parts`, in their order; as many run side by side as the host has cores.

    Args:
        compiled: otherwise the first goes ahead alone and compiles what the others use.
    """
    workers = min(cores(), len(parts))
    if workers < 2:
        return [work(part) for part in parts]
    ahead = [] if compiled else [work(parts[0])]
    with ThreadPoolExecutor(workers) as threads:
        return [*ahead, *threads.map(work, parts[len(ahead) :])]
