"""A command table played through the safety state machine, replicate by replicate. Pure, with injected time."""

import math
from collections.abc import Callable

import numpy as np

from bridge.driving.command_table import PERIOD, CommandTable
from bridge.safeguards.safety import Command, SafetyConfig, State, Supervisor

BACK = "bring the vehicle back to its start, then arm"
FINISHED = "all replicates are driven"


class Player:
    """Plays a command table through the safety state machine; pure, with injected time.

    A `frame` of the supervisor is a row of the table, so a player that is not called for a while stops the vehicle, as
    a silent camera would.
    """

    def __init__(self, table: CommandTable, safety: SafetyConfig, repeat: int = 1) -> None:
        self.table, self.repeat = table, repeat
        self.clock: Callable[[float], float] = lambda now: now
        """Seconds of the clock that the table counts in, from the steady time; simulated time may be another one. What
        stops the vehicle is timed by the clock of `now`."""
        self.supervisor = Supervisor(safety)
        self.driven = 0
        """Replicates driven to their end."""
        self.aborted = 0
        """Replicates that were stopped on the way."""
        self.elapsed: float | None = None
        """Seconds since the start of the replicate; None while none is driven."""
        self._due = -math.inf
        self._rows = 0
        self._began = 0.0

    @property
    def finished(self) -> bool:
        """True when all replicates are driven."""
        return self.driven >= self.repeat

    def on_tick(self, now: float) -> Command | None:
        """Return the next row of the table where it is due, zero where the vehicle must stand."""
        supervisor = self.supervisor
        if self.elapsed is not None:
            command = supervisor.tick(now)  # sees that the rows have stopped, too
            if not supervisor.may_drive:
                self.elapsed, self.aborted = None, self.aborted + 1
                return self._send(command)
        if self.finished:
            return self._send(supervisor.tick(now))
        at = self.clock(now)
        if 1e-6 < self._due - at < 2 * PERIOD:  # stamps of simulated time are not exact sums of the period
            return None
        self._due = at + PERIOD if abs(at - self._due) > PERIOD else self._due + PERIOD  # also where time began again
        self._rows += 1
        supervisor.frame(now, now, self._rows)
        if not supervisor.may_drive:
            return self._send(supervisor.tick(now))
        if self.elapsed is None:
            self._began = at
        self.elapsed = at - self._began
        if self.elapsed >= self.table.seconds:
            self.elapsed, self.driven = None, self.driven + 1
            supervisor.latch(FINISHED if self.finished else BACK)
            return self._send(supervisor.tick(now))
        return self._send(supervisor.action(now, np.array(self.table.at(self.elapsed))))

    def since_start(self, now: float) -> float:
        """Return the seconds from the start of the replicate to the steady time `now`, by the table's clock."""
        return self.clock(now) - self._began

    def farewell(self) -> bool:
        """Return whether the vehicle needs zeros before the node ends."""
        return self.supervisor.state is not State.YIELDED and self.supervisor.take_turn()

    def _send(self, command: Command) -> Command | None:
        return command if self.supervisor.take_turn() else None
