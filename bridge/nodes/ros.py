"""What the nodes share: topics, qualities of service, the DDS profile, start and end of a node.

Only functions import rclpy, so the package can be imported, and its pure parts tested, where ROS 2 is not installed.
"""

import gc
import importlib
import json
import math
import os
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.nodes import scheduling, signals
from bridge.nodes.exits import Exit, OptionError

# All names are relative, so a namespace or a remapping moves them: two bridges on one graph never share a topic.
IMAGE_TOPIC = "sensing/camera/front/image_raw"
GROUND_TRUTH_TOPIC = "ground_truth/odom"
ODOMETRY_TOPIC = "whill/odom"
IMU_TOPIC = "imu"
GOAL_TOPIC = "goal"
CAMERA_INFO_TOPIC = "sensing/camera/front/camera_info"
SCAN_TOPIC = "sensing/lidar/scan"
MAP_TOPIC = "map"
PAUSE_TOPIC = "simulate/pause"
COLLISION_TOPIC = "collision_sensor"
COMMAND_TOPIC = "whill/controller/cmd_vel"
CHAIR_STATE_TOPIC = "whill/states/model_cr2"
JOYSTICK_LOCK_SERVICE = "whill/set_joystick_lock_srv"
E_STOP_TOPIC = "e_stop"
ENABLE_TOPIC = "enable"
JOY_TOPIC = "joy"
STATUS_TOPIC = "bridge/status"
REARM_TOPIC = "bridge/rearm"
HEARTBEAT_TOPIC = "bridge/heartbeat"
GUARD_TOPIC = "bridge/guard"
DRIVE_NAME = "bridge_drive"
GUARD_NAME = "bridge_guard"
RECORD_NAME = "bridge_record"
MANOEUVRE_NAME = "bridge_manoeuvre"
INVALID = 10, 10.0
"""How often an entity of ROS may be invalid within a time [s]: as many as that are an error."""
ENDLESS = 10**18
"""Nanoseconds from which a deadline or a lease is none: DDS has 2^63 - 1 for it."""
PROFILE = Path(__file__).parents[1] / "fastdds.xml"
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


def best_effort(depth: int = 1) -> Any:
    """Sensor data: newest only, losses allowed. A reader of this kind hears every publisher."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)


def reliable(depth: int = 1) -> Any:
    """Commands (depth 1, only the newest counts) and events (depth 10, each counts)."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)


def latched(depth: int = 1) -> Any:
    """A state that late joiners must get: reliable, and the last values are kept for them."""
    from rclpy.qos import DurabilityPolicy

    profile = reliable(depth)
    profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def subscription_events(**callbacks: Any) -> Any:
    """Callbacks for events of a subscription. The class has another module in Humble than in later releases."""
    try:
        from rclpy.event_handler import SubscriptionEventCallbacks
    except ImportError:  # Humble
        from rclpy.qos_event import SubscriptionEventCallbacks  # type: ignore[attr-defined, no-redef]
    return SubscriptionEventCallbacks(**callbacks)


def subscribe_own(node: Any, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any) -> None:
    """Subscribe to a topic between the bridge's own nodes, without the events that warn of unfit publishers."""
    node.create_subscription(kind, topic, callback, profile,
                             event_callbacks=subscription_events(use_default_callbacks=False))


def subscribe_images(node: Any, kind: Any, topic: str, callback: Callable[[Any], None],
                     incompatible: Callable[[Any], None], lost: Callable[[Any], None]) -> None:
    """Subscribe to a camera, with callbacks for an unfit publisher and, where the middleware reports them, losses."""
    subscribe_counting_losses(node, Topic(kind, topic, best_effort()), callback, lost, incompatible_qos=incompatible)


@dataclass(frozen=True)
class Topic:
    """What is subscribed to."""

    kind: Any
    """Class of its messages."""
    name: str
    profile: Any
    """Quality of service."""


def subscribe_counting_losses(node: Any, topic: Topic, callback: Callable[[Any], None], lost: Callable[[Any], None],
                              raw: bool = False, **callbacks: Any) -> Any:
    """Subscribe, with a callback for lost messages where the middleware reports them; return the subscription.

    With `raw` the callback gets the serialised message.
    """
    more = {"raw": True} if raw else {}
    try:
        from rclpy.event_handler import UnsupportedEventTypeError
    except ImportError:  # Humble
        from rclpy.qos_event import UnsupportedEventTypeError  # type: ignore[attr-defined, no-redef]
    try:
        events = subscription_events(message_lost=lost, **callbacks)
        return node.create_subscription(topic.kind, topic.name, callback, topic.profile, event_callbacks=events, **more)
    except UnsupportedEventTypeError:
        events = subscription_events(**callbacks)
        return node.create_subscription(topic.kind, topic.name, callback, topic.profile, event_callbacks=events, **more)


