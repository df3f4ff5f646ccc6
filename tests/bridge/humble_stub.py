"""The part of Humble's rclpy (3.3) that the bridge may use, without transport: names and signatures of its sources.

What came later is not here: `event_handler` (Iron), message info in callbacks (3.4), `matched` events (Iron). `install`
puts the modules in place of any real ones.
"""

import sys
import types
from dataclasses import dataclass, field


class Message:
    """A ROS message: only declared fields, by keyword."""

    fields: dict = {}

    def __init__(self, **values):
        for name, make in self.fields.items():
            setattr(self, name, make())
        for name, value in values.items():
            if name not in self.fields:
                raise AttributeError(f"{type(self).__name__} has no field {name}")
            setattr(self, name, value)


def message(kind, /, **fields):
    return type(kind, (Message,), {"fields": fields})


Time = message("Time", sec=int, nanosec=int)
Header = message("Header", stamp=Time, frame_id=str)
Vector3 = message("Vector3", x=float, y=float, z=float)
Twist = message("Twist", linear=Vector3, angular=Vector3)
TwistStamped = message("TwistStamped", header=Header, twist=Twist)
Bool, Empty, String = message("Bool", data=bool), message("Empty"), message("String", data=str)
KeyValue = message("KeyValue", key=str, value=str)
DiagnosticStatus = message("DiagnosticStatus", level=bytes, name=str, message=str, hardware_id=str, values=list)
DiagnosticArray = message("DiagnosticArray", header=Header, status=list)
Joy = message("Joy", header=Header, axes=list, buttons=list)
ModelCr2State = message(
    "ModelCr2State", battery_power=int, battery_current=float, right_motor_angle=float, left_motor_angle=float,
    right_motor_speed=float, left_motor_speed=float, power_on=int, speed_mode_indicator=int, error=int, joy_front=int,
    joy_side=int)
Quaternion = message("Quaternion", x=float, y=float, z=float, w=float)
Pose = message("Pose", position=Vector3, orientation=Quaternion)
PoseWithCovariance = message("PoseWithCovariance", pose=Pose, covariance=list)
TwistWithCovariance = message("TwistWithCovariance", twist=Twist, covariance=list)
Odometry = message("Odometry", header=Header, child_frame_id=str, pose=PoseWithCovariance, twist=TwistWithCovariance)
Image = message("Image", header=Header, height=int, width=int, encoding=str, is_bigendian=int, step=int, data=bytes)
CompressedImage = message("CompressedImage", header=Header, format=str, data=bytes)


class UnsupportedEventTypeError(Exception):
    pass


class SubscriptionEventCallbacks:
    def __init__(self, *, deadline=None, incompatible_qos=None, liveliness=None, message_lost=None,
                 use_default_callbacks=True):
        self.message_lost = message_lost


class Duration:
    def __init__(self, *, seconds=0, nanoseconds=0):
        self.nanoseconds = int(seconds * 1e9) + nanoseconds


class JumpThreshold:
    def __init__(self, *, min_forward, min_backward, on_clock_change=True):
        if min_forward.nanoseconds <= 0 or min_backward.nanoseconds >= 0:
            raise ValueError("zero durations are forbidden")


class ClockType:
    ROS_TIME, SYSTEM_TIME, STEADY_TIME = 1, 2, 3


