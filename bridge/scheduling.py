"""How soon the operating system lets this process run: SCHED_FIFO where permitted, short time slices everywhere.

Linux 6.12 and newer let each thread choose the length of its time slice, without any right. Of two threads that share
their core fairly the one with the shorter slice runs sooner after it wakes up, and no longer in all. A node that wakes
up for a millisecond at a time then waits for busy neighbours by far less. Older kernels keep their own slice.
"""

import ctypes
import os
import platform
import sys

SLICE = 100_000
"""Time slice that is asked for [ns]: the shortest that Linux grants."""
SYSTEM_CALLS = {"x86_64": 314, "aarch64": 274}
"""Number of the system call sched_setattr by machine."""


class Attributes(ctypes.Structure):
    """struct sched_attr of Linux, in its first version."""

    _fields_ = [("size", ctypes.c_uint32), ("policy", ctypes.c_uint32), ("flags", ctypes.c_uint64),
                ("nice", ctypes.c_int32), ("priority", ctypes.c_uint32), ("slice", ctypes.c_uint64),
                ("deadline", ctypes.c_uint64), ("period", ctypes.c_uint64)]


def set_realtime(name: str, priority: int) -> None:
    """Run this thread, and those it starts, before all normal processes; say so where not permitted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, ValueError) as error:
        print(f"{name}: --realtime {priority}: {error}. It needs a priority from 1 to 99 and the right to use it. "
              "Run `setcap cap_sys_nice=ep` on the interpreter or raise rtprio in limits.conf; going on without.",
              file=sys.stderr)


def ask_for_short_slices() -> bool:
    """Ask for short time slices of this thread and those it starts; return whether the system took the request."""
    number = SYSTEM_CALLS.get(platform.machine())
    if number is None or not sys.platform.startswith("linux") or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    wanted = Attributes(ctypes.sizeof(Attributes), 0, 0, os.getpriority(os.PRIO_PROCESS, 0), 0, SLICE, 0, 0)
    return ctypes.CDLL(None, use_errno=True).syscall(number, 0, ctypes.byref(wanted), 0) == 0
