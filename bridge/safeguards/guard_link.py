"""The policy node's side of its guard: starts it, and says why nobody would stop the vehicle if this process died."""

import subprocess
from collections.abc import Callable
from typing import Any

from bridge.safeguards.heartbeat import SIMULATED, read_beat


class GuardLink:
    """The policy node's side: starts a guard, sends heartbeats and judges those that come back; pure but for `start`.

    Times are those in which the node's limits count: of the steady clock, or a `VehicleTime`.
    """

    STALE = 0.5
    """A guard that was not heard for this long [s] is not there."""
    RESTART = 2.0
    """Seconds between two starts of a guard that ended."""
    NOT_READY = "the guard's zeros would not reach the base"

    kind = ""
    """Type in which the node sends commands, as the base listens; empty while it is unknown."""

    def __init__(self, session: str, topic: str, start: Callable[[], Any] | None, simulated: bool = False) -> None:
        """Expect a guard of a command topic; `start` returns a new guard process, None where another one is used."""
        self.session, self.topic = session, topic
        self._stale = self.STALE * (SIMULATED if simulated else 1.0)
        self._start, self._process = start, None
        self._started = -self.RESTART
        self._beats: dict[str, tuple[float, dict[str, Any]]] = {}  # time and content of each guard's last heartbeat

    def keep(self, now: float, steady: float) -> None:
        """Start the guard, or start it again where it has ended; end one that has chosen another type of commands.

        Args:
            now: as of `heard` [s].
            steady: of the steady clock [s]: a process does not wait for a simulation.
        """
        if self._process is not None and self.problem(now) == self._wrong_type:
            self._process.terminate()
        ended = self._process is None or self._process.poll() is not None
        if self._start is not None and ended and steady - self._started >= self.RESTART:
            self._process, self._started = self._start(), steady
            self._beats.clear()  # what the one before said counts no more

    def heard(self, now: float, text: str) -> bool:
        """Take a heartbeat of a guard; return whether it says that this guard, which heard us, has stopped a node.

        There may be several, such as that of an earlier node that was killed. Each counts its own stops.
        """
        beat = read_beat(text, guard=str, topic=str, type=str, ready=bool, stops=int, hears=list)
        if not beat:
            return False
        name = beat["guard"]
        before = self._beats.get(name, (now, beat))[1]
        self._beats[name] = now, beat
        return self._guards_us(before) and beat["stops"] > before["stops"]

    def problem(self, now: float) -> str:
        """Return why nobody would stop the vehicle if this process died; empty where a guard would."""
        if self._process is not None and self._process.poll() is not None:
            return f"the guard ended with code {self._process.returncode}"
        beats = [beat for heard, beat in self._beats.values() if now - heard <= self._stale]
        if not beats:
            return "no guard is running"
        return min(map(self._problem_of, beats), key=lambda why: (bool(why), why != self.NOT_READY))

    def _problem_of(self, beat: dict[str, Any]) -> str:
        if beat["topic"] != self.topic:
            return f"the guard follows {beat['topic']}, not {self.topic}"
        if not self._guards_us(beat):
            return "the guard does not hear this node"
        if self.kind and beat["type"] not in ("", self.kind):
            return self._wrong_type
        return "" if beat["ready"] else self.NOT_READY

    @property
    def _wrong_type(self) -> str:
        return f"the guard's zeros are no {self.kind}, as the base listens to"

    def _guards_us(self, beat: dict[str, Any]) -> bool:
        return bool(beat["topic"] == self.topic and self.session in beat["hears"])

    def close(self) -> None:
        """End the guard that was started."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:  # it was stopped, or has no processor
                self._process.kill()
                self._process.wait()
