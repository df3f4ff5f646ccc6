"""The command topic: who listens in which type, who else publishes, and whose each command is."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from bridge.nodes import ros

TYPES = {"geometry_msgs/msg/Twist": "Twist", "geometry_msgs/msg/TwistStamped": "TwistStamped"}
"""Message types of commands, and the words for them on the command line."""
UNKNOWN = "_UNKNOWN_"
"""Part of the name that ROS gives to a node which it has not identified yet."""
NAMELESS = "a node without a name"
SETTLE = 1.0
"""Seconds in which nodes that run already have found one another, on a loaded computer too."""
HEARD_DEPTH = 50
"""Commands that may wait to be heard, so that none of another node is overwritten by ours."""
GUARD_SIGNS = (1.0, -1.0, 1.0, -1.0)
"""Signs of linear.y, linear.z, angular.x and angular.y in a zero of the guard. To a base -0.0 is 0, and DDS keeps the
sign. Other nodes leave these four at 0.0, or negate all of them."""


class Ear:
    """Separates our own commands, zeros of a guard and the commands of other nodes; pure.

    ROS does not name the sender of a message, on Humble in no way at all. So a guard marks its zeros (`mark_zero`), and
    each other command is compared exactly with those that we sent. Neither needs times or counts, so nothing depends on
    who is heard first, on pauses, or on the restart of a guard.
    """

    def __init__(self) -> None:
        self._own: deque[tuple[float, float]] = deque(maxlen=64)

    def sent(self, v: float, omega: float) -> None:
        """Remember a command of ours."""
        self._own.append((v, omega))

    def heard(self, v: float, omega: float, marked: bool) -> bool:
        """Take a command from the topic; return whether another node sent it.

        Args:
            v: [m/s].
            omega: [rad/s].
            marked: whether it bears the mark of a guard, which sends nothing but zeros.
        """
        if marked and v == omega == 0:
            return False
        if (v, omega) not in self._own:
            return True
        while self._own.popleft() != (v, omega):
            pass  # earlier ones were lost on the way: one reader hears one sender in order
        return False


def mark_zero(planar: Any) -> None:
    """Mark a geometry_msgs/Twist as a zero of the guard."""
    planar.linear.y, planar.linear.z, planar.angular.x, planar.angular.y = (0.0 * sign for sign in GUARD_SIGNS)


def is_marked(planar: Any) -> bool:
    """Return whether a geometry_msgs/Twist bears the mark of the guard."""
    rest = planar.linear.y, planar.linear.z, planar.angular.x, planar.angular.y
    return not any(rest) and all(math.copysign(1.0, a) == b for a, b in zip(rest, GUARD_SIGNS, strict=True))


class Commanders:
    """Keeps account of the other nodes that publish commands; pure, with injected time.

    Nodes find one another within some tenths of a second, under load later. So an empty list says little at first: it
    counts when it has stayed the same for `SETTLE`.
    """

    def __init__(self, now: float) -> None:
        self._found: list[str] = []
        self._changed = self._named = now

    def look(self, now: float, found: list[str]) -> None:
        """Take the names that the graph knows at the steady time `now` [s]; unidentified ones contain `UNKNOWN`."""
        if found != self._found:
            self._found, self._changed = found, now
        if not any(UNKNOWN in name for name in found):
            self._named = now

    def names(self, now: float) -> list[str]:
        """Return who counts as a commander: a node with a name at once, one without a name when it stays."""
        stays = now - self._named >= SETTLE
        named = [name for name in self._found if UNKNOWN not in name]
        return named + [NAMELESS for name in self._found if UNKNOWN in name and stays]

    def settled(self, now: float) -> bool:
        """Return whether nobody has come or gone for a while."""
        return now - self._changed >= SETTLE


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscriber of a topic."""

    node: str
    """Full name of its node."""
    type: str
    """Message type, such as geometry_msgs/msg/Twist."""
    hears: bool = True
    """Of a subscriber to commands: whether its quality of service fits ours."""


def endpoints(infos: list[Any]) -> list[Endpoint]:
    """Return what the graph says of a topic's publishers or subscribers."""
    return [Endpoint(f"{info.node_namespace.rstrip('/')}/{info.node_name}", info.topic_type) for info in infos]


def without(found: list[Endpoint], *names: str) -> list[Endpoint]:
    """Return the endpoints without one of each name: a second node of the same name is somebody else."""
    rest, missing = [], list(names)
    for endpoint in found:
        if endpoint.node in missing:
            missing.remove(endpoint.node)
        else:
            rest.append(endpoint)
    return rest


def choose_type(listeners: list[Endpoint]) -> str:
    """Return the type in which a base listens, empty while nobody does. Twist wins where both are asked for."""
    kinds = [TYPES[endpoint.type] for endpoint in listeners if endpoint.type in TYPES]
    return min(kinds, default="", key=list(TYPES.values()).index)


def finite_command(node: Any, topic: str, v: float, omega: float) -> tuple[float, float]:
    """Return a command to a base of ours, v [m/s] and omega [rad/s]; zero, and a warning, where it is not finite."""
    if math.isfinite(v) and math.isfinite(omega):
        return v, omega
    node.get_logger().warning(f"{node.resolve_topic_name(topic)}: a command v {v:g} m/s, omega {omega:g} rad/s is not "
                              "finite and counts as zero: correct its sender", throttle_duration_sec=1.0)
    return 0.0, 0.0


