"""The time that passes for the vehicle: on a real one the steady clock; a simulated one may wait for its driver."""

import statistics
import time
from collections import deque
from collections.abc import Callable


class VehicleTime:
    """Steady seconds that stand while a simulation stands.

    A simulated vehicle that waits for a command, or that a busy computer gives no processor, does not move meanwhile.
    So limits of a drive in simulated time count only what passes while /clock runs. Nothing here runs faster than the
    steady clock, however fast the simulation is. Pure, with injected steady clock.
    """

    LONGEST = 0.05
    """Interval of messages on /clock [s] beyond which they count as late: those of a slow computer."""

    def __init__(self, steady: Callable[[], float] = time.monotonic) -> None:
        self._steady = steady
        self._base = self._heard = steady()
        self._intervals: deque[float] = deque([0.0], maxlen=5)

    def __call__(self) -> float:
        """Return the seconds that have passed: after the newest /clock, as much as two of its usual intervals."""
        usual = min(statistics.median(self._intervals), self.LONGEST)
        return self._base + min(self._steady() - self._heard, 2 * usual)

    def on_clock(self) -> None:
        """Take a message on /clock."""
        now = self._steady()
        self._base = self()
        self._intervals.append(now - self._heard)
        self._heard = now
