"""The policy node: camera image in, wheel command out.

    python -m bridge.drive runs/corridor/policy

Commands are computed when a frame arrives; a 100 Hz watch stops the vehicle within 10 ms of any limit. The node's state
is published as JSON on /bridge/status once a second; a latched stop is released by a message on /bridge/rearm.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from bridge import ros
from bridge.controller import Controller
from bridge.policy import Policy, PolicyFileError
from bridge.safety import Command, SafetyConfig

WATCH_PERIOD = 0.01
STATUS_PERIOD = 1.0
SILENT_AFTER = 2.0
"""Seconds without a first frame after which the cause is named."""
CLOCK_STEP = 0.1
"""Difference [s] of wall and steady clock between two watches that counts as a clock jump."""


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(prog="bridge.drive", description="Drive a vehicle with a policy file.")
    parser.add_argument("policy", help="policy file: a folder or a zip of it")
    parser.add_argument("--v-limits", type=float, nargs=2, metavar=("LOW", "HIGH"), help="[m/s]; default: the policy's")
    parser.add_argument("--omega-limits", type=float, nargs=2, metavar=("LOW", "HIGH"), help="[rad/s]")
    parser.add_argument("--image-topic", default=ros.IMAGE_TOPIC)
    parser.add_argument("--command-topic", default=ros.COMMAND_TOPIC)
    parser.add_argument("--collision", choices=("latch", "release", "ignore"), default="latch",
                        help="on /collision_sensor true: stop until re-armed, stop while it lasts, or take no notice")
    parser.add_argument("--stamp-age", type=float, default=SafetyConfig.stamp_age,
                        help="largest age of a stamp [s]; inf where camera and bridge share no clock")
    parser.add_argument("--allow-other-commanders", action="store_true",
                        help="drive although another node publishes commands on the same topic")
    parser.add_argument("--realtime", type=int, default=0, metavar="PRIORITY", help="SCHED_FIFO priority, like 20")
    parser.add_argument("--require-arm", action="store_true", help="stand until a first message on /bridge/rearm")
    parser.add_argument("--results", type=Path, help="JSON file for the counts of the drive, written at its end")
    return parser.parse_args(arguments)


def safety_config(policy: Policy, options: argparse.Namespace) -> SafetyConfig:
    """Return the limits in force: the policy's own, narrowed by the command line, zero always included."""
    contract = policy.contract
    low, high = [min(x, 0.0) for x in contract.low], [max(x, 0.0) for x in contract.high]
    for i, limits in enumerate((options.v_limits, options.omega_limits)):
        if limits:
            low[i], high[i] = max(low[i], limits[0]), min(high[i], limits[1])
    return SafetyConfig(low=(low[0], low[1]), high=(high[0], high[1]), stamp_age=options.stamp_age)


def explain_silence(topic: str, publishers: int, incompatible: bool) -> str:
    """Return why no frame has come, as far as the graph tells."""
    if publishers == 0:
        return f"no publisher on {topic}: start the camera, or compare ROS_DOMAIN_ID and the topic name"
    if incompatible:
        return f"{topic}: the publisher's quality of service does not fit a best-effort, volatile reader: change it"
    return (f"{topic}: {publishers} publisher(s) matched but no frame arrives. Large best-effort images are lost in a "
            f"small shared-memory segment: start the camera with {ros.PROFILE_VARIABLES[0]}={ros.PROFILE}")


def other_commanders(node: Any, topic: str) -> list[str]:
    """Return the names of all nodes that publish commands, without one of this node's name and without the guard."""
    names = [info.node_name for info in node.get_publishers_info_by_topic(topic)]
    if node.get_name() in names:
        names.remove(node.get_name())  # once: a second bridge has the same name
    return [name for name in names if name != ros.GUARD_NAME]


