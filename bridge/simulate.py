"""The simulator behind the vehicle's topics, so that the policy node sees no difference from the chair.

    python -m bridge.simulate RUN/policy --episodes 10

Time runs like the wall clock, or `--speed` times as fast. With `--clock` the simulated time is published on /clock, and
stamps count in it. The command received by the middle of a control period drives the whole period; an image shows its
end. All publishers are reliable and drop the oldest, so default and best-effort subscribers hear them.

Between two episodes the camera is silent for RESET_SILENCE, which is longer than the age the policy node tolerates: so
it stops, forgets, and no frame of an episode can reach the next one.
"""

import argparse
import array
import ast
import contextlib
import importlib
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bridge import ros
from bridge.episodes import PROTOCOL, Calls, EpisodeServer, number
from bridge.options import Parser, ends_at_ctrl_c, in_range, result_file, whole

RESET_SILENCE = 0.5
MATCHING = 0.3
"""Seconds between finding a reader and its having found us; a frame sent earlier is lost."""
LOG_LENGTH = 100_000
"""Commands and delays that are kept for the results file."""
COMMAND_EXPIRY = 0.2
"""The chair's controller forgets a command after this time [s]."""
TOKEN_VARIABLE = "BRIDGE_TOKEN"
"""Environment variable with the token of episode control; on a command line everybody could read it."""
SCAN_RANGE, SCAN_HEIGHT, SCAN_RAYS = 10.0, 0.2, 360
"""Range of the scanner [m], its height above the ground [m], rays around the vehicle."""
TRUTH_DEVIATION = (1e-3, 1e-3)
"""Standard deviations that the ground truth states, of a position [m] and a heading [rad]."""
ODOMETRY_DEVIATION = (0.05, 0.05)
"""The same of the odometry, whose drift grows: what a filter may take it for over some metres."""
TWIST_DEVIATION = (0.02, 0.02)
"""Of the speeds [m/s, rad/s]."""
UNKNOWN_VARIANCE = 1e6
"""Variance of what a planar vehicle does not measure: height, roll, pitch."""


@dataclass(frozen=True)
class Frame:
    """What is known at the end of a control period."""

    image: np.ndarray
    """(H, W, 3) uint8 rgb8."""
    x: float
    """Drive-axle centre in the room [m]."""
    y: float
    """[m]"""
    yaw: float
    """[rad]"""
    v: float
    """True forward speed [m/s]."""
    omega: float
    """True yaw rate [rad/s]."""
    collided: bool = False
    reached_goal: bool = False
    done: bool = False
    terminated: bool = False
    """Whether the episode ended by itself; one that is done and not terminated ran out of time."""
    reward: float = 0.0
    """Of the last period, where the simulator has one."""
    odometry: tuple[float, float, float, float, float] | None = None
    """x, y, yaw, v, omega as the vehicle's own odometry reports them; None where the simulator has none."""
    ranges: np.ndarray | None = None
    """(N,) free distances [m] around the drive-axle centre, evenly spaced, the first one straight ahead, growing to the
    left; SCAN_RANGE where nothing is. None where the simulator has no scanner."""


class SimulatedVehicle(Protocol):
    """Any simulator that can be driven one control period at a time."""

    period: float
    """Control period [s]."""
    intrinsics: tuple[float, float, float, float]
    """Optional: focal lengths and principal point of the camera, fx, fy, cx, cy [pixels]."""

    def reset(self, seed: int) -> Frame:
        """Begin an episode."""

    def step(self, v: float, omega: float) -> Frame:
        """Advance one control period with the command v [m/s], omega [rad/s]."""