@dataclass
class Clock:
    clock_type: int = ClockType.SYSTEM_TIME
    nanoseconds: int = 0

    def now(self):
        stamp = Time(sec=self.nanoseconds // 10**9, nanosec=self.nanoseconds % 10**9)
        return types.SimpleNamespace(nanoseconds=self.nanoseconds, to_msg=lambda: stamp)

    def create_jump_callback(self, threshold, *, pre_callback=None, post_callback=None):
        return object()


@dataclass
class QoSProfile:
    depth: int
    history: str = ""
    reliability: str = "RELIABLE"
    durability: str = "VOLATILE"
    deadline: Duration = Duration()
    liveliness: str = "AUTOMATIC"
    liveliness_lease_duration: Duration = Duration()


class Policy:
    KEEP_LAST, BEST_EFFORT, RELIABLE, TRANSIENT_LOCAL = "KEEP_LAST", "BEST_EFFORT", "RELIABLE", "TRANSIENT_LOCAL"
    MANUAL_BY_TOPIC = "MANUAL_BY_TOPIC"


@dataclass
class Publisher:
    node: "Node"
    type: type
    topic: str
    sent: list = field(default_factory=list)

    def publish(self, msg):
        if not isinstance(msg, self.type):
            raise TypeError(f"{self.topic} takes {self.type}")
        self.sent.append(msg)

    def get_subscription_count(self):
        return 2

    def wait_for_all_acked(self, timeout=None):
        return True


class SetJoystickLock:
    Request = message("SetJoystickLock_Request", d0=int)


class Client:
    """A client whose service answers at once, while there is one."""

    def __init__(self):
        self.asked, self.ready = [], True

    def service_is_ready(self):
        return self.ready

    def call_async(self, request):
        self.asked.append(request.d0)
        answer = types.SimpleNamespace(exception=lambda: None, result=lambda: types.SimpleNamespace(result=1))
        return types.SimpleNamespace(add_done_callback=lambda callback: callback(answer))


class Node:
    """Records what is created; `deliver` and `fire` stand for transport and time."""

    def __init__(self, name="node"):
        self.name, self.clock = name, Clock()
        self.publishers, self.subscriptions, self.timers, self.logged, self.clients = {}, [], [], [], {}
        self.topics = {}  # what the graph says: topic to type of a foreign reader
        self.fails_on_lost_events = True  # as rmw_fastrtps of Humble

    def get_name(self):
        return self.name

    def get_namespace(self):
        return "/"

    def get_clock(self):
        return self.clock

    def get_parameter(self, name):
        return types.SimpleNamespace(name=name, value=False)  # of a node without parameters, use_sim_time alone

    def get_logger(self):
        log = self.logged.append
        return types.SimpleNamespace(info=log, warning=log, error=log)

    def resolve_topic_name(self, topic, *, only_expand=False):
        return topic if topic.startswith("/") else f"/{topic}"

    def create_publisher(self, msg_type, topic, qos_profile, *, callback_group=None, event_callbacks=None):
        return self.publishers.setdefault(self.resolve_topic_name(topic), Publisher(self, msg_type, topic))

    def create_subscription(self, msg_type, topic, callback, qos_profile, *, callback_group=None, event_callbacks=None,
                            qos_overriding_options=None, raw=False):
        if event_callbacks is not None and event_callbacks.message_lost and self.fails_on_lost_events:
            raise UnsupportedEventTypeError
        self.subscriptions.append((self.resolve_topic_name(topic), msg_type, callback))

    def create_client(self, srv_type, srv_name, *, qos_profile=None, callback_group=None):
        return self.clients.setdefault(self.resolve_topic_name(srv_name), Client())

    def create_timer(self, timer_period_sec, callback, callback_group=None, clock=None):
        self.timers.append((timer_period_sec, callback))

    def get_publishers_info_by_topic(self, topic_name, no_mangle=False):
        return []

    def get_subscriptions_info_by_topic(self, topic_name, no_mangle=False):
        kind = self.topics.get(topic_name)
        info = types.SimpleNamespace(node_name="base", node_namespace="/", topic_type=kind, qos_profile=QoSProfile(10))
        return [info] if kind else []

    def deliver(self, topic, msg):
        for name, kind, callback in list(self.subscriptions):
            if name == topic and isinstance(msg, kind):
                callback(msg)

    def fire(self):
        for _, callback in list(self.timers):
            callback()


class SingleThreadedExecutor:
    """The only executor of one thread that Humble has."""


def create_node(name, *, start_parameter_services=True):
    return Node(name)


def install():
    """Put the stub in place of rclpy and of the message packages."""
    modules = {
        "rclpy": {"init": lambda **_: None, "create_node": create_node, "try_shutdown": lambda: None},
        "rclpy.clock": {"Clock": Clock, "ClockType": ClockType, "JumpThreshold": JumpThreshold},
        "rclpy.executors": {"SingleThreadedExecutor": SingleThreadedExecutor},
        "rclpy.duration": {"Duration": Duration},
        "rclpy.qos": {"QoSProfile": QoSProfile, "HistoryPolicy": Policy, "ReliabilityPolicy": Policy,
                      "DurabilityPolicy": Policy, "LivelinessPolicy": Policy},
        "rclpy.qos_event": {"SubscriptionEventCallbacks": SubscriptionEventCallbacks,
                            "UnsupportedEventTypeError": UnsupportedEventTypeError},
        "rclpy.signals": {"SignalHandlerOptions": types.SimpleNamespace(NO=0)},
        "std_msgs": {}, "std_msgs.msg": {"Bool": Bool, "Empty": Empty, "String": String, "Header": Header},
        "sensor_msgs": {}, "sensor_msgs.msg": {"Image": Image, "CompressedImage": CompressedImage, "Joy": Joy},
        "nav_msgs": {}, "nav_msgs.msg": {"Odometry": Odometry},
        "diagnostic_msgs": {}, "diagnostic_msgs.msg": {"DiagnosticArray": DiagnosticArray,
                                                       "DiagnosticStatus": DiagnosticStatus, "KeyValue": KeyValue},
        "whill_msgs": {}, "whill_msgs.msg": {"ModelCr2State": ModelCr2State},
        "whill_msgs.srv": {"SetJoystickLock": SetJoystickLock},
        "geometry_msgs": {}, "geometry_msgs.msg": {"Twist": Twist, "TwistStamped": TwistStamped},
    }
    for name in [name for name in sys.modules if name.split(".")[0] in modules]:
        del sys.modules[name]
    for name, content in modules.items():
        module = types.ModuleType(name)
        module.__path__ = []  # a package without files: what is not listed cannot be imported
        vars(module).update(content)
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
