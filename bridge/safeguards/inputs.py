"""What may stop the vehicle from outside: emergency stop, enable, dead-man button, collision sensor.

An emergency stop that is not heard is pulled: "unknown" is stop. The inputs hear publishers of any quality of service,
so a stop that was latched before the bridge started is known as soon as its publisher is found.
"""

import argparse
import math
from collections.abc import Callable
from typing import Any

from bridge.nodes import ros
from bridge.nodes.options import in_range, whole
from bridge.safeguards.safety import Supervisor

E_STOP, E_STOP_UNKNOWN = "emergency stop", "emergency stop unknown"
ENABLE, DEAD_MAN, COLLISION = "not enabled", "dead-man button released", "collision"


class Signal:
    """A truth value that must keep coming; pure, with injected time."""

    def __init__(self, limit: float) -> None:
        """Set how long [s] a value counts."""
        self.heard = False
        self._limit, self._time, self._value = limit, -math.inf, False

    def take(self, now: float, value: bool) -> None:
        """Take a new value."""
        self._time, self._value, self.heard = now, value, True

    def read(self, now: float) -> bool | None:
        """Return the value, None where it is unknown."""
        return self._value if now - self._time <= self._limit else None


class SafetyInputs:
    """Feeds the outer inputs to a supervisor; the methods `on_...` and `watch` are pure, with injected time."""

    def __init__(self, supervisor: Supervisor, options: argparse.Namespace) -> None:
        """Set the inputs in force; `options` are those that `add_options` declares."""
        self.supervisor, self.options = supervisor, options
        self.topics: dict[str, str] = {}
        """What is subscribed to, before remapping, with the type of its messages."""
        self._e_stop, self._enable, self._button = (Signal(options.signal_age) for _ in range(3))

    def on_e_stop(self, now: float, pulled: bool) -> None:
        """Take the emergency stop: true stops and latches."""
        self._e_stop.take(now, pulled)
        if pulled:
            self.supervisor.latch(E_STOP)
        self.watch(now)

    def on_enable(self, now: float, enabled: bool) -> None:
        """Take the enabling signal: false stops while it lasts."""
        self._enable.take(now, enabled)
        self.watch(now)

    def on_joy(self, now: float, buttons: list[int]) -> None:
        """Take the buttons of a joystick: a released dead-man button stops while it is released."""
        index = self.options.dead_man_button
        self._button.take(now, 0 <= index < len(buttons) and buttons[index] == 1)
        self.watch(now)

    def on_collision(self, collided: bool) -> None:
        """Take the collision sensor: an event without heartbeat."""
        if collided and self.options.collision == "latch":
            self.supervisor.latch(COLLISION)
        self.supervisor.block(COLLISION, collided)

    def watch(self, now: float) -> None:
        """Hold the vehicle by all that is pulled, released or unknown now."""
        block = self.supervisor.block
        mode = self.options.e_stop
        pulled = self._e_stop.read(now)
        block(E_STOP, pulled is True and mode != "ignore")
        block(E_STOP_UNKNOWN, pulled is None and (mode == "require" or (mode == "watch" and self._e_stop.heard)),
              latching=True)
        block(ENABLE, self.options.enable == "require" and self._enable.read(now) is not True)
        block(DEAD_MAN, self.options.dead_man_button >= 0 and self._button.read(now) is not True)

    def subscribe(self, node: Any, clock: Callable[[], float], changed: Callable[[float], None]) -> None:
        """Listen on the graph; `changed` is called with the time of `clock` after each message."""
        from std_msgs.msg import Bool

        def listen(topic: str, take: Callable[[float, bool], None]) -> None:
            self.topics[topic] = "std_msgs/msg/Bool"

            def heard(message: Any) -> None:
                now = clock()
                take(now, message.data)
                changed(now)

            ros.subscribe_state(node, Bool, topic, heard)

        if self.options.e_stop != "ignore":
            listen(ros.E_STOP_TOPIC, self.on_e_stop)
        if self.options.enable != "ignore":
            listen(ros.ENABLE_TOPIC, self.on_enable)
        if self.options.collision != "ignore":
            listen(ros.COLLISION_TOPIC, lambda _, collided: self.on_collision(collided))
        if self.options.dead_man_button >= 0:
            from sensor_msgs.msg import Joy

            def on_joy(message: Any) -> None:
                now = clock()
                self.on_joy(now, list(message.buttons))
                changed(now)

            self.topics[ros.JOY_TOPIC] = "sensor_msgs/msg/Joy"
            node.create_subscription(Joy, ros.JOY_TOPIC, on_joy, ros.best_effort())


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the inputs."""
    parser.add_argument("--e-stop", choices=("require", "watch", "ignore"), default="require",
                        help="std_msgs/Bool on e_stop, true stops; require: stand unless it says false now; watch: "
                             "once it was heard")
    parser.add_argument("--enable", choices=("require", "ignore"), default="ignore",
                        help="std_msgs/Bool on enable; require: stand unless it says true now")
    parser.add_argument("--dead-man-button", type=whole(-1, 1000), default=-1, metavar="INDEX",
                        help="sensor_msgs/Joy on joy: stand unless this button is held; -1: none")
    parser.add_argument("--signal-age", type=in_range(0, infinite=True, above=True), default=0.5,
                        help="a signal that is older is unknown [s]")
    parser.add_argument("--collision", choices=("latch", "release", "ignore"), default="latch",
                        help="on collision_sensor true: stop until re-armed, stop while it lasts, or take no notice")
