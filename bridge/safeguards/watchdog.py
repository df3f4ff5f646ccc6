"""When the guard sends zeros: a driving policy node gave no sign of life. Pure, with injected time."""

import math

SILENCE = 0.15
"""[s]; a driving policy node gives a sign of life at least every 50 ms."""
LATE = 0.05
"""A watch that comes this much [s] after the one before has not yet read what arrived meanwhile. It judges by what had
arrived at the one before, so a guard that always comes late still stops a dead node."""
REPEATS = 10
"""Zeros sent per stop, 50 ms apart."""
FORGET = 2.0
"""Seconds after which a policy node that fell silent is forgotten; a guard that follows only this one ends."""


class Watchdog:
    """Decides when to send zeros; pure, with injected time."""

    def __init__(self, silence: float = SILENCE) -> None:
        self.silence = silence
        """Seconds after which a driving node that gave no sign of life is stopped."""
        self.stops = 0
        """How often a node was found silent while it drove."""
        self.abandoned = False
        """Whether a node fell silent while it drove, or all that were heard are gone, and none was heard since."""
        self.heard: dict[str, float] = {}
        """Time of the last heartbeat by the session of its node."""
        self._driving: dict[str, float] = {}  # time of the last sign of life of each session that drives
        self._stands = False  # whether the last command on the topic was zero
        self._left = 0
        self._next = self._ticked = 0.0
        self._stopped = -math.inf  # time of the last stop, while nobody has moved the vehicle since

    def heartbeat(self, now: float, session: str, driving: bool) -> None:
        """Take a heartbeat of a policy node."""
        if session not in self._driving and driving:
            self._stands = False  # until a zero is heard, a driving node counts as moving the vehicle
        self.heard[session] = now
        self.abandoned = False
        if driving:
            self._driving[session] = now
        else:
            self._driving.pop(session, None)

    def command(self, moves: bool) -> None:
        """Take a command from the topic; the guard's own zeros come back here and change nothing."""
        self._stands = not moves
        if moves:
            self._left, self._stopped = 0, -math.inf  # somebody drives: never fight

    def new_listener(self, now: float) -> None:
        """Send the zeros of a stop again: a listener was found just after it, as by a guard that has just begun."""
        if now - self._stopped <= FORGET:
            self._left, self._next = REPEATS, now

    def tick(self, now: float) -> bool:
        """Return whether to publish a zero now."""
        read = self._ticked if now - self._ticked > LATE else now  # until when all that arrived has been read
        self._ticked = now
        for session, alive in list(self._driving.items()):
            if read - alive > self.silence:
                del self._driving[session]
                self.abandoned = True
                if not self._stands:
                    self._left, self._next, self._stopped = REPEATS, now, now
                    self.stops += 1
        for session, heard in list(self.heard.items()):
            if read - heard > FORGET:
                del self.heard[session]
                self.abandoned = self.abandoned or not self.heard
        if self._left and now >= self._next:
            self._left, self._next = self._left - 1, now + 0.05
            return True
        return False
