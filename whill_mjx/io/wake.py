"""What a GPU needs before its first program, begun while a command still imports its modules."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress

from whill_mjx.devices import launched_processes
from whill_mjx.io.compiled import keep_compiled
from whill_mjx.processor import DEVICES, share_results


def wake_gpu() -> threading.Thread | None:
    """Begin it in a thread, which is returned; it takes a second or two.

    For a command's own process, as soon as JAX is imported. Without a GPU, where JAX_PLATFORMS asks for none, for help
    alone, and with several processes, nothing happens and None comes back.
    """
    asked = os.environ.get("JAX_PLATFORMS") or "cuda"
    if not any(DEVICES.glob("nvidia[0-9]*")) or not {"cuda", "gpu"} & set(asked.split(",")):
        return None
    if {"-h", "--help"} & set(sys.argv) or launched_processes()[0] > 1:  # these have to find each other first
        return None
    share_results()  # both are read with the first program
    keep_compiled()

    def wake() -> None:
        import jax

        with suppress(Exception):  # the command meets it too, and says what it is
            jax.block_until_ready(jax.numpy.zeros(1))

    thread = threading.Thread(target=wake)
    thread.start()
    return thread