def message_type(kind: str) -> Any:
    """Return the class of a message such as sensor_msgs/LaserScan."""
    package, _, name = kind.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def is_reliable(policy: Any) -> bool:
    """Return whether a publisher's reliability, as the graph gives it, is reliable."""
    from rclpy.qos import ReliabilityPolicy

    return bool(policy == ReliabilityPolicy.RELIABLE)


def hears_commands(requested: Any) -> bool:
    """Return whether a subscriber's quality of service, as the graph gives it, lets it hear `reliable` commands.

    They are not kept for late joiners, and promise neither a deadline nor signs of life, nor who gives these.
    `qos_check_compatible` of rclpy takes the endless deadline of the graph for one.
    """
    from rclpy.qos import LivelinessPolicy

    if requested.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC:  # refused although it may wait for them without end
        return False
    times = requested.deadline.nanoseconds, requested.liveliness_lease_duration.nanoseconds
    return not is_latched(requested.durability) and not any(0 < one < ENDLESS for one in times)


def is_latched(policy: Any) -> bool:
    """Return whether a publisher's durability, as the graph gives it, keeps values for late joiners."""
    from rclpy.qos import DurabilityPolicy

    return bool(policy == DurabilityPolicy.TRANSIENT_LOCAL)


def subscribe_state(node: Any, kind: Any, topic: str, callback: Callable[[Any], None]) -> None:
    """Subscribe to a state such as an emergency stop, whatever quality of service its publisher offers.

    No single reader does. A best-effort one hears all publishers, but may lose a message and gets no earlier value. A
    reliable one loses nothing. A transient-local one gets the value that was latched before the bridge started. Each
    value may come three times.
    """
    for profile in (best_effort(10), reliable(10), latched()):
        # that a publisher does not fit one of the readers is no fault: the first one hears it
        node.create_subscription(kind, topic, callback, profile,
                                 event_callbacks=subscription_events(incompatible_qos=lambda _: None))


def diagnostics(node: Any) -> Callable[[bool, str, dict[str, Any]], None]:
    """Return a function that reports to /diagnostics; it does nothing where diagnostic_msgs is not installed."""
    try:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    except ImportError:
        return lambda well, text, values: None
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", reliable(10))

    def report(well: bool, text: str, values: dict[str, Any]) -> None:
        message = DiagnosticArray()
        message.header.stamp = node.get_clock().now().to_msg()
        pairs = [KeyValue(key=name, value=str(value)) for name, value in values.items()]
        level = b"\x00" if well else b"\x02"  # OK, ERROR
        message.status = [DiagnosticStatus(level=level, name=full_name(node), message=text, values=pairs)]
        publisher.publish(message)

    return report