class DriveNode:
    """Connects one controller to the ROS graph."""

    def __init__(self, node: Any, controller: Controller, options: argparse.Namespace) -> None:
        from geometry_msgs.msg import Twist
        from rclpy.clock import JumpThreshold
        from rclpy.duration import Duration
        from rclpy.event_handler import SubscriptionEventCallbacks
        from sensor_msgs.msg import Image
        from std_msgs.msg import Bool, Empty, String

        self.node, self.controller, self.options = node, controller, options
        self.supervisor = controller.supervisor
        self.publisher = node.create_publisher(Twist, options.command_topic, ros.reliable())
        self._status = node.create_publisher(String, ros.STATUS_TOPIC, ros.reliable())
        self._status_type = String
        self._incompatible = False
        events = SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible)
        node.create_subscription(Image, options.image_topic, self._on_image, ros.best_effort(), event_callbacks=events)
        node.create_subscription(Empty, ros.REARM_TOPIC, self._on_rearm, ros.reliable())
        if options.collision != "ignore":
            node.create_subscription(Bool, ros.COLLISION_TOPIC, self._on_collision, ros.reliable(10))
        jump = JumpThreshold(min_forward=Duration(seconds=0.5), min_backward=Duration(seconds=-0.01),
                             on_clock_change=True)
        self._jump = node.get_clock().create_jump_callback(
            jump, post_callback=lambda _: self.supervisor.clock_jump())
        if options.require_arm:
            self.supervisor.latch("not armed")
        self._started = time.monotonic()
        self._clock_offset = time.time() - self._started
        self._told: tuple[str, str] | None = None
        self._others: list[str] = []
        ros.steady_timer(node, WATCH_PERIOD, self._on_watch)
        ros.steady_timer(node, STATUS_PERIOD, self._on_status)

    def _on_image(self, message: Any) -> None:
        now = time.monotonic()
        stamp = ros.stamp_seconds(message.header.stamp)
        age = self.node.get_clock().now().nanoseconds * 1e-9 - stamp
        self._publish(self.controller.on_image(now, stamp, age, message.height, message.width, message.encoding,
                                               message.step, message.data))

    def _on_watch(self) -> None:
        now = time.monotonic()
        offset = time.time() - now
        if abs(offset - self._clock_offset) > CLOCK_STEP:
            self.supervisor.clock_jump()
        self._clock_offset = offset
        self._publish(self.controller.on_tick(now))

    def _on_collision(self, message: Any) -> None:
        if message.data and self.options.collision == "latch":
            self.supervisor.latch("collision")
        self.supervisor.block("collision", message.data)
        self._publish(self.controller.on_tick(time.monotonic()))

    def _on_rearm(self, _: Any) -> None:
        if not self.supervisor.rearm():
            self.node.get_logger().error(f"not re-armed: {self.supervisor.reason} still holds")

    def _on_incompatible(self, _: Any) -> None:
        self._incompatible = True

    def _on_status(self) -> None:
        before, self._others = self._others, other_commanders(self.node, self.options.command_topic)
        others = self._others if before else []  # seen twice: at first a node's name, the guard's too, is not known yet
        forbidden = bool(others) and not self.options.allow_other_commanders
        self.supervisor.block("another node publishes commands", forbidden)
        reason = self.supervisor.reason
        detail = self.controller.last_error
        if not self.supervisor.counts["frames"] and time.monotonic() - self._started > SILENT_AFTER:
            detail = detail or self._explain_silence()
        elif others:
            detail = f"{self.options.command_topic} has other publishers: {others}; stop them"
        status = {"driving": not reason, "reason": reason, "detail": detail, "counts": dict(self.supervisor.counts)}
        self._status.publish(self._status_type(data=json.dumps(status)))
        if (reason, detail) != self._told:
            log = self.node.get_logger()
            log.warning(f"standing: {reason}. {detail}") if reason else log.info("driving")
        self._told = (reason, detail)

    def _explain_silence(self) -> str:
        late = self.supervisor.counts["late"]
        if late:
            return (f"{late} frames are stamped more than {self.options.stamp_age} s from now: "
                    "set the camera's clock, or give --stamp-age inf")
        topic = self.options.image_topic
        return explain_silence(topic, self.node.count_publishers(topic), self._incompatible)

    def _publish(self, command: Command | None) -> None:
        if command is not None:
            self.publisher.publish(ros.twist(command.v, command.omega))


def main(arguments: list[str] | None = None) -> int:
    """Run the node until SIGTERM or Ctrl-C; return 2 where the policy file is refused."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    options = parse_arguments(own)
    try:
        policy = Policy.load(options.policy)
        safety = safety_config(policy, options)
    except (PolicyFileError, ValueError) as error:
        print(f"bridge.drive: {error}", file=sys.stderr)
        return 2
    with ros.node_session("bridge_drive", ros_arguments, options.realtime) as node:
        drive = DriveNode(node, Controller(policy, safety), options)
        try:
            ros.spin(node)
        finally:
            ros.publish_stops(drive.publisher)
        if options.results:
            supervisor = drive.supervisor
            ros.write_json(options.results, {"counts": dict(supervisor.counts), "reason": supervisor.reason})
    return 0


if __name__ == "__main__":
    sys.exit(main())
