"""Publish live odometry of a WHILL Model CR2, whose own driver publishes none.

    python -m bridge.chair

Reads whill_msgs/ModelCr2State and publishes nav_msgs/Odometry on whill/odom, which `bridge.record` writes. The state
has no stamp, so the time of receipt counts.
"""

import argparse
import math
import sys
import time
from typing import Any

from bridge.driving.whill import TREAD, WHEEL_RADIUS, ChairState, WheelOdometry
from bridge.nodes import ros
from bridge.nodes.exits import Exit
from bridge.nodes.options import Parser, ends_at_ctrl_c, in_range, topic_name
from bridge.nodes.parameters import command_line

SLOW = 0.15
"""Interval of states [s] above which odometry is too coarse to identify a vehicle from."""


class ChairNode:
    """Turns the chair's states into odometry."""

    def __init__(self, node: Any, options: argparse.Namespace) -> None:
        from nav_msgs.msg import Odometry

        self.node, self.odometry = node, WheelOdometry(options.wheel_radius, options.tread)
        self._message = Odometry
        self._last = math.nan
        self._warned = False
        self.unusable = 0
        """States whose angles or speeds were not finite."""
        self._publisher = node.create_publisher(Odometry, ros.ODOMETRY_TOPIC, ros.reliable())
        node.create_subscription(ros.chair_state_type(), options.state_topic, self._on_state, ros.best_effort(10))

    def _on_state(self, state: Any) -> None:
        now, known = time.monotonic(), ChairState.of(state)
        if now - self._last > SLOW and not self._warned:
            self._warned = True
            self.node.get_logger().warning(f"a state each {now - self._last:.2f} s is too slow to identify a vehicle: "
                                           "start the driver with publish_interval_ms:=20")
        self._last = now
        if not known.is_finite:
            self.unusable += 1
            if self.unusable == 1:
                self.node.get_logger().warning("a state with an angle or speed that is not finite is left out: check "
                                               "the chair's driver")
            return
        pose = self.odometry.update(now, known)
        message = self._message()
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
        message.pose.pose.orientation.z = math.sin(pose.yaw / 2)
        message.pose.pose.orientation.w = math.cos(pose.yaw / 2)
        message.twist.twist.linear.x, message.twist.twist.angular.z = pose.v, pose.omega
        self._publisher.publish(message)


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.chair", description="Publish the odometry of a WHILL Model CR2.")
    parser.add_argument("--state-topic", type=topic_name, default=ros.CHAIR_STATE_TOPIC,
                        help="whill_msgs/ModelCr2State of the chair's driver")
    parser.add_argument("--wheel-radius", type=in_range(0.001, 2), default=WHEEL_RADIUS, help="[m], loaded")
    parser.add_argument("--tread", type=in_range(0.01, 5), default=TREAD, help="[m], between the drive wheels")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Publish until SIGTERM or Ctrl-C."""
    own, ros_arguments = command_line(arguments, "bridge.chair")
    options = parse_arguments(own)
    with ros.node_session("bridge_chair", ros_arguments) as node:
        chair = ChairNode(node, options)
        ros.spin(node)
        if chair.odometry.gaps:
            print(f"bridge.chair: {chair.odometry.gaps} gaps above 2 s in which the pose stood still", file=sys.stderr)
        if chair.unusable:
            print(f"bridge.chair: {chair.unusable} states that were not finite were left out", file=sys.stderr)
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())
