"""Serves one simulated vehicle on the ROS graph: its topics, its time, its episodes."""

import argparse
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from bridge.driving.bases import WHILL
from bridge.episodes import PROTOCOL, Calls, number, whole
from bridge.nodes import ros
from bridge.nodes.commands import finite_command
from bridge.policy import pacer_of
from bridge.sensing.sense_topics import message_of, topics_of
from bridge.simulation.simulated import Episode, Frame, SimulatedClock, SimulatedVehicle, enlarge, halfway
from bridge.simulation.simulated_messages import (
    ODOMETRY_DEVIATION,
    TRUTH_DEVIATION,
    between,
    camera_info,
    grid_message,
    image_message,
    pose_message,
    scan_message,
)

RESET_SILENCE = 0.5
MATCHING = 0.3
"""Seconds between finding a reader and its having found us; a frame sent earlier is lost."""
LOG_LENGTH = 100_000
"""Commands and delays that are kept for the results file."""
RESULTS = ("episodes", "image_times", "commands", "stops_at_end", "frame_to_command")
"""Keys of the results file."""


class SimulateNode:
    """Serves one simulated vehicle on the ROS graph."""

    def __init__(self, node: Any, vehicle: SimulatedVehicle, options: argparse.Namespace) -> None:
        from geometry_msgs import msg as commands
        from nav_msgs.msg import OccupancyGrid, Odometry
        from sensor_msgs.msg import CameraInfo, Image, LaserScan
        from std_msgs.msg import Bool, Header

        log = node.get_logger()
        self.node, self.vehicle, self.options = node, vehicle, options
        self.clock = SimulatedClock(options.speed, options.clock)
        self._bool, self._header = Bool, Header
        self._image = node.create_publisher(Image, ros.IMAGE_TOPIC, ros.reliable())
        self._info = node.create_publisher(CameraInfo, ros.CAMERA_INFO_TOPIC, ros.reliable())
        self._truth = node.create_publisher(Odometry, ros.GROUND_TRUTH_TOPIC, ros.reliable())
        self._odometry = node.create_publisher(Odometry, ros.ODOMETRY_TOPIC, ros.reliable())
        self._scan = node.create_publisher(LaserScan, ros.SCAN_TOPIC, ros.reliable())
        self._map = node.create_publisher(OccupancyGrid, ros.MAP_TOPIC, ros.latched())
        self._collision = node.create_publisher(Bool, ros.COLLISION_TOPIC, ros.latched())
        self._e_stop = node.create_publisher(Bool, ros.E_STOP_TOPIC, ros.latched())
        self._transform = ros.transform_publisher(node)
        self._senses = self._sense_publishers()
        sensors = getattr(vehicle, "sensors", None) or {}
        self._pose_first = any(one.kind == "odometry" and one is not pacer_of(sensors) for one in sensors.values())
        self._clock = ros.clock_publisher(node) if options.clock else None
        kind = getattr(commands, options.command_type)
        node.create_subscription(kind, ros.COMMAND_TOPIC, self._on_command, ros.reliable())
        ros.subscribe_state(node, Bool, ros.PAUSE_TOPIC, self._on_pause)
        self.paused = self.stepped = False
        self._lock = threading.Lock()  # a period is simulated by the timer or by a client, never by both
        self.episodes: list[Episode] = []
        self.command_log: deque[tuple[float, float, float]] = deque(maxlen=LOG_LENGTH)
        """Steady time of receipt [s], v, omega."""
        self.delays: deque[tuple[float, float]] = deque(maxlen=LOG_LENGTH)
        """Steady time of an image [s], and seconds until the first command after it came."""
        self.image_times: deque[float] = deque(maxlen=LOG_LENGTH)
        self._asked: float | None = None
        self._half = 0
        self._ready_at = self._begin_at = self._alone_at = time.monotonic()
        self._frame: Frame | None = None
        self._next: Frame | None = None
        self.finished_at: float | None = None
        ros.steady_timer(node, vehicle.period / 2 / options.speed, self._on_half_period)
        log.info(f"ready; commands are heard on {node.resolve_topic_name(ros.COMMAND_TOPIC)}")

    def finished(self) -> bool:
        """Return whether all episodes are over, and the time to linger has passed."""
        return self.finished_at is not None and time.monotonic() - self.finished_at > self.options.linger

    def results(self) -> dict[str, Any]:
        """Return the episodes, and what came on the command topic."""
        moving = [i for i, (_, v, omega) in enumerate(self.command_log) if v or omega]
        return {
            "episodes": [vars(episode) for episode in self.episodes],
            "image_times": list(self.image_times),
            "commands": list(self.command_log),
            "stops_at_end": len(self.command_log) - (moving[-1] + 1 if moving else 0),
            "frame_to_command": list(self.delays),
        }

    def _on_command(self, message: Any) -> None:
        now = time.monotonic()
        planar = message.twist if self.options.command_type == "TwistStamped" else message
        v, omega = finite_command(self.node, ros.COMMAND_TOPIC, planar.linear.x, planar.angular.z)
        self.command_log.append((now, v, omega))
        if self._asked is not None:
            self.delays.append((self._asked, now - self._asked))
            self._asked = None
        if self._frame is not None:
            self.episodes[-1].commands += 1

    def _on_pause(self, message: Any) -> None:
        self.paused = bool(message.data)

    def calls(self) -> Calls:
        """Return the calls of episode control (`bridge.episodes`)."""
        calls: Calls = {"hello": lambda _: {"protocol": PROTOCOL, "period": self.vehicle.period},
                        "mode": self._call_mode, "reset": self._call_reset, "step": self._call_step,
                        "state": self._call_state}

        def locked(call: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[dict[str, Any]], dict[str, Any]]:
            def run(message: dict[str, Any]) -> dict[str, Any]:
                with self._lock:
                    return call(message)

            return run

        return {name: locked(call) for name, call in calls.items()}

    def _call_mode(self, message: dict[str, Any]) -> dict[str, Any]:
        mode = message.get("mode")
        if mode not in ("step", "realtime"):
            raise ValueError(f"mode is {mode!r}; it must be step or realtime")
        self.stepped = mode == "step"
        return {"mode": mode}

    def _call_reset(self, message: dict[str, Any]) -> dict[str, Any]:
        seed = whole(message, "seed", 0, 2**31 - 1)
        self.finished_at = None
        stamp = self._begin(seed)
        return {"episode": len(self.episodes), "stamp": stamp}

    def _call_step(self, message: dict[str, Any]) -> dict[str, Any]:
        v, omega = (number(message, name, -100, 100) for name in ("v", "omega"))
        periods = whole(message, "periods", 1, 1000, 1)
        if not self.stepped:
            raise ValueError("steps need the mode step; call mode first")
        reward = 0.0
        for _ in range(periods):
            if self._frame is None:
                raise ValueError("no episode runs; call reset first")
            frame = self.vehicle.step(v, omega)
            self._pass_time(self.vehicle.period)
            reward += frame.reward
            stamp = self._show(frame)
            if frame.done:
                break
        return {"episode": len(self.episodes), "stamp": stamp, "reward": reward, "terminated": frame.terminated,
                "truncated": frame.done and not frame.terminated, "collided": bool(frame.collided),
                "reached_goal": bool(frame.reached_goal)}

    def _call_state(self, _: dict[str, Any]) -> dict[str, Any]:
        state: dict[str, Any] = {"episode": len(self.episodes), "mode": "step" if self.stepped else "realtime",
                                 "done": self._frame is None}
        if self._frame is not None:
            state.update({name: float(getattr(self._frame, name)) for name in ("x", "y", "yaw", "v", "omega")})
        return state

    def _pass_time(self, seconds: float) -> None:
        self.clock.advance(seconds)
        if self._clock is not None:
            self._clock(*self.clock.stamp())

    def _on_half_period(self) -> None:
        with self._lock:
            self._advance_half_period()

    def _advance_half_period(self) -> None:
        if self.stepped:
            self._e_stop.publish(self._bool(data=False))
            return
        if self.paused:
            return
        self._half += 1
        self._pass_time(self.vehicle.period / 2)
        if self._half % 2:
            self._e_stop.publish(self._bool(data=False))  # never pulled; between two images, not to delay one
        if self.finished_at is not None:
            return
        if self._frame is None:
            if time.monotonic() >= self._begin_at and self._half % 2 == 0 and self._has_driver():
                self._begin(self.options.seed + len(self.episodes))
        elif self._half % 2:
            self._next = self.vehicle.step(*self._command())
            self._publish_pose(halfway(self._frame, self._next))
        elif self._next is not None:
            self._show(self._next)

    def _has_driver(self) -> bool:
        """Return whether somebody looks and steers, or the time to wait for that is over. Discovery takes up to 2 s."""
        now = time.monotonic()
        if now - self._ready_at > self.options.wait or self.episodes:
            return True
        topic = self.node.resolve_topic_name(ros.COMMAND_TOPIC)  # the count heeds no remapping
        if not self._image.get_subscription_count() or not self.node.count_publishers(topic):
            self._alone_at = now
        return now - self._alone_at > MATCHING

    def _begin(self, seed: int) -> tuple[int, int]:
        """Begin the episode of a seed; return the stamp of its first image."""
        self._pass_time(self.vehicle.period / 2)  # no two images have the same stamp
        self.episodes.append(Episode(seed))
        self._next = None
        self._collision.publish(self._bool(data=False))
        stamp = self._show(self.vehicle.reset(seed))
        self._publish_map()
        self.episodes[-1].began, self.episodes[-1].steps = time.monotonic(), 0
        return stamp

    def _show(self, frame: Frame) -> tuple[int, int]:
        """Publish the end of a period, and end the episode where it is over; return the stamp of the image."""
        self._frame = frame
        if self._pose_first:
            self._publish_pose(frame)
        self._publish_sensed(frame)  # the sensor that paces the policy comes last
        stamp = self._publish_image(frame)
        if not self._pose_first:
            self._publish_pose(frame)
        episode = self.episodes[-1]
        episode.steps += 1
        if not frame.done:
            return stamp
        episode.collided, episode.reached_goal = bool(frame.collided), bool(frame.reached_goal)
        episode.x, episode.y, episode.ended = float(frame.x), float(frame.y), time.monotonic()
        if frame.collided:
            self._collision.publish(self._bool(data=True))
        self._frame = None
        self._begin_at = time.monotonic() + RESET_SILENCE
        if not self.stepped:
            self.node.get_logger().info(f"episode {len(self.episodes)}: {episode.summary()}")
        if len(self.episodes) == self.options.episodes and not self.stepped:
            self.finished_at = time.monotonic()
        if self.options.results and not self.stepped:
            ros.write_results("bridge.simulate", self.options.results, self.results())
        return stamp

    def _command(self) -> tuple[float, float]:
        """Return the command in force: the last one, zero where it has expired."""
        if not self.command_log:
            return 0.0, 0.0
        received, v, omega = self.command_log[-1]
        expired = time.monotonic() - received > WHILL.expiry / self.clock.speed
        return (0.0, 0.0) if expired else (v, omega)

    def _stamped(self, frame_id: str) -> Any:
        """Return a header with the time of now."""
        header = self._header(frame_id=frame_id)
        if self.clock.published:
            header.stamp.sec, header.stamp.nanosec = self.clock.stamp()
        else:
            header.stamp = self.node.get_clock().now().to_msg()
        return header

    def _publish_image(self, frame: Frame) -> tuple[int, int]:
        image = frame.image
        if self.options.image_size:
            image = enlarge(image, self.options.image_size)
        message = image_message(self._stamped("camera_front"), image)
        self._asked = time.monotonic()
        self.image_times.append(self._asked)
        self._image.publish(message)
        intrinsics = getattr(self.vehicle, "intrinsics", None)
        if intrinsics is not None:
            self._info.publish(camera_info(message, intrinsics, frame.image.shape[:2]))
        return message.header.stamp.sec, message.header.stamp.nanosec

    def _sense_publishers(self) -> dict[str, tuple[Any, Any]]:
        """Return sensor and publisher of what a policy reads beside the topics that are there anyway."""
        sensors = getattr(self.vehicle, "sensors", None) or {}
        found = {}
        for name, topic in topics_of(sensors).items():
            if topic.topic == ros.SCAN_TOPIC:
                found[name] = sensors[name], self._scan  # as the policy's own lidar sees
            elif topic.topic not in (ros.IMAGE_TOPIC, ros.ODOMETRY_TOPIC):
                found[name] = sensors[name], self.node.create_publisher(topic.message, topic.topic, ros.reliable())
        return found

    def _publish_sensed(self, frame: Frame) -> None:
        for name, (sensor, publisher) in reversed(self._senses.items()):
            frame_id = name if sensor.kind in ("camera", "lidar") else "base_link"
            header = self._stamped(frame_id)
            publisher.publish(message_of(header, sensor, frame.sensed[name], self.vehicle.period))

    def _publish_map(self) -> None:
        grid = getattr(self.vehicle, "grid", None)
        if grid is not None:
            self._map.publish(grid_message(self._stamped("map"), grid))

    def _publish_pose(self, frame: Frame) -> None:
        truth = (frame.x, frame.y, frame.yaw, frame.v, frame.omega)
        self._truth.publish(pose_message(self._stamped("map"), truth, TRUTH_DEVIATION))
        if frame.odometry is not None:
            odometry = pose_message(self._stamped("odom"), frame.odometry, ODOMETRY_DEVIATION)
            self._odometry.publish(odometry)
            self._transform("map", "odom", odometry.header.stamp, *between(truth, frame.odometry))
            self._transform("odom", "base_link", odometry.header.stamp, *frame.odometry[:3])
        if frame.ranges is not None and all(publisher is not self._scan for _, publisher in self._senses.values()):
            self._scan.publish(scan_message(self._stamped("base_link"), frame.ranges, self.vehicle.period / 2))
