"""The lock of a WHILL's joystick: locked while the vehicle is armed, unlocked as soon as it is not; no ROS.

The driver has a service for it (whill_msgs/SetJoystickLock). A lock outlives the node that asked for it, so the guard
unlocks the joystick where the policy node has died.
"""

import math
from collections.abc import Callable

from bridge.safeguards.safety import State, Supervisor

NOT_LOCKED = "the chair's joystick is not locked"
AGAIN = 0.5
"""Seconds after which a request without an answer is made again."""
ARMED = (State.STANDING, State.DRIVING)


class JoystickLock:
    """What was asked of the driver, and what it has confirmed; with injected time."""

    def __init__(self, ask: Callable[[bool, Callable[[bool], None]], None]) -> None:
        """Begin with a lock of unknown state.

        Args:
            ask: asks the driver to lock (true) or unlock, and later calls back with whether it has done so.
        """
        self.locked: bool | None = None
        """What the driver has confirmed last; None before."""
        self._ask = ask
        self._asked, self._number = -math.inf, 0
        self._wanted: bool | None = None

    def want(self, now: float, locked: bool) -> None:
        """Ask for a state until the driver has confirmed it; `now` is a steady time [s]."""
        if self.locked is locked:
            return
        if now - self._asked < AGAIN and self._wanted is locked:
            return
        self._asked, self._wanted, self._number = now, locked, self._number + 1
        number = self._number

        def answered(done: bool) -> None:
            if done and number == self._number:  # an answer to an earlier request says nothing any more
                self.locked = locked

        self._ask(locked, answered)

    def forget(self) -> None:
        """Take the state for unknown: somebody else may have changed it."""
        self.locked = self._wanted = None

    def follow(self, now: float, supervisor: Supervisor) -> None:
        """Lock while the vehicle is armed, and hold it until the lock is confirmed; unlock otherwise."""
        armed = supervisor.state in ARMED
        self.want(now, armed)
        supervisor.block(NOT_LOCKED, armed and self.locked is not True)
