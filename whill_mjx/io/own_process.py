"""A call in a process of its own whose JAX computes on the processor, beside an accelerator that this one uses."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

from whill_mjx.processor import share_results, shares_results

P = ParamSpec("P")
R = TypeVar("R")
PLATFORMS = "JAX_PLATFORMS"


def on_processor_apart(call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """What `call` returns or raises. It and its arguments can be pickled; what it prints appears at once.

    A signal to this process ends the other one.

    Raises:
        OSError: something has ended the other process, such as a lack of memory.
    """
    before = os.environ.get(PLATFORMS)
    os.environ[PLATFORMS] = "cpu"
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_begin)
    try:
        return pool.submit(call, *args, **kwargs).result()
    except BrokenProcessPool:
        raise OSError("the process that computes on the processor was ended from outside, perhaps for lack of memory. "
                      "Give the same command again.") from None
    except BaseException:
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown()
        os.environ.pop(PLATFORMS)
        if before is not None:
            os.environ[PLATFORMS] = before


def _begin() -> None:
    """Leave signals to the parent, and compile for the processor if it shares results (`whill_mjx.processor`)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if shares_results():
        share_results()
