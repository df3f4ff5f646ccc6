"""What the nodes share: topics, qualities of service, the DDS profile, start and end of a node.

Only functions import rclpy, so the package can be imported, and its pure parts tested, where ROS 2 is not installed.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

IMAGE_TOPIC = "/sensing/camera/front/image_raw"
GROUND_TRUTH_TOPIC = "/ground_truth/odom"
ODOMETRY_TOPIC = "/whill/odom"
COLLISION_TOPIC = "/collision_sensor"
COMMAND_TOPIC = "/whill/controller/cmd_vel"
STATUS_TOPIC = "/bridge/status"
REARM_TOPIC = "/bridge/rearm"
GUARD_NAME = "bridge_guard"
PROFILE = Path(__file__).with_name("fastdds.xml")
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


def use_dds_profile(environment: MutableMapping[str, str] = os.environ) -> str:
    """Point Fast DDS to the bridge's profile unless the user chose one; return the file in force.

    It is read when the first node starts, so this comes before `rclpy.init`.
    """
    for variable in PROFILE_VARIABLES:
        if environment.get(variable):
            return environment[variable]
    environment[PROFILE_VARIABLES[0]] = str(PROFILE)
    return str(PROFILE)


def set_realtime(name: str, priority: int) -> None:
    """Run this thread, and those it starts, before all normal processes; say so where not permitted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, ValueError) as error:
        print(f"{name}: --realtime {priority}: {error}. It needs a priority from 1 to 99 and the right to use it. "
              "Run `setcap cap_sys_nice=ep` on the interpreter or raise rtprio in limits.conf; going on without.",
              file=sys.stderr)


def best_effort() -> Any:
    """Sensor data: newest only, losses allowed."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)


def reliable(depth: int = 1) -> Any:
    """Commands (depth 1, only the newest counts) and events (depth 10, each counts)."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)


@contextmanager
def node_session(name: str, arguments: list[str], realtime: int = 0) -> Iterator[Any]:
    """A ROS node whose process ends in order: SIGTERM and Ctrl-C leave `spin`, then the caller says goodbye.

    Args:
        name: node name.
        arguments: `--ros-args ...` of the command line, or empty.
        realtime: SCHED_FIFO priority of this process and its DDS threads; 0 leaves the normal scheduling.
    """
    if realtime:
        set_realtime(name, realtime)
    use_dds_profile()
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise SystemExit(f"{name}: {error}. The nodes need ROS 2 (Jazzy) for Python. "
                         "Run `pip install -e '.[ros]'` or source your ROS installation.") from error
    rclpy.init(args=[sys.argv[0], *arguments], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(name)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def spin(node: Any, done: Callable[[], bool] = lambda: False) -> None:
    """Serve callbacks until `done`, SIGTERM or Ctrl-C. The node needs a timer, which bounds the reaction time."""
    from rclpy.executors import SingleThreadedExecutor

    stopping = []

    def stop(number: int, _: FrameType | None) -> None:
        stopping.append(number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not stopping and not done():
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.remove_node(node)
        executor.shutdown()
        for number, handler in before.items():
            signal.signal(number, handler)


def steady_timer(node: Any, period: float, callback: Callable[[], None]) -> Any:
    """A timer on the steady clock: a node timer would stop with /clock where the simulation's time is used."""
    from rclpy.clock import Clock, ClockType

    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def stamp_seconds(stamp: Any) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return stamp.sec + stamp.nanosec * 1e-9


def twist(v: float, omega: float) -> Any:
    """geometry_msgs/Twist of a planar command: v [m/s], omega [rad/s]."""
    from geometry_msgs.msg import Twist

    message = Twist()
    message.linear.x, message.angular.z = float(v), float(omega)
    return message


def publish_stops(publisher: Any, count: int = 5, interval: float = 0.02) -> None:
    """Publish `count` zero commands, spaced so that a depth-1 reader gets each, and wait for their delivery."""
    from rclpy.duration import Duration

    for _ in range(count):
        publisher.publish(twist(0.0, 0.0))
        time.sleep(interval)
    publisher.wait_for_all_acked(Duration(seconds=0.5))


def split_ros_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Split a command line into our arguments and those from `--ros-args` on."""
    if "--ros-args" not in arguments:
        return arguments, []
    at = arguments.index("--ros-args")
    return arguments[:at], arguments[at:]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file in one piece."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(json.dumps(content) + "\n")
    os.replace(temporary, path)
