"""An independent process that stops the vehicle when the policy node dies without a word.

    python -m bridge.guard

The vehicle's driver has no command timeout of its own. The guard listens to the command topic: when the last command
was a motion and none has followed for SILENCE seconds, it publishes zeros. It never publishes anything else.
"""

import argparse
import sys
import time
from typing import Any

from bridge import ros

SILENCE = 0.17
"""[s]; the policy node sends at least every 0.125 s."""
WATCH_PERIOD = 0.01
REPEATS = 10
"""Zeros sent per stop, 50 ms apart."""


class Watchdog:
    """Decides when to send zeros; pure, with injected time."""

    def __init__(self) -> None:
        self.stops = 0
        self.heard = False
        self._moving = False
        self._last = 0.0
        self._left = 0
        self._next = 0.0

    def command(self, now: float, moves: bool) -> None:
        """Take a command from the topic; the guard's own zeros come back here and change nothing."""
        self._last, self.heard = now, True
        self._moving = moves
        if moves:
            self._left = 0

    def tick(self, now: float) -> bool:
        """Return whether to publish a zero now."""
        if self._moving and now - self._last > SILENCE:
            self._moving, self._left, self._next = False, REPEATS, now
            self.stops += 1
        if self._left and now >= self._next:
            self._left, self._next = self._left - 1, now + 0.05
            return True
        return False


def main(arguments: list[str] | None = None) -> int:
    """Guard until SIGTERM or Ctrl-C."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="bridge.guard", description="Stop the vehicle if the policy node is killed.")
    parser.add_argument("--realtime", type=int, default=0, metavar="PRIORITY", help="SCHED_FIFO priority, like 20")
    options = parser.parse_args(own)
    with ros.node_session(ros.GUARD_NAME, ros_arguments, options.realtime) as node:
        from geometry_msgs.msg import Twist

        watchdog = Watchdog()
        publisher = node.create_publisher(Twist, ros.COMMAND_TOPIC, ros.reliable())

        def on_command(message: Any) -> None:
            # not-finite values compare unequal to 0, so they count as motion
            watchdog.command(time.monotonic(), message.linear.x != 0 or message.angular.z != 0)

        def on_watch() -> None:
            stops = watchdog.stops
            if watchdog.tick(time.monotonic()):
                publisher.publish(ros.twist(0.0, 0.0))
            if watchdog.stops != stops:
                node.get_logger().error(f"no command for {SILENCE} s after a motion: vehicle stopped")

        def tell() -> None:
            """Say once that commands are heard and that somebody beside the guard would hear a stop."""
            if watchdog.heard and publisher.get_subscription_count() > 1:
                node.get_logger().info(f"guarding {ros.COMMAND_TOPIC}")
                telling.cancel()

        telling = ros.steady_timer(node, 0.2, tell)
        node.create_subscription(Twist, ros.COMMAND_TOPIC, on_command, ros.reliable())
        ros.steady_timer(node, WATCH_PERIOD, on_watch)
        ros.spin(node)
    return 0


if __name__ == "__main__":
    sys.exit(main())
