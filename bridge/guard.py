"""Stop the vehicle when the policy node dies: an independent process.

    python -m bridge.guard

`bridge.drive` starts one by itself. The two exchange heartbeats: the policy node says whether it drives, the guard says
whom it hears and that its zeros would reach the base; without that the policy node does not drive. When a driving node
gives no sign of life for SILENCE seconds, the guard publishes zeros. It never publishes anything else.
"""

import argparse
import json
import math
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from typing import Any

from bridge import ros
from bridge.commands import CommandTopic
from bridge.exits import Exit
from bridge.joystick_lock import JoystickLock
from bridge.options import Parser, ends_at_ctrl_c, topic_name, whole
from bridge.parameters import command_line
from bridge.vehicle_time import VehicleTime

SILENCE = 0.15
"""[s]; a driving policy node gives a sign of life at least every 50 ms."""
SIMULATED = 10.0
"""How many times as long the two may not hear each other in simulated time: processes of a busy computer wait for each
other, and nobody sits on the vehicle."""
WATCH_PERIOD = 0.01
LATE = 0.05
"""A watch that comes this much [s] after the one before has not yet read what arrived meanwhile. It judges by what had
arrived at the one before, so a guard that always comes late still stops a dead node."""
BEAT_PERIOD = 0.05
REPEATS = 10
"""Zeros sent per stop, 50 ms apart."""
FORGET = 2.0
"""Seconds after which a policy node that fell silent is forgotten; a guard that follows only this one ends."""
PATIENCE = 30.0
"""Seconds that a guard waits for the first heartbeat of the node that it follows."""


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


class GuardNode:
    """Connects one watchdog to the ROS graph."""

    def __init__(self, node: Any, options: argparse.Namespace) -> None:
        from std_msgs.msg import String

        self.node, self.watchdog = node, Watchdog()
        self._follow = options.follow
        self._followed = time.monotonic() + PATIENCE
        self.now: Callable[[], float] = time.monotonic
        if ros.uses_simulated_time(node):
            self.now, self.watchdog = (vehicle_time := VehicleTime()), Watchdog(SIMULATED * SILENCE)
            ros.subscribe_clock(node, lambda _: vehicle_time.on_clock())
        self._ready, self._matched = False, 0
        self._name = uuid.uuid4().hex
        self._lock = JoystickLock(ros.joystick_locker(node)) if options.joystick_lock else None
        self._type = String
        self.topic = CommandTopic(node, options.command_topic, options.command_type, self._on_command)
        self._beat = node.create_publisher(String, ros.GUARD_TOPIC, ros.reliable())
        ros.subscribe_own(node, String, ros.HEARTBEAT_TOPIC, self._on_heartbeat, ros.reliable(10))
        ros.steady_timer(node, WATCH_PERIOD, self._on_watch)
        ros.steady_timer(node, BEAT_PERIOD, self._on_beat)
        ros.steady_timer(node, 0.1, self._on_look)

    def finished(self) -> bool:
        """Return whether the one node that this guard follows is gone."""
        return bool(self._follow) and time.monotonic() - self._followed > 2 * FORGET

    def _on_command(self, v: float, omega: float, marked: bool) -> None:
        self.watchdog.command(v != 0 or omega != 0)  # not-finite values compare unequal to 0: they count as motion

    def _on_heartbeat(self, message: Any) -> None:
        beat = read_beat(message.data, session=str, driving=bool)
        if isinstance(name := beat.get("node"), str) and self.topic.know(name):  # of another name than usual: no base
            self._ready = False  # until the next look
        if beat and self._follow in ("", beat["session"]):
            self._followed = time.monotonic()
            self.watchdog.heartbeat(self.now(), beat["session"], beat["driving"])

    def _on_watch(self) -> None:
        stops = self.watchdog.stops
        if self.watchdog.tick(self.now()):
            self.topic.publish(0.0, 0.0, marked=True)
        if self._lock is not None and self.watchdog.abandoned:
            self._lock.want(time.monotonic(), False)  # it outlives the node that asked for it
        elif self._lock is not None:
            self._lock.forget()
        if self.watchdog.stops != stops:
            self.node.get_logger().error(f"the policy node gave no sign of life for {self.watchdog.silence:g} s: "
                                         "vehicle stopped")

    def _on_beat(self) -> None:
        watchdog = self.watchdog
        beat = {"guard": self._name, "topic": self.topic.name, "type": self.topic.kind, "ready": self._ready,
                "stops": watchdog.stops, "hears": sorted(watchdog.heard)}
        self._beat.publish(self._type(data=json.dumps(beat)))

    def _on_look(self) -> None:
        """Find out whether a zero would reach the base."""
        before, topic = self._ready, self.topic
        there = topic.look() and any(map(topic.hears_us, topic.listeners()))
        self._ready = there and (before or topic.reaches_all())  # a further reader does not end a drive
        matched = topic.publisher.get_subscription_count() if topic.publisher is not None else 0
        if matched > self._matched:
            self.watchdog.new_listener(self.now())
        self._matched = matched
        if self._ready and not before:
            self.node.get_logger().info(f"guarding {self.topic.name} ({self.topic.kind})")


def read_beat(text: str, **fields: type) -> dict[str, Any]:
    """Return the JSON object of a heartbeat, empty where a field is missing or of another type."""
    try:
        beat = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    whole = isinstance(beat, dict) and all(isinstance(beat.get(name), kind) for name, kind in fields.items())
    return beat if whole else {}


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


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.guard", description="Stop the vehicle if the policy node is killed.")
    parser.add_argument("--command-topic", type=topic_name, default=ros.COMMAND_TOPIC,
                        help="topic of the commands that drive the vehicle")
    parser.add_argument("--command-type", choices=("auto", "Twist", "TwistStamped"), default="auto",
                        help="auto: as the base listens")
    parser.add_argument("--follow", default="", metavar="SESSION", help="guard this node only, and end after it")
    parser.add_argument("--joystick-lock", action="store_true",
                        help="unlock the chair's joystick where the policy node has died: it may have locked it")
    parser.add_argument("--realtime", type=whole(0, 99), default=0, metavar="PRIORITY",
                        help="SCHED_FIFO priority, like 20")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Guard until SIGTERM, Ctrl-C or the end of the node that is followed."""
    own, ros_arguments = command_line(arguments, "bridge.guard")
    options = parse_arguments(own)
    with ros.node_session(ros.GUARD_NAME, ros_arguments, options.realtime) as node:
        ros.spin(node, GuardNode(node, options).finished)
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())