def clock_publisher(node: Any) -> Callable[[int, int], None]:
    """Return a function that publishes a time (seconds, nanoseconds) on /clock."""
    from rosgraph_msgs.msg import Clock

    publisher = node.create_publisher(Clock, "/clock", reliable())

    def publish(seconds: int, nanoseconds: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = seconds, nanoseconds
        publisher.publish(message)

    return publish


def uses_simulated_time(node: Any) -> bool:
    """Return whether the node's time is that on /clock (`--ros-args -p use_sim_time:=true`)."""
    return bool(node.get_parameter("use_sim_time").value)


def subscribe_clock(node: Any, callback: Callable[[float], None]) -> None:
    """Call with the seconds of each message on /clock, which the node's clock shows by then."""
    from rclpy.time import Time
    from rosgraph_msgs.msg import Clock

    def heard(message: Any) -> None:
        node.get_clock().set_ros_time_override(Time.from_msg(message.clock))  # its own reader may hear it later
        callback(stamp_seconds(message.clock))

    node.create_subscription(Clock, "/clock", heard, best_effort())


def transform_publisher(node: Any) -> Callable[[str, str, Any, float, float, float], None]:
    """Return a function that publishes a frame in another one, its stamp, x, y [m] and yaw [rad] on /tf.

    It does nothing where tf2_msgs is not installed.
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return lambda parent, child, stamp, x, y, yaw: None
    from geometry_msgs.msg import TransformStamped

    publisher = node.create_publisher(TFMessage, "/tf", reliable(100))

    def publish(parent: str, child: str, stamp: Any, x: float, y: float, yaw: float) -> None:
        message = TransformStamped(child_frame_id=child)
        message.header.frame_id, message.header.stamp = parent, stamp
        message.transform.translation.x, message.transform.translation.y = x, y
        message.transform.rotation.z, message.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        publisher.publish(TFMessage(transforms=[message]))

    return publish


def managed_node(name: str) -> Any:
    """Return a lifecycle node; set its `on_active_change` to learn of activation and deactivation.

    It begins unconfigured. What it needs is loaded before it exists, so configuring cannot fail.
    """
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    class ManagedNode(LifecycleNode):
        on_active_change: Callable[[bool], None] = staticmethod(lambda active: None)

        def on_configure(self, state: Any) -> Any:
            return TransitionCallbackReturn.SUCCESS

        def on_activate(self, state: Any) -> Any:
            result = super().on_activate(state)
            if result == TransitionCallbackReturn.SUCCESS:  # else it stays inactive
                self.on_active_change(True)
            return result

        def on_deactivate(self, state: Any) -> Any:
            self.on_active_change(False)
            return super().on_deactivate(state)

        def on_shutdown(self, state: Any) -> Any:
            self.on_active_change(False)
            return TransitionCallbackReturn.SUCCESS

    return ManagedNode(name, start_parameter_services=False)


@contextmanager
def node_session(name: str, arguments: list[str], realtime: int = 0, managed: bool = False) -> Iterator[Any]:
    """A ROS node whose process ends in order: SIGTERM and Ctrl-C leave `spin`, then the caller says goodbye.

    Args:
        name: node name.
        arguments: `--ros-args ...` of the command line, or empty.
        realtime: SCHED_FIFO priority of this process and its DDS threads; 0 leaves the normal scheduling.
        managed: make it a lifecycle node.

    Raises:
        SystemExit: ROS is missing, its arguments cannot be understood, or it does not start; or OptionError in the
            block, whose line is printed.
        KeyboardInterrupt: one of the signals came before the node was there.
    """
    with signals.heard() as stopping:
        if realtime:
            scheduling.set_realtime(name, realtime)
        node = _join(name, arguments, managed)
        try:
            if stopping:
                raise KeyboardInterrupt
            try:
                yield node
            finally:
                stopping.clear()  # `spin` has heeded them
        except OptionError as error:  # one that shows only in the graph
            print(f"{name.replace('_', '.', 1)}: {error}", file=sys.stderr)
            raise SystemExit(int(Exit.REFUSED)) from None
        finally:
            import rclpy

            node.destroy_node()
            rclpy.try_shutdown()


def _join(name: str, arguments: list[str], managed: bool) -> Any:
    """Start ROS and return the node; arguments and errors as of `node_session`."""
    use_dds_profile()
    command = name.replace("_", ".", 1)
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
        from rclpy.utilities import remove_ros_args
    except ImportError as error:
        raise SystemExit(f"{command}: {error}. The nodes need ROS 2 (Humble or newer) for Python. "
                         "Source your ROS installation, or run `pip install -e '.[ros]'` on x86-64.") from error
    words = [sys.argv[0], *arguments]
    try:
        remove_ros_args(words)
    except RuntimeError as error:
        print(f"{command}: {' '.join(arguments)}: ROS does not understand it: {_plain(error)}. Correct it.",
              file=sys.stderr)
        raise SystemExit(int(Exit.REFUSED)) from None
    try:
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
        # no services to read and write parameters: each thing that the executor waits for makes every wait longer
        return managed_node(name) if managed else rclpy.create_node(name, start_parameter_services=False)
    except Exception as error:  # of rclpy, which has many kinds
        rclpy.try_shutdown()
        raise SystemExit(f"{command}: ROS does not start: {_plain(error)}. Correct what follows --ros-args, or the "
                         "environment variable that it names (ROS_DOMAIN_ID, ROS_LOG_DIR, HOME).") from None


def _plain(error: Exception) -> str:
    """Return what an error of ROS says, in one line and without the place in its source."""
    return " ".join(re.sub(r",? at \S+:\d+", "", str(error)).split()).rstrip(".")


def make_executor() -> Any:
    """Return what waits for events of one thread: rclpy's own in C++ where it has one (Jazzy and later), else Python's.

    The one in Python builds its list of everything to wait for anew each time, which takes longer than a callback.
    """
    try:
        from rclpy.experimental import EventsExecutor

        return EventsExecutor()
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()


def spin(node: Any, done: Callable[[], bool] = lambda: False) -> None:
    """Serve callbacks until `done`, SIGTERM, Ctrl-C or SIGHUP, as of a terminal that closes or of a lost connection.

    The node needs a timer, which bounds the reaction time. A SIGHUP that is ignored, as of `nohup`, stays so.
    """
    with signals.heard() as stopping:
        executor = make_executor()
        gc.collect()
        gc.freeze()  # what is there by now stays, so no later collection looks through it and delays a command
        executor.add_node(node)
        try:
            serve = _server(executor)
            while not stopping and not done():
                serve(0.1)
        finally:
            executor.remove_node(node)
            executor.shutdown()


@contextmanager
def undisturbed() -> Iterator[None]:
    """Take no notice of further signals while a node says goodbye: an impatient second Ctrl-C would cut it short."""
    with signals.heard():
        yield


def spin_some(node: Any, seconds: float) -> None:
    """Serve the callbacks of a node that spins no more, for so long [s] at most."""
    executor = make_executor()
    executor.add_node(node)
    try:
        _server(executor)(seconds)
    finally:
        executor.remove_node(node)
        executor.shutdown()


def _server(executor: Any) -> Callable[[float], None]:
    """A function that serves what is due within a time [s].

    A reader that a callback has just replaced by another may still have had an event. An entity that is invalid again
    and again is an error.
    """
    from rclpy.impl.implementation_singleton import rclpy_implementation

    times: deque[float] = deque(maxlen=INVALID[0])

    def serve(seconds: float) -> None:
        try:
            executor.spin_once(timeout_sec=seconds)
        except rclpy_implementation.InvalidHandle:
            times.append(time.monotonic())
            if len(times) == INVALID[0] and times[-1] - times[0] < INVALID[1]:
                raise

    return serve


def steady_timer(node: Any, period: float, callback: Callable[[], object]) -> Any:
    """A timer on the steady clock: a node timer would stop with /clock where the simulation's time is used."""
    from rclpy.clock import Clock, ClockType

    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def _of_the_maker(module: str, name: str, what: str) -> Any:
    """Return a type of the maker's message package; SystemExit says how to get it."""
    try:
        return getattr(importlib.import_module(f"whill_msgs.{module}"), name)
    except ImportError as error:
        raise SystemExit(f"{error}. {what} is a whill_msgs/{name}. Build the maker's ros2_whill_interfaces in your "
                         "workspace and source it.") from error


def chair_state_type() -> Any:
    """Return the message class of the WHILL driver's state.

    Raises:
        SystemExit: the maker's message package is not installed.
    """
    return _of_the_maker("msg", "ModelCr2State", "The chair's state")


def joystick_locker(node: Any) -> Callable[[bool, Callable[[bool], None]], None]:
    """Return a function that asks the WHILL driver to lock the chair's joystick, or to unlock it.

    It calls back with whether the driver has done so, and does nothing while there is no driver.

    Raises:
        SystemExit: the maker's message package is not installed.
    """
    SetJoystickLock = _of_the_maker("srv", "SetJoystickLock", "The joystick's lock")  # noqa: N806
    client = node.create_client(SetJoystickLock, JOYSTICK_LOCK_SERVICE)

    def ask(locked: bool, answered: Callable[[bool], None]) -> None:
        if client.service_is_ready():
            future = client.call_async(SetJoystickLock.Request(d0=int(locked)))
            future.add_done_callback(lambda done: answered(done.exception() is None and done.result().result == 1))

    return ask


def stamp_seconds(stamp: Any) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return stamp.sec + stamp.nanosec * 1e-9


def yaw_of(q: Any) -> float:
    """Return the yaw [rad] of a quaternion of any length; nan where it is no rotation.

    All zeros are those of a message whose orientation was never set.
    """
    length = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z
    if not 0 < length < math.inf:
        return math.nan
    return math.atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def is_measured(covariance: Any) -> bool:
    """Return whether a quantity of sensor_msgs/Imu is measured: -1 in front of its covariance says that it is not."""
    return bool(covariance[0] != -1)


def split_ros_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Split a command line into our arguments and those of ROS, of which each `--ros-args` ends at a `--`."""
    own: list[str] = []
    of_ros: list[str] = []
    here = own
    for word in arguments:
        if word == "--ros-args":
            here = of_ros
        elif word == "--" and here is of_ros:
            here = own
        else:
            here.append(word)
    return own, ["--ros-args", *of_ros] if "--ros-args" in arguments else []


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file in one piece, or raise OSError and leave what was there."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(json.dumps(content) + "\n")
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def write_results(program: str, path: Path, content: dict[str, Any]) -> bool:
    """Write the results file of a node; where that fails, say so and return False: a drive goes on without it."""
    try:
        write_json(path, content)
    except OSError as error:
        print(f"{program}: --results {path}: {error.strerror or error}. The results are not written. Make room there, "
              "or choose another place.", file=sys.stderr)
        return False
    return True


def full_name(node: Any) -> str:
    """Return namespace and name of a node, such as /left/bridge_drive."""
    return f"{node.get_namespace().rstrip('/')}/{node.get_name()}"
