"""Timing of MuJoCo Warp for comparison: its work captured in one CUDA graph, as its makers advise."""

from __future__ import annotations

import time
from collections.abc import Callable


def graph_rates(call: Callable[[], None], count: int, calls: int, repeats: int) -> list[float]:
    """Things per second in each repeat of `calls` launches of a graph that does `count` things.

    Args:
        call: launches Warp's kernels; runs once by itself, which compiles them, and once to be captured.
        count: what one call makes, such as frames or steps of all worlds.
        calls: launches per repeat.
        repeats: timed repeats.
    """
    import warp as wp

    call()
    with wp.ScopedCapture() as capture:
        call()
    rates = []
    for _ in range(repeats):
        wp.synchronize()
        began = time.perf_counter()
        for _ in range(calls):
            wp.capture_launch(capture.graph)
        wp.synchronize()
        rates.append(count * calls / (time.perf_counter() - began))
    return rates
