"""Signals that end a command. Their handlers note them in a list, because a KeyboardInterrupt can get lost: in a
callback of the garbage collector, or in the import of a C extension, which turns it into an ImportError."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGTERM, signal.SIGINT, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""A SIGHUP comes when a terminal closes or a connection is lost."""
_lists: list[list[int]] = []


@contextmanager
def heard(interrupt: bool = False) -> Iterator[list[int]]:
    """Note the signals that end a command; yield their list, which blocks within one another share.

    A SIGHUP that is ignored, as of `nohup`, stays so.

    Args:
        interrupt: SIGINT alone, and let it raise KeyboardInterrupt too.
    """
    noted = _lists[-1] if _lists else []

    def note(number: int, _: FrameType | None) -> None:
        noted.append(number)
        if interrupt:
            raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in ((signal.SIGINT,) if interrupt else ENDING)}
    ignored = [number for number in before if before[number] == signal.SIG_IGN
               and (interrupt or number == getattr(signal, "SIGHUP", None))]
    _lists.append(noted)
    try:
        for number in before.keys() - set(ignored):
            signal.signal(number, note)
        yield noted
    finally:
        _lists.pop()
        for number, handler in before.items():
            signal.signal(number, handler)


def name_of(number: int) -> str:
    """Return a signal's name, such as SIGINT."""
    return signal.Signals(number).name
