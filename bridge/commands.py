"""The command topic: who listens in which type, who else publishes, and whose each command is."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from bridge import ros

TYPES = {"geometry_msgs/msg/Twist": "Twist", "geometry_msgs/msg/TwistStamped": "TwistStamped"}
"""Message types of commands, and the words for them on the command line."""
UNKNOWN = "_UNKNOWN_"
"""Part of the name that ROS gives to a node which it has not identified yet."""
NAMELESS = "a node without a name"
SETTLE = 1.0
"""Seconds in which nodes that run already have found one another, on a loaded computer too."""
HEARD_DEPTH = 50
"""Commands that may wait to be heard, so that none of another node is overwritten by ours."""
GUARD_REPORTS = 3
"""A zero that this many later reports of the guard do not count came from somebody else; it reports each 50 ms."""
FORGET_REPORTS = 20
"""Reports after which a zero of the guard that we never heard is taken for lost."""


class Ear:
    """Separates our own commands, the guard's zeros and the commands of other nodes; pure.

    ROS does not name the sender of a message. So we compare each command heard with those we sent, exactly. The guard
    reports how many zeros it has sent. We count its reports instead of seconds, so a pause does no harm.
    """

    def __init__(self) -> None:
        self._own: deque[tuple[float, float]] = deque(maxlen=64)
        self._reports = 0
        self._guard_zeros: int | None = None
        self._unknown: deque[int] = deque()  # report number at each zero that neither we nor the guard is known to send
        self._unheard: deque[int] = deque()  # report number at each zero of the guard that we have not heard yet

    def sent(self, v: float, omega: float) -> None:
        """Remember a command of ours."""
        self._own.append((v, omega))

    def heard(self, v: float, omega: float) -> bool:
        """Take a command from the topic; return whether another node surely sent it."""
        if (v, omega) in self._own:
            if v == omega == 0:
                self._own.remove((v, omega))  # it may be the guard's, and earlier ones of ours still on their way
                return False
            while self._own.popleft() != (v, omega):
                pass  # earlier ones were lost on the way
            return False
        if v != 0 or omega != 0:
            return True
        self._unknown.append(self._reports)
        return False

    def guard_reports(self, zeros: int) -> None:
        """Take the number of zeros that the guard has sent so far; a smaller number comes from a restarted guard."""
        self._reports += 1
        before = zeros if self._guard_zeros is None else self._guard_zeros
        self._unheard.extend([self._reports] * (zeros - before if zeros >= before else zeros))
        self._guard_zeros = zeros

    def foreign_zero(self) -> bool:
        """Return whether a zero was heard that neither we nor the guard can have sent."""
        while self._unheard and self._unknown:
            self._unheard.popleft()
            self._unknown.popleft()
        while self._unheard and self._reports - self._unheard[0] > FORGET_REPORTS:
            self._unheard.popleft()
        if not self._unknown or self._reports - self._unknown[0] < GUARD_REPORTS:
            return False
        self._unknown.clear()
        return True


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


class CommandListener:
    """Hears the commands on a topic, whatever their type and quality of service.

    One participant can use a topic in one type only, so the topic is opened when its type is known.
    """

    def __init__(self, node: Any, topic: str, kind: str, on_command: Callable[[float, float], None]) -> None:
        """Prepare the topic.

        Args:
            node: ROS node.
            topic: its name, resolved by the node's namespace and remappings.
            kind: Twist, TwistStamped, or auto: as the base listens.
            on_command: called with v [m/s] and omega [rad/s] of every command on the topic, our own ones too.
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

    def readers(self) -> list[Endpoint]:
        """Return all who listen to commands, the bridge's own nodes too."""
        infos = self.node.get_subscriptions_info_by_topic(self.name)
        return [replace(endpoint, hears=ros.hears_commands(info.qos_profile))
                for endpoint, info in zip(endpoints(infos), infos, strict=True)]

    def listeners(self) -> list[Endpoint]:
        """Return who listens to commands, without the bridge's own nodes and those whose name is not known yet."""
        return [endpoint for endpoint in without(self.readers(), *self._known) if UNKNOWN not in endpoint.node]

    def hears_us(self, endpoint: Endpoint) -> bool:
        """Return whether a listener gets the commands of this topic, by its type and its quality of service."""
        return bool(self.kind) and endpoint.type.endswith("/" + self.kind) and endpoint.hears

    def commanders(self) -> list[str]:
        """Return the names of all other nodes that publish commands; one guard beside us is not among them.

        The graph knows a node's endpoint before its name: such a name contains `UNKNOWN`, the guard's own too.
        """
        found = endpoints(self.node.get_publishers_info_by_topic(self.name))
        return sorted(endpoint.node for endpoint in without(found, self._own, self._guard))

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
            self._on_command(planar.linear.x, planar.angular.z)

        ros.subscribe_own(self.node, self._message, self.name, heard, ros.best_effort(HEARD_DEPTH))


class CommandTopic(CommandListener):
    """Publishes commands in the type that the base listens to, and hears those of others."""

    publisher: Any = None

    def publish(self, v: float, omega: float) -> None:
        """Send one command, where the topic is open."""
        if self.publisher is None:
            return
        message = planar = self._message()
        if self.kind == "TwistStamped":
            message.header.stamp = self.node.get_clock().now().to_msg()
            message.header.frame_id = "base_link"
            planar = message.twist
        planar.linear.x, planar.angular.z = float(v), float(omega)
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
