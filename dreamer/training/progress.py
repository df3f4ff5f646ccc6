"""Progress bar on stderr, by tqdm where it is installed and as plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any

PLAIN_EVERY_S = 10.0


class Progress:
    """Shows how far a run is; tqdm adds the remaining time."""

    def __init__(self, total: int, start: int, enabled: bool) -> None:
        """Open the bar.

        Args:
            total: control steps of the run.
            start: control steps already done.
            enabled: show anything at all.
        """
        self._enabled, self._total, self._start = enabled, total, start
        self._began = self._shown = time.monotonic()
        self._bar: Any = None
        self._notes: dict[str, str] = {}
        if enabled:
            try:
                from tqdm import tqdm

                self._bar = tqdm(total=total, initial=start, unit="step", unit_scale=True, dynamic_ncols=True)
            except ImportError:
                pass

    def note(self, figures: dict[str, str]) -> None:
        """Show these figures from now on, until others of the same name come."""
        self._notes |= figures

    def show(self, done: int, figures: dict[str, str]) -> None:
        """Move to `done` steps and show the figures, the noted ones first."""
        figures = self._notes | figures
        if self._bar is not None:
            self._bar.set_postfix(figures, refresh=False)
            self._bar.update(min(done, self._total) - self._bar.n)
            return
        now = time.monotonic()
        if self._enabled and now - self._shown >= PLAIN_EVERY_S:
            self._shown = now
            rate = (done - self._start) / max(now - self._began, 1e-9)
            left = (self._total - done) / rate if rate > 0 else float("nan")
            text = ", ".join(f"{name} {value}" for name, value in figures.items())
            print(f"{done}/{self._total} steps, {left:.0f} s left, {text}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
