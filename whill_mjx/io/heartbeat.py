"""Signs of life of a long command: what it does now, and for how long already."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Any

EVERY_S = 4.0
"""A command is silent for longer only while JAX holds Python's lock: up to 6 s on a machine with ten times the load of
its cores."""
POLL_S = 0.5


def say(text: str) -> None:
    """Print a line on stderr, above the progress bars that are open."""
    if _open_bars():
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()
    else:
        print(text, file=sys.stderr, flush=True)


def say_loading() -> None:
    """Say that the imports of a command take some seconds, unless only its help is asked for."""
    if not {"-h", "--help"} & set(sys.argv[1:]):
        say("loading JAX and the simulator")


class Heartbeat:
    """A thread that writes at least every `every_s` seconds: a refreshed progress bar, or the stage and its time.

    XLA compiles without holding Python's lock, so the thread also runs then; JAX holds it for moments before.

        with Heartbeat() as heartbeat:
            heartbeat.stage("compiling the training, usually 60 s")
            ...
    """

    def __init__(self, every_s: float = EVERY_S) -> None:
        """Prepare; the thread starts with the `with` block."""
        self._every_s = every_s
        self._text, self._began = "", time.monotonic()
        self._wrote = self._began
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="heartbeat")

    def stage(self, text: str) -> None:
        """Say what begins now; its time counts from here."""
        self._text, self._began = text, time.monotonic()
        say(text)
        self._wrote = time.monotonic()

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._over.wait(min(POLL_S, self._every_s / 4)):
            now = time.monotonic()
            if now - self._wrote < self._every_s:
                continue
            bars = _open_bars()
            for bar in bars:
                _refresh(bar)
            if not bars and self._text:
                say(f"  {now - self._began:.0f} s: {self._text}")
            self._wrote = now


def _refresh(bar: Any) -> None:
    """Draw a bar again. A terminal may state no size, as in some containers; tqdm then hides its bars."""
    if min(bar.ncols or 1, bar.nrows or 1) < 1:
        bar.dynamic_ncols, bar.ncols, bar.nrows = None, 80, 20
    bar.refresh()


def _open_bars() -> list[Any]:
    """The progress bars of this process that are shown now; importing tqdm is left to who draws one."""
    module = sys.modules.get("tqdm")
    return [bar for bar in list(getattr(module.tqdm, "_instances", ())) if not bar.disable] if module else []