class ChairSimulator:
    """The batch simulator's environment, driven one instance at a time.

    Commands outside the task's range are limited to it. An action repeat is the policy's affair, so here every step is
    one control period.
    """

    def __init__(
        self, task: str = "corridor", vehicle: str | Path | None = None, size: tuple[int, int] = (64, 64),
        **changes: Any,
    ) -> None:
        """Compile the environment of a task with some of its fields changed, and of a vehicle file or preset.

        Without a vehicle: the built-in chair. `size` is height and width of the camera image.
        """
        import jax

        from whill_mjx import env as environment
        from whill_mjx.sensors.lidar import distances
        from whill_mjx.tasks.tasks import make_task
        from whill_mjx.vehicle.kinematics import reference_pose
        from whill_mjx.world.render import pinhole

        fields = {**changes, "action_repeat": 1}
        env, params = environment.make_env(
            make_task(task, **fields), vehicle, height=size[0], width=size[1], observations={}
        )  # the camera alone, whatever the task observes
        self.period = float(env.model.config.control_dt)
        self._low = np.array([env.task.v_min, -env.task.omega_max])
        self._span = np.array([env.task.v_max, env.task.omega_max]) - self._low
        camera = pinhole(env.model.spec.camera.fov_y, *size)
        self.intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        angles = np.arange(SCAN_RAYS) * 2 * np.pi / SCAN_RAYS

        def scan(state: Any) -> Any:
            x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
            return distances(x, y, yaw + angles, state.scene.boxes, SCAN_RANGE, SCAN_HEIGHT, SCAN_HEIGHT)

        self._scan = jax.jit(scan)
        self._key = jax.random.key
        self._reset = jax.jit(lambda key: environment.reset(env, params, key))
        self._step = jax.jit(lambda state, action: environment.step(env, params, state, action))
        self._state: Any = None

    def reset(self, seed: int) -> Frame:
        """Begin the episode of a seed."""
        self._state, time_step = self._reset(self._key(seed))
        return self._frame(time_step)

    def step(self, v: float, omega: float) -> Frame:
        """Advance one control period."""
        action = (np.array([v, omega]) - self._low) / self._span * 2 - 1
        self._state, time_step = self._step(self._state, action.astype(np.float32))
        return self._frame(time_step)

    def _frame(self, time_step: Any) -> Frame:
        metrics, odometry = time_step.metrics, self._state.vehicle.odometry
        names = ("x", "y", "yaw", "v", "omega")
        x, y, yaw, v, omega = (float(metrics[name]) for name in names)
        reported = [float(getattr(odometry, name)) for name in names]
        return Frame(np.asarray(time_step.obs), x, y, yaw, v, omega, collided=bool(metrics["collision"]),
                     reached_goal=bool(metrics["success"]), done=bool(time_step.terminated | time_step.truncated),
                     terminated=bool(time_step.terminated), reward=float(time_step.reward),
                     odometry=(reported[0], reported[1], reported[2], reported[3], reported[4]),
                     ranges=np.asarray(self._scan(self._state)))


@dataclass
class Episode:
    """Outcome of one episode, for the results file."""

    seed: int
    steps: int = 0
    collided: bool = False
    reached_goal: bool = False
    x: float = 0.0
    """Last place of the drive-axle centre [m]."""
    y: float = 0.0
    commands: int = 0
    began: float = 0.0
    """Steady time of the first image [s]."""
    ended: float = 0.0
    """Steady time of the last image [s]."""


class SimulatedClock:
    """Simulated time: what stamps count in, and what a control period lasts on the steady clock; pure.

    Without `published` stamps are those of the node's own clock, and simulated time is the wall clock's.
    """

    def __init__(self, speed: float, published: bool) -> None:
        """Set how many simulated seconds pass in one second, and whether the time is published on /clock."""
        self.speed, self.published = speed, published
        self.now = 0.0
        """Simulated seconds since the start."""

    def advance(self, seconds: float) -> None:
        """Let simulated time pass."""
        self.now += seconds

    def stamp(self) -> tuple[int, int]:
        """Return seconds and nanoseconds of the simulated time, which begins at 1 s: a stamp of 0 means none."""
        seconds, nanoseconds = divmod(round(self.now * 1e9), 1_000_000_000)
        return seconds + 1, nanoseconds


