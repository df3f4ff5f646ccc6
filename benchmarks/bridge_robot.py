"""A plain ROS node that plays a vehicle: camera, base, emergency stop, operator. For the bridge's tests and figures.

It shares no code with the bridge but the quality of service of images, so what it hears is what a real base would hear.
"""

from __future__ import annotations

import array
import contextlib
import importlib
import json
import os
import threading
import time
from collections.abc import Callable
from typing import Any

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
Heard = tuple[float, float, float]
"""Steady time of receipt [s], v [m/s], omega [rad/s]."""


def message_type(name: str) -> Any:
    """Return the class of a message such as std_msgs/Bool."""
    package, _, kind = name.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def environment_of(domain: int) -> dict[str, str]:
    """Return the environment of processes on a domain of this computer."""
    return {**os.environ, RANGE: discovery_range(), "ROS_DOMAIN_ID": str(domain)}


def discovery_range() -> str:
    """Return how far nodes look: on this computer alone, unless a profile of Fast DDS is given, as by the tests."""
    own = "FASTRTPS_DEFAULT_PROFILES_FILE" in os.environ
    return os.environ.get(RANGE, "SYSTEM_DEFAULT") if own else "LOCALHOST"


class Switch:
    """A truth value that is published again and again, and at once when it is set by `turn`."""

    def __init__(self, robot: Robot, topic: str, value: bool, profile: Any = 1) -> None:
        self.value = value
        self._make = message_type("std_msgs/Bool")
        self._publisher = robot.publisher("std_msgs/Bool", topic, profile)
        self.timer = robot.repeat(self._publisher, 0.02, lambda: self._make(data=self.value))

    def turn(self, value: bool) -> None:
        """Set and publish the value."""
        self.value = value
        self._publisher.publish(self._make(data=value))


