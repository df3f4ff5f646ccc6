"""Thin ROS 2 bridge: runs a policy file on the vehicle, and the simulator behind the same topics."""

import os
import sys


def _look_last_in_the_current_folder() -> None:
    """Of a command: a user's json.py or queue.py must not stand for Python's own. As in `whill_mjx`, without which this
    package is installed on a robot; and nothing can be imported before it."""
    try:
        here, source = os.getcwd(), os.path.join(os.path.dirname(__file__), os.pardir)
        if sys.argv[:1] == ["-m"] and sys.path[:1] == [here] and not os.path.samefile(here, source):
            sys.path.append(sys.path.pop(0))
    except OSError:  # the folder is gone
        pass


_look_last_in_the_current_folder()

import signal  # noqa: E402
from types import FrameType  # noqa: E402

COMMANDS = ("drive", "guard", "manoeuvre", "record", "simulate", "chair", "chair_joy")


def _is_starting() -> bool:
    """Return whether this process is a command of this package whose imports are under way."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1] if sys.argv[:1] == ["-m"] and "-m" in words[:-1] else ""
    script = os.path.basename("".join(sys.argv[:1])).removesuffix(".exe").replace("-", "_")
    return module.partition(".")[0] == __name__ or script in {f"bridge_{name}" for name in COMMANDS}


def _leave(number: int, frame: FrameType | None) -> None:
    """End at once, without the traceback of an import: nothing was begun."""
    os.write(2, b"bridge: stopped before the work began (SIGINT)\n")
    os._exit(130)


if _is_starting() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave)  # until `ends_at_ctrl_c`
