"""Send velocity commands to a WHILL Model CR whose driver takes only its virtual joystick.

    python -m bridge.chair_joy --full 0.567 0.557 0.8

It stands between the bridge and that driver as the base: it listens to geometry_msgs/Twist on whill/controller/cmd_vel
and publishes sensor_msgs/Joy on whill/controller/joy. The driver turns axes into whole percents of deflection: axis 1
forward, axis 0 to the left. What full deflection means is the chair's speed profile; measure it. Commands in between
are taken to be in proportion. A command expires after 200 ms: then zeros follow, and silence, so the rider has the
joystick again.
"""

import argparse
import math
import sys
import time
from dataclasses import dataclass
from typing import Any

from bridge.driving.bases import WHILL
from bridge.nodes import ros
from bridge.nodes.commands import finite_command
from bridge.nodes.exits import Exit
from bridge.nodes.options import Parser, ends_at_ctrl_c, in_range, topic_name
from bridge.nodes.parameters import command_line

JOY_TOPIC = "whill/controller/joy"
STEPS = 100
"""Steps of the driver between rest and full deflection."""
WITHIN = 0.25
"""Of a step, by which an axis is sent above it: the driver cuts off what is behind the point."""
ZEROS = 6
"""Sent after the last command, 50 ms apart."""
PERIOD = 0.05


@dataclass(frozen=True)
class Deflection:
    """What the chair does at full deflection."""

    forward: float
    """[m/s]"""
    backward: float
    """[m/s]"""
    turn: float
    """[rad/s]"""

    def axes(self, v: float, omega: float) -> tuple[float, float]:
        """Return the axes (left, forward), each in [-1, 1], of a command; zero where it is not finite."""
        if not (math.isfinite(v) and math.isfinite(omega)):
            return 0.0, 0.0
        return _axis(omega / self.turn), _axis(v / (self.forward if v >= 0 else self.backward))


def _axis(share: float) -> float:
    steps = round(STEPS * max(-1.0, min(1.0, share)))
    return math.copysign((abs(steps) + WITHIN) / STEPS, steps) if 0 < abs(steps) < STEPS else steps / STEPS


class Expiry:
    """Says what to send when commands cease; pure, with injected time."""

    def __init__(self) -> None:
        self._heard, self._left = -math.inf, 0

    def command(self, now: float) -> None:
        """Take note of a command."""
        self._heard, self._left = now, ZEROS

    def zero_is_due(self, now: float) -> bool:
        """Return whether to send a zero now; asking counts it as sent."""
        if now - self._heard <= WHILL.expiry or not self._left:
            return False
        self._left -= 1
        return True

    @property
    def owed(self) -> int:
        """Zeros that are still to be sent after the last command."""
        return self._left


class JoyNode:
    """Turns commands into a joystick's deflection."""

    def __init__(self, node: Any, options: argparse.Namespace) -> None:
        from geometry_msgs.msg import Twist
        from sensor_msgs.msg import Joy

        self.node, self._full, self._expiry, self._joy = node, Deflection(*options.full), Expiry(), Joy
        self._topic = options.command_topic
        self._publisher = node.create_publisher(Joy, options.joy_topic, ros.reliable(10))
        node.create_subscription(Twist, options.command_topic, self._on_command, ros.reliable(10))
        ros.steady_timer(node, PERIOD, self._on_timer)

    def _on_command(self, message: Any) -> None:
        self._expiry.command(time.monotonic())
        self.publish(*finite_command(self.node, self._topic, message.linear.x, message.angular.z))

    def _on_timer(self) -> None:
        if self._expiry.zero_is_due(time.monotonic()):
            self.publish(0.0, 0.0)

    def close(self) -> None:
        """Leave the chair standing where a command moved it, and else to its rider."""
        for _ in range(self._expiry.owed):
            self.publish(0.0, 0.0)
            time.sleep(PERIOD)

    def publish(self, v: float, omega: float) -> None:
        """Send one deflection."""
        message = self._joy(axes=list(self._full.axes(v, omega)))
        message.header.stamp = self.node.get_clock().now().to_msg()
        self._publisher.publish(message)


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.chair_joy", description="Drive a WHILL Model CR by its virtual joystick.")
    parser.add_argument("--full", type=in_range(0.05, 5), nargs=3, required=True,
                        metavar=("FORWARD", "BACKWARD", "TURN"),
                        help="speeds at full deflection, as measured [m/s, m/s, rad/s]")
    parser.add_argument("--command-topic", type=topic_name, default=ros.COMMAND_TOPIC,
                        help="topic of the commands that drive the vehicle")
    parser.add_argument("--joy-topic", type=topic_name, default=JOY_TOPIC,
                        help="sensor_msgs/Joy that the chair's driver reads")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Translate until SIGTERM or Ctrl-C, and leave the chair standing."""
    own, ros_arguments = command_line(arguments, "bridge.chair_joy")
    options = parse_arguments(own)
    with ros.node_session("bridge_chair_joy", ros_arguments) as node:
        joy = JoyNode(node, options)
        try:
            ros.spin(node)
        finally:
            joy.close()
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())