class Robot:
    """Whatever parts of a vehicle are asked for, served by a thread."""

    def __init__(self, domain: int, name: str = "robot") -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        before = os.environ.get(RANGE)
        os.environ[RANGE] = discovery_range()
        self.context = rclpy.Context()
        try:
            rclpy.init(context=self.context, domain_id=domain)
        finally:
            del os.environ[RANGE]
            if before is not None:
                os.environ[RANGE] = before
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.commands: list[Heard] = []
        self.statuses: list[dict[str, Any]] = []
        self.frames = 0
        self.clock_offset, self.encoding, self.frozen = 0.0, "rgb8", False  # of the camera
        self.shade = 255
        """Grey of the camera's image."""
        self.dark = self.short = False
        """Whether the camera's images are black but for noise, and whether their last row is missing."""
        self.stamp, self.repeats_stamp = 0.0, False
        """Stamp of the last image [s], and whether the next ones have the same."""
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        from rclpy.executors import ExternalShutdownException

        with contextlib.suppress(ExternalShutdownException):
            self.executor.spin()

    def close(self) -> None:
        """Leave the graph in order, so that nobody lists this node any more."""
        self.executor.shutdown(timeout_sec=5)
        self._thread.join(5)
        self.node.destroy_node()
        self.context.try_shutdown()

    def publisher(self, kind: str, topic: str, profile: Any = 1) -> Any:
        """Return a publisher of a message type such as std_msgs/Bool."""
        return self.node.create_publisher(message_type(kind), topic, profile)

    def repeat(self, publisher: Any, period: float, make: Callable[[], Any]) -> Any:
        """Publish `make()` again and again, at once too; return the timer."""
        publisher.publish(make())
        return self.node.create_timer(period, lambda: publisher.publish(make()))

    def base(self, topic: str = "whill/controller/cmd_vel", kind: str = "geometry_msgs/Twist") -> None:
        """Listen to commands, which are collected in `commands`."""
        def heard(message: Any) -> None:
            planar = getattr(message, "twist", message)
            self.commands.append((time.monotonic(), planar.linear.x, planar.angular.z))

        self.node.create_subscription(message_type(kind), topic, heard, 10)

    def watch(self, topic: str = "bridge/status") -> None:
        """Collect the statuses of a bridge in `statuses`."""
        self.node.create_subscription(message_type("std_msgs/String"), topic,
                                      self._on_status, 10)

    def _on_status(self, message: Any) -> None:
        self.statuses.append(json.loads(message.data))

    def e_stop(self, topic: str = "e_stop") -> Switch:
        """Beat as an emergency stop, not pulled."""
        return Switch(self, topic, False)

    def camera(self, topic: str = "sensing/camera/front/image_raw", rate: float = 10,
               size: tuple[int, int] = (64, 64)) -> Any:
        """Publish images of one shade of grey, each different from the last unless `frozen`; return the timer."""
        from bridge.nodes import ros

        image = message_type("sensor_msgs/Image")
        publisher = self.node.create_publisher(image, topic, ros.best_effort())

        def make() -> Any:
            self.frames += 1
            row, rest = 3 * size[1], 3 * size[0] * size[1] - 1
            number, grey = (self.frames % 3, 0) if self.dark else (self.frames % 250, self.shade)
            pixels = bytes([5 if self.frozen else number]) + bytes([grey]) * rest
            message = image(height=size[0], width=size[1], encoding=self.encoding, step=row)
            message.data = array.array("B", pixels[:-row] if self.short else pixels)
            if not self.repeats_stamp:
                self.stamp = time.time() + self.clock_offset
            message.header.stamp.sec, message.header.stamp.nanosec = int(self.stamp), int(self.stamp % 1 * 1e9)
            return message

        return self.repeat(publisher, 1 / rate, make)

    def joystick(self, topic: str = "joy") -> None:
        """Publish a joystick whose first button is held while `held`."""
        self.held = True
        kind = message_type("sensor_msgs/Joy")
        self.repeat(self.publisher("sensor_msgs/Joy", topic), 0.02, lambda: kind(buttons=[int(self.held)]))

    def clock(self) -> None:
        """Publish /clock as the wall clock moved by `clock_offset`, while `ticking`."""
        self.ticking, self._clock_stood = True, 0.0
        kind = message_type("rosgraph_msgs/Clock")

        def make() -> Any:
            if self.ticking:
                self._clock_stood = time.time() + self.clock_offset
            message = kind()
            message.clock.sec, message.clock.nanosec = int(self._clock_stood), int(self._clock_stood % 1 * 1e9)
            return message

        self.repeat(self.publisher("rosgraph_msgs/Clock", "/clock"), 0.01, make)

    def whole(self) -> Switch:
        """Be a whole vehicle with base, camera and status; return its emergency stop."""
        self.base()
        self.watch()
        self.camera()
        return self.e_stop()

    def commander(self, v: float, topic: str = "whill/controller/cmd_vel", kind: str = "geometry_msgs/Twist"
                  ) -> tuple[Any, Callable[[], Any]]:
        """Return a publisher on the command topic and a maker of its commands: a joystick, a planner."""
        def make() -> Any:
            message = message_type(kind)()
            getattr(message, "twist", message).linear.x = float(v)
            return message

        return self.publisher(kind, topic), make

    def arm(self, topic: str = "bridge/rearm") -> None:
        """Arm the bridge, as soon as it listens."""
        publisher = self.publisher("std_msgs/Empty", topic)
        self.wait_until(lambda _: publisher.get_subscription_count())
        publisher.publish(message_type("std_msgs/Empty")())

    def drive_again(self, seconds: float = 120, again: float = 1.0) -> None:
        """Arm until the bridge drives: again each second, since on a busy computer a moment's hold may refuse it."""
        pressed = -again

        def drives(robot: Robot) -> bool:
            nonlocal pressed
            if time.monotonic() - pressed > again and not robot.statuses[-1]["driving"]:
                robot.arm()
                pressed = time.monotonic()
            return bool(robot.statuses[-1]["driving"])

        self.wait_until(drives, seconds)

    def wait_until(self, condition: Callable[[Robot], Any], seconds: float = 120) -> Any:
        """Wait for a condition of this robot and return its value.

        Raises:
            AssertionError: it did not come true in time; with the last commands and statuses.
        """
        end = time.monotonic() + seconds
        while not (value := condition(self)):
            if time.monotonic() > end:
                raise AssertionError(f"commands {self.commands[-5:]}, statuses {self.statuses[-3:]}")
            time.sleep(0.005)
        return value

    def wait_for_status(self, seconds: float = 120, since: int | None = None, **fields: Any) -> dict[str, Any]:
        """Wait until the newest status has these values, of texts and lists a part is enough; return it.

        With `since`, a number of statuses, one of those that came after them is enough: for what passes by itself.
        """
        def fits(robot: Robot) -> dict[str, Any] | None:
            for status in robot.statuses[-1:] if since is None else robot.statuses[since:]:
                if all(want == status.get(name) if isinstance(want, bool) else want in str(status.get(name, ""))
                       for name, want in fields.items()):
                    return status
            return None

        return self.wait_until(fits, seconds)

    def wait_until_quiet(self, count: Callable[[], int], seconds: float = 0.5) -> int:
        """Wait until a count has not changed for some time, and return it; what was on its way has come by then."""
        found: list[tuple[float, int]] = []

        def settled(_: Robot) -> bool:
            now = count()
            if not found or found[-1][1] != now:
                found.append((time.monotonic(), now))
            return time.monotonic() - found[-1][0] > seconds

        self.wait_until(settled)
        return found[-1][1]

    def moving(self, since: float = 0.0) -> list[Heard]:
        """Return the commands after a time that are not zero."""
        return [command for command in self.commands if command[0] > since and (command[1] or command[2])]

    def first_zero(self, since: float) -> float:
        """Wait for the first zero after a time; return how long [s] after it the zero came."""
        def found(robot: Robot) -> list[Heard]:
            return [command for command in robot.commands if command[0] >= since and not (command[1] or command[2])]

        return self.wait_until(found)[0][0] - since
