"""Real time on Linux: before all normal processes, on a processor that stays awake."""

import os
import struct
import sys
from pathlib import Path

LATENCY = Path("/dev/cpu_dma_latency")
"""Linux's file for requests of how long the processor may take to wake [us]; each holds while the file is open."""
_requests: list[int] = []


def set_realtime(name: str, priority: int) -> bool:
    """Run this thread, and those it starts, before all normal processes, on a processor that stays awake.

    Args:
        name: of the node, for messages.
        priority: of SCHED_FIFO, 1 to 99.

    Returns:
        Whether it runs so. Where it is not permitted, the node says what to do and goes on without.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, ValueError) as error:
        print(f"{name}: --realtime {priority}: {error}. It needs a priority from 1 to 99 and the right to use it. "
              "Run `setcap cap_sys_nice=ep` on the interpreter or raise rtprio in limits.conf; going on without.",
              file=sys.stderr)
        return False
    stay_awake(name)
    return True


def stay_awake(name: str, path: Path = LATENCY) -> None:
    """Keep the processor from sleeping between frames, as long as this process lives; say so where not permitted.

    From a deep sleep it takes up to a millisecond to wake, and its caches are empty then.
    """
    if _requests or not path.exists():  # the kernel has no such states, or they are asked for already
        return
    try:
        _requests.append(os.open(path, os.O_WRONLY))
        os.write(_requests[-1], struct.pack("i", 0))
    except OSError as error:
        print(f"{name}: {path}: {error.strerror}. The processor may sleep between frames, and each command then comes "
              "up to a millisecond later. Give your group the right to write it (docs/deploy.md); going on without.",
              file=sys.stderr)