class SimulateNode:
    """Serves one simulated vehicle on the ROS graph."""

    def __init__(self, node: Any, vehicle: SimulatedVehicle, options: argparse.Namespace) -> None:
        from geometry_msgs import msg as commands
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import CameraInfo, Image, LaserScan
        from std_msgs.msg import Bool

        vehicle.reset(options.seed)
        vehicle.step(0.0, 0.0)  # compiles, where the simulator does; before anybody waits for frames
        self.node, self.vehicle, self.options = node, vehicle, options
        self.clock = SimulatedClock(options.speed, options.clock)
        self._types = (Image, Odometry, Bool)
        self._scan_type, self._info_type = LaserScan, CameraInfo
        self._image = node.create_publisher(Image, ros.IMAGE_TOPIC, ros.reliable())
        self._info = node.create_publisher(CameraInfo, ros.CAMERA_INFO_TOPIC, ros.reliable())
        self._truth = node.create_publisher(Odometry, ros.GROUND_TRUTH_TOPIC, ros.reliable())
        self._odometry = node.create_publisher(Odometry, ros.ODOMETRY_TOPIC, ros.reliable())
        self._scan = node.create_publisher(LaserScan, ros.SCAN_TOPIC, ros.reliable())
        self._collision = node.create_publisher(Bool, ros.COLLISION_TOPIC, ros.latched())
        self._e_stop = node.create_publisher(Bool, ros.E_STOP_TOPIC, ros.latched())
        self._transform = ros.transform_publisher(node)
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
        self.command_log.append((now, planar.linear.x, planar.angular.z))
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
        seed = int(number(message, "seed", 0, 2**31 - 1))
        self.finished_at = None
        stamp = self._begin(seed)
        return {"episode": len(self.episodes), "stamp": stamp}

    def _call_step(self, message: dict[str, Any]) -> dict[str, Any]:
        v, omega = (number(message, name, -100, 100) for name in ("v", "omega"))
        periods = int(number(message, "periods", 1, 1000, 1))
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
            self._e_stop.publish(self._types[2](data=False))
            return
        if self.paused:
            return
        self._half += 1
        self._pass_time(self.vehicle.period / 2)
        if self._half % 2:
            self._e_stop.publish(self._types[2](data=False))  # never pulled; between two images, not to delay one
        if self.finished_at is not None:
            return
        if self._frame is None:
            if time.monotonic() >= self._begin_at and self._half % 2 == 0 and self._has_driver():
                self._begin(self.options.seed + len(self.episodes))
        elif self._half % 2:
            self._next = self.vehicle.step(*self._command())
            self._publish_pose(_halfway(self._frame, self._next))
        elif self._next is not None:
            self._show(self._next)

    def _has_driver(self) -> bool:
        """Return whether somebody looks and steers, or the time to wait for that is over. Discovery takes up to 2 s."""
        now = time.monotonic()
        if now - self._ready_at > self.options.wait or self.episodes:
            return True
        if not self._image.get_subscription_count() or not self.node.count_publishers(ros.COMMAND_TOPIC):
            self._alone_at = now
        return now - self._alone_at > MATCHING

    def _begin(self, seed: int) -> tuple[int, int]:
        """Begin the episode of a seed; return the stamp of its first image."""
        self._pass_time(self.vehicle.period / 2)  # no two images have the same stamp
        self.episodes.append(Episode(seed))
        self._next = None
        self._collision.publish(self._types[2](data=False))
        stamp = self._show(self.vehicle.reset(seed))
        self.episodes[-1].began, self.episodes[-1].steps = time.monotonic(), 0
        return stamp

    def _show(self, frame: Frame) -> tuple[int, int]:
        """Publish the end of a period, and end the episode where it is over; return the stamp of the image."""
        self._frame = frame
        stamp = self._publish_image(frame)
        self._publish_pose(frame)
        episode = self.episodes[-1]
        episode.steps += 1
        if not frame.done:
            return stamp
        episode.collided, episode.reached_goal = bool(frame.collided), bool(frame.reached_goal)
        episode.x, episode.y, episode.ended = float(frame.x), float(frame.y), time.monotonic()
        if frame.collided:
            self._collision.publish(self._types[2](data=True))
        self._frame = None
        self._begin_at = time.monotonic() + RESET_SILENCE
        if not self.stepped:
            self.node.get_logger().info(f"episode {len(self.episodes)}: {episode}")
        if len(self.episodes) == self.options.episodes and not self.stepped:
            self.finished_at = time.monotonic()
        if self.options.results and not self.stepped:
            ros.write_json(self.options.results, self.results())
        return stamp

    def _command(self) -> tuple[float, float]:
        """Return the command in force: the last one, zero where it has expired or is not finite."""
        if not self.command_log:
            return 0.0, 0.0
        received, v, omega = self.command_log[-1]
        expired = time.monotonic() - received > COMMAND_EXPIRY / self.clock.speed
        return (0.0, 0.0) if expired or not (math.isfinite(v) and math.isfinite(omega)) else (v, omega)

    def _stamp(self, header: Any, frame_id: str) -> None:
        header.frame_id = frame_id
        if self.clock.published:
            header.stamp.sec, header.stamp.nanosec = self.clock.stamp()
        else:
            header.stamp = self.node.get_clock().now().to_msg()

    def _publish_image(self, frame: Frame) -> tuple[int, int]:
        message, image = self._types[0](), frame.image
        if self.options.image_size:
            image = enlarge(image, self.options.image_size)
        message.height, message.width = image.shape[:2]
        message.encoding, message.step = "rgb8", image.shape[1] * 3
        message.data = array.array("B", image.tobytes())  # an ndarray would be copied byte by byte
        self._stamp(message.header, "camera_front")
        self._asked = time.monotonic()
        self.image_times.append(self._asked)
        self._image.publish(message)
        intrinsics = getattr(self.vehicle, "intrinsics", None)
        if intrinsics is not None:
            self._info.publish(self._camera_info(message, intrinsics, frame.image.shape[:2]))
        return message.header.stamp.sec, message.header.stamp.nanosec

    def _camera_info(self, image: Any, intrinsics: tuple[float, ...], size: tuple[int, ...]) -> Any:
        """Return sensor_msgs/CameraInfo of an ideal pinhole for an image that was enlarged from `size`."""
        rows, columns = image.height / size[0], image.width / size[1]
        fx, fy, cx, cy = (one * scale for one, scale in zip(intrinsics, (columns, rows, columns, rows), strict=True))
        info = self._info_type(header=image.header, height=image.height, width=image.width)
        info.distortion_model, info.d = "plumb_bob", [0.0] * 5
        info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        return info

    def _publish_pose(self, frame: Frame) -> None:
        truth = (frame.x, frame.y, frame.yaw, frame.v, frame.omega)
        self._truth.publish(self._pose_message(truth, "map", TRUTH_DEVIATION))
        if frame.odometry is not None:
            odometry = self._pose_message(frame.odometry, "odom", ODOMETRY_DEVIATION)
            self._odometry.publish(odometry)
            self._transform(odometry)
        if frame.ranges is not None:
            self._scan.publish(self._scan_message(frame.ranges))

    def _scan_message(self, ranges: np.ndarray) -> Any:
        """Return sensor_msgs/LaserScan; REP 117: infinite where nothing is within the range."""
        message = self._scan_type()
        self._stamp(message.header, "base_link")
        message.angle_increment = 2 * math.pi / len(ranges)
        message.angle_min, message.angle_max = 0.0, 2 * math.pi - message.angle_increment
        message.range_min, message.range_max = 0.0, SCAN_RANGE
        message.scan_time = self.vehicle.period / 2
        message.ranges = array.array("f", np.where(ranges >= SCAN_RANGE, np.inf, ranges).astype(np.float32).tobytes())
        return message

    def _pose_message(self, values: tuple[float, float, float, float, float], frame_id: str,
                      deviation: tuple[float, float]) -> Any:
        x, y, yaw, v, omega = (float(value) for value in values)
        message = self._types[1]()
        self._stamp(message.header, frame_id)
        message.child_frame_id = "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        message.twist.twist.linear.x, message.twist.twist.angular.z = v, omega
        message.pose.covariance = planar_covariance(deviation[0], deviation[0], deviation[1])
        message.twist.covariance = planar_covariance(TWIST_DEVIATION[0], TWIST_DEVIATION[0], TWIST_DEVIATION[1])
        return message


