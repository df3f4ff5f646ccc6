"""Python's search for garbage, which takes a third of the time of a trace: a trace makes millions of objects that stay.

By default Python searches its newest objects after every 700 of them, and again and again all that there are. Memory is
given back without a search; only objects that refer to each other wait for one.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from typing import Any

YOUNG = 50_000
"""New objects between two searches through these, in a command; 700 by default."""


def search_seldom() -> None:
    """For commands, whose process is their own: search less often."""
    young, *older = gc.get_threshold()
    if 0 < young < YOUNG:
        gc.set_threshold(YOUNG, *older)


def undisturbed(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, which JAX traces and nothing else calls, without a search meanwhile; other code goes on as before."""

    @functools.wraps(function)
    def traced(*args: Any) -> Any:
        searching = gc.isenabled()
        try:
            gc.disable()
            return function(*args)
        finally:
            if searching:
                gc.enable()

    return traced