class CommandListener:
    """Hears the commands on a topic, whatever their type and quality of service.

    One participant can use a topic in one type only, so the topic is opened when its type is known.
    """

    def __init__(self, node: Any, topic: str, kind: str, on_command: Callable[[float, float, bool], None]
                 ) -> None:
        """Prepare the topic.

        Args:
            node: ROS node.
            topic: its name, resolved by the node's namespace and remappings.
            kind: Twist, TwistStamped, or auto: as the base listens.
            on_command: called with v [m/s] and omega [rad/s] of every command on the topic, our own ones too, and with
                whether it bears the mark of a guard.
        """
        self.node, self.name = node, node.resolve_topic_name(topic)
        self.kind = ""
        """Type of the commands; empty while it is unknown."""
        self._on_command = on_command
        self._own = ros.full_name(node)
        namespace = self._own.rpartition("/")[0]
        names = (ros.DRIVE_NAME, ros.GUARD_NAME, ros.RECORD_NAME, ros.MANOEUVRE_NAME)
        tools = [f"{namespace}/{name}" for name in names]
        self._known = [self._own, *(name for name in tools if name != self._own)]
        self._guard = f"{namespace}/{ros.GUARD_NAME}"
        if kind != "auto":
            self._open(kind)

    def know(self, node: str) -> bool:
        """Take a node of the bridge by its full name, which is no base then; return whether it is a new one."""
        new = node not in self._known
        if new:
            self._known.append(node)
        return new

    def readers(self) -> list[Endpoint]:
        """Return all who listen to commands, the bridge's own nodes too."""
        infos = self.node.get_subscriptions_info_by_topic(self.name)
        return [replace(endpoint, hears=ros.hears_commands(info.qos_profile))
                for endpoint, info in zip(endpoints(infos), infos, strict=True)]

    def listeners(self) -> list[Endpoint]:
        """Return who listens to commands, without those whose name is not known yet and nodes of the bridge.

        DDS lists a node that was killed beside its successor for 20 s: none of the two is a base.
        """
        return [one for one in self.readers() if one.node not in self._known and UNKNOWN not in one.node]

    def hears_us(self, endpoint: Endpoint) -> bool:
        """Return whether a listener gets the commands of this topic, by its type and its quality of service."""
        return bool(self.kind) and endpoint.type.endswith("/" + self.kind) and endpoint.hears

    def commanders(self) -> list[str]:
        """Return the names of all other nodes that publish commands, guards left out.

        A guard sends nothing but zeros, and DDS lists one that was killed beside its successor for 20 s. What else a
        node of that name sends is noticed when it comes. The graph knows a node's endpoint before its name: such a name
        contains `UNKNOWN`, the guard's own too.
        """
        found = without(endpoints(self.node.get_publishers_info_by_topic(self.name)), self._own)
        return sorted(endpoint.node for endpoint in found if endpoint.node != self._guard)

    def look(self) -> bool:
        """Open the topic as soon as its type is known; return whether it is open."""
        kind = self.kind or choose_type(self._witnesses())
        if kind and not self.kind:
            self._open(kind)
        return bool(self.kind)

    def _witnesses(self) -> list[Endpoint]:
        """Return whose types decide."""
        return self.listeners() or endpoints(self.node.get_publishers_info_by_topic(self.name))

    def _open(self, kind: str) -> None:
        from geometry_msgs import msg

        self.kind, self._message = kind, getattr(msg, kind)

        def heard(message: Any) -> None:
            planar = message.twist if kind == "TwistStamped" else message
            self._on_command(planar.linear.x, planar.angular.z, is_marked(planar))

        ros.subscribe_own(self.node, self._message, self.name, heard, ros.best_effort(HEARD_DEPTH))


class CommandTopic(CommandListener):
    """Publishes commands in the type that the base listens to, and hears those of others."""

    publisher: Any = None

    def publish(self, v: float, omega: float, marked: bool = False) -> None:
        """Send one command, where the topic is open; `marked` is a zero of the guard."""
        if self.publisher is None:
            return
        message = planar = self._message()
        if self.kind == "TwistStamped":
            message.header.stamp = self.node.get_clock().now().to_msg()
            message.header.frame_id = "base_link"
            planar = message.twist
        planar.linear.x, planar.angular.z = float(v), float(omega)
        if marked:
            mark_zero(planar)
        self.publisher.publish(message)

    def publish_stops(self, count: int = 5, interval: float = 0.02) -> None:
        """Send zeros, spaced so that a depth-1 reader gets each, and wait for their delivery."""
        from rclpy.duration import Duration

        if self.publisher is None:
            return
        for _ in range(count):
            self.publish(0.0, 0.0)
            time.sleep(interval)
        self.publisher.wait_for_all_acked(Duration(seconds=0.5))

    def reaches_all(self) -> bool:
        """Return whether the transport has matched every reader that hears us and that the graph knows."""
        expected = sum(map(self.hears_us, self.readers()))  # the bridge's own ones are matched too
        return self.publisher is not None and self.publisher.get_subscription_count() >= expected

    def _witnesses(self) -> list[Endpoint]:
        return self.listeners()

    def _open(self, kind: str) -> None:
        super()._open(kind)
        self.publisher = self.node.create_publisher(self._message, self.name, ros.reliable())