def planar_covariance(x: float, y: float, yaw: float) -> list[float]:
    """Return the 36 numbers of a ROS covariance of a planar vehicle from its standard deviations."""
    variances = (x * x, y * y, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, yaw * yaw)
    return [variances[i] if i == j else 0.0 for i in range(6) for j in range(6)]


def _halfway(a: Frame, b: Frame) -> Frame:
    """Return the frame in the middle of two; angles go the short way round."""
    def middle(p: tuple[float, ...], q: tuple[float, ...]) -> tuple[float, ...]:
        turn = math.remainder(q[2] - p[2], 2 * math.pi)
        return (p[0] + q[0]) / 2, (p[1] + q[1]) / 2, p[2] + turn / 2, (p[3] + q[3]) / 2, (p[4] + q[4]) / 2

    x, y, yaw, v, omega = middle((a.x, a.y, a.yaw, a.v, a.omega), (b.x, b.y, b.yaw, b.v, b.omega))
    odometry = None if a.odometry is None or b.odometry is None else middle(a.odometry, b.odometry)
    return Frame(a.image, x, y, yaw, v, omega, odometry=odometry)  # type: ignore[arg-type]  # five numbers each


def enlarge(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the image at (height, width) by repeating pixels, as a camera of that size would send it."""
    rows = np.arange(size[0]) * image.shape[0] // size[0]
    columns = np.arange(size[1]) * image.shape[1] // size[1]
    return image[rows[:, None], columns]


def make_vehicle(options: argparse.Namespace) -> SimulatedVehicle:
    """Return the simulator that `--simulator MODULE:FACTORY` names.

    Raises:
        ValueError, FileNotFoundError: an option, or the policy's folder, is refused.
    """
    module, _, name = options.simulator.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"--simulator {options.simulator}: {error}. It must be MODULE:FACTORY, called with task and "
                         "vehicle. Correct it or leave it out.") from error
    changes = dict(options.set)
    if options.policy is None:
        return factory(task=options.task or "corridor", vehicle=options.vehicle, **changes)
    from whill_mjx.evaluation.policy_world import read_world

    world = read_world(options.policy)
    same = options.task in (None, world.task)
    fields = {**world.fields, **changes} if same else changes
    return factory(task=options.task or world.task, vehicle=options.vehicle or world.vehicle,
                   size=(world.height, world.width), **fields)


def field(text: str) -> tuple[str, Any]:
    """Name and value of a NAME=VALUE option; values are Python literals or plain words."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as gates=1")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="python -m bridge.simulate",
                                     description="Serve the simulator on the vehicle's topics.")
    parser.add_argument("policy", nargs="?", type=Path, help="folder of a policy or of its training: task, gates, "
                        "vehicle and camera are those that it was trained with")
    parser.add_argument("--task", help="default: that of the policy, or corridor")
    parser.add_argument("--set", type=field, action="append", default=[], metavar="NAME=VALUE",
                        help="change a field of the task, such as gates=1 or layout=fixed; repeat for more")
    parser.add_argument("--vehicle", help="vehicle file or built-in vehicle; default: that of the policy, "
                        "or the task's own")
    parser.add_argument("--episodes", type=whole(0), default=0, help="end after so many; 0: never")
    parser.add_argument("--seed", type=whole(0), default=0, help="of the first episode; each next one adds 1")
    parser.add_argument("--wait", type=in_range(0), default=10.0,
                        help="wait so long for a driver before the first one [s]")
    parser.add_argument("--linger", type=in_range(0), default=1.0, help="listen for so long after the last episode [s]")
    parser.add_argument("--results", type=result_file, help="JSON file for the outcome of the episodes")
    parser.add_argument("--image-size", type=whole(1, 10_000), nargs=2, metavar=("HEIGHT", "WIDTH"),
                        help="enlarge the camera image")
    parser.add_argument("--clock", action="store_true", help="publish the simulated time on /clock and stamp with it")
    parser.add_argument("--speed", type=in_range(0.01, 100), default=1.0,
                        help="simulated seconds per second, such as 0.5; default 1")
    parser.add_argument("--port", type=whole(0, 65535), metavar="PORT",
                        help="serve episode control over TCP: resets and lock-step (bridge.episodes); 0: any free port")
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS",
                        help=f"address of the port; another than the loopback needs a token in {TOKEN_VARIABLE}")
    parser.add_argument("--command-type", choices=("Twist", "TwistStamped"), default="Twist")
    parser.add_argument("--realtime", type=whole(0, 99), default=0, metavar="PRIORITY",
                        help="SCHED_FIFO priority, like 20")
    parser.add_argument("--simulator", default="bridge.simulate:ChairSimulator", metavar="MODULE:FACTORY")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Run the node until its episodes are over, SIGTERM or Ctrl-C; return 2 where an option is refused."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    options = parse_arguments(own)
    compiling: Any = contextlib.nullcontext()
    if options.simulator.startswith("bridge.simulate:"):  # others may abort with it
        from whill_mjx.io.command_line import guarded
        from whill_mjx.processor import share_results

        share_results()
        compiling = guarded("bridge.simulate: stopped")  # a signal ends it while XLA compiles, too
    with compiling:
        try:
            vehicle = make_vehicle(options)
        except (ValueError, FileNotFoundError) as error:
            print(f"bridge.simulate: {error}", file=sys.stderr)
            return 2
    with ros.node_session("bridge_simulate", ros_arguments, options.realtime) as node:
        simulate = SimulateNode(node, vehicle, options)
        try:
            server = None if options.port is None else EpisodeServer(
                simulate.calls(), options.bind, options.port, os.environ.get(TOKEN_VARIABLE, ""))
        except (ValueError, OSError, OverflowError) as error:
            print(f"bridge.simulate: --port {options.port}: {error}", file=sys.stderr)
            return 2
        if server is not None:
            node.get_logger().info(f"episode control on {options.bind}, port {server.port}")
        ros.spin(node, simulate.finished)
        if server is not None:
            server.close()
        if options.results:
            ros.write_json(options.results, simulate.results())
    return 0


if __name__ == "__main__":
    sys.exit(main())
