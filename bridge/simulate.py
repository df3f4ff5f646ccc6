"""The simulator behind the vehicle's topics, so that the policy node sees no difference from the chair.

    python -m bridge.simulate RUN/policy --episodes 10

Time runs like the wall clock. The command received by the middle of a control period drives the whole period; an image
shows its end. Between two episodes the camera is silent for RESET_SILENCE, which is longer than the age the policy node
tolerates: so it stops, forgets, and no frame of an episode can reach the next one.
"""

import argparse
import array
import ast
import importlib
import math
import sys
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bridge import ros

RESET_SILENCE = 0.5
MATCHING = 0.3
"""Seconds between finding a reader and its having found us; a frame sent earlier is lost."""
LOG_LENGTH = 100_000
"""Commands and delays that are kept for the results file."""
COMMAND_EXPIRY = 0.2
"""The chair's controller forgets a command after this time [s]."""


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
    odometry: tuple[float, float, float, float, float] | None = None
    """x, y, yaw, v, omega as the vehicle's own odometry reports them; None where the simulator has none."""


class SimulatedVehicle(Protocol):
    """Any simulator that can be driven one control period at a time."""

    period: float
    """Control period [s]."""

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
        from whill_mjx.tasks.tasks import make_task

        fields = {**changes, "action_repeat": 1}
        env, params = environment.make_env(
            make_task(task, **fields), vehicle, height=size[0], width=size[1], observations={}
        )  # the camera alone, whatever the task observes
        self.period = float(env.model.config.control_dt)
        self._low = np.array([env.task.v_min, -env.task.omega_max])
        self._span = np.array([env.task.v_max, env.task.omega_max]) - self._low
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
                     odometry=(reported[0], reported[1], reported[2], reported[3], reported[4]))


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


class SimulateNode:
    """Serves one simulated vehicle on the ROS graph."""

    def __init__(self, node: Any, vehicle: SimulatedVehicle, options: argparse.Namespace) -> None:
        from geometry_msgs import msg as commands
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Image
        from std_msgs.msg import Bool

        vehicle.reset(options.seed)
        vehicle.step(0.0, 0.0)  # compiles, where the simulator does; before anybody waits for frames
        self.node, self.vehicle, self.options = node, vehicle, options
        self._types = (Image, Odometry, Bool)
        self._image = node.create_publisher(Image, ros.IMAGE_TOPIC, ros.best_effort())
        self._truth = node.create_publisher(Odometry, ros.GROUND_TRUTH_TOPIC, ros.best_effort())
        self._odometry = node.create_publisher(Odometry, ros.ODOMETRY_TOPIC, ros.best_effort())
        self._collision = node.create_publisher(Bool, ros.COLLISION_TOPIC, ros.latched())
        self._e_stop = node.create_publisher(Bool, ros.E_STOP_TOPIC, ros.latched())
        kind = getattr(commands, options.command_type)
        node.create_subscription(kind, ros.COMMAND_TOPIC, self._on_command, ros.reliable())
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
        ros.steady_timer(node, vehicle.period / 2, self._on_half_period)

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

    def _on_half_period(self) -> None:
        self._half += 1
        if self._half % 2:
            self._e_stop.publish(self._types[2](data=False))  # never pulled; between two images, not to delay one
        if self.finished_at is not None:
            return
        if self._frame is None:
            if time.monotonic() >= self._begin_at and self._half % 2 == 0 and self._has_driver():
                self._begin()
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

    def _begin(self) -> None:
        seed = self.options.seed + len(self.episodes)
        self.episodes.append(Episode(seed))
        self._next = None
        self._collision.publish(self._types[2](data=False))
        self._show(self.vehicle.reset(seed))
        self.episodes[-1].began, self.episodes[-1].steps = time.monotonic(), 0

    def _show(self, frame: Frame) -> None:
        """Publish the end of a period, and end the episode where it is over."""
        self._frame = frame
        self._publish_image(frame.image)
        self._publish_pose(frame)
        episode = self.episodes[-1]
        episode.steps += 1
        if not frame.done:
            return
        episode.collided, episode.reached_goal = bool(frame.collided), bool(frame.reached_goal)
        episode.x, episode.y, episode.ended = float(frame.x), float(frame.y), time.monotonic()
        if frame.collided:
            self._collision.publish(self._types[2](data=True))
        self._frame = None
        self._begin_at = time.monotonic() + RESET_SILENCE
        self.node.get_logger().info(f"episode {len(self.episodes)}: {episode}")
        if len(self.episodes) == self.options.episodes:
            self.finished_at = time.monotonic()
        if self.options.results:
            ros.write_json(self.options.results, self.results())

    def _command(self) -> tuple[float, float]:
        """Return the command in force: the last one, zero where it has expired or is not finite."""
        if not self.command_log:
            return 0.0, 0.0
        received, v, omega = self.command_log[-1]
        if time.monotonic() - received > COMMAND_EXPIRY or not (math.isfinite(v) and math.isfinite(omega)):
            return 0.0, 0.0
        return v, omega

    def _publish_image(self, image: np.ndarray) -> None:
        message = self._types[0]()
        if self.options.image_size:
            image = enlarge(image, self.options.image_size)
        message.height, message.width = image.shape[:2]
        message.encoding, message.step = "rgb8", image.shape[1] * 3
        message.header.frame_id = "camera_front"
        message.data = array.array("B", image.tobytes())  # an ndarray would be copied byte by byte
        message.header.stamp = self.node.get_clock().now().to_msg()
        self._asked = time.monotonic()
        self.image_times.append(self._asked)
        self._image.publish(message)

    def _publish_pose(self, frame: Frame) -> None:
        self._truth.publish(self._pose_message((frame.x, frame.y, frame.yaw, frame.v, frame.omega), "map"))
        if frame.odometry is not None:
            self._odometry.publish(self._pose_message(frame.odometry, "odom"))

    def _pose_message(self, values: tuple[float, float, float, float, float], frame_id: str) -> Any:
        x, y, yaw, v, omega = (float(value) for value in values)
        message = self._types[1]()
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.header.frame_id, message.child_frame_id = frame_id, "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        message.twist.twist.linear.x, message.twist.twist.angular.z = v, omega
        return message


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
    """Return the simulator that `--simulator MODULE:FACTORY` names."""
    module, _, name = options.simulator.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise SystemExit(f"bridge.simulate: --simulator {options.simulator}: {error}. It must be MODULE:FACTORY, "
                         "called with task and vehicle. Correct it or leave it out.") from error
    changes = dict(options.set)
    if options.policy is None:
        return factory(task=options.task or "corridor", vehicle=options.vehicle, **changes)
    from whill_mjx.evaluation.policy_world import read_world

    try:
        world = read_world(options.policy)
    except ValueError as error:
        raise SystemExit(f"bridge.simulate: {error}") from error
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
    parser = argparse.ArgumentParser(prog="python -m bridge.simulate",
                                     description="Serve the simulator on the vehicle's topics.")
    parser.add_argument("policy", nargs="?", type=Path, help="folder of a policy or of its training: task, gates, "
                        "vehicle and camera are those that it was trained with")
    parser.add_argument("--task", help="default: that of the policy, or corridor")
    parser.add_argument("--set", type=field, action="append", default=[], metavar="NAME=VALUE",
                        help="change a field of the task, such as gates=1 or layout=fixed; repeat for more")
    parser.add_argument("--vehicle", help="vehicle file or built-in vehicle; default: that of the policy, "
                        "or the task's own")
    parser.add_argument("--episodes", type=int, default=0, help="end after so many; 0: never")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; each next one adds 1")
    parser.add_argument("--wait", type=float, default=10.0, help="wait so long for a driver before the first one [s]")
    parser.add_argument("--linger", type=float, default=1.0, help="listen for so long after the last episode [s]")
    parser.add_argument("--results", type=Path, help="JSON file for the outcome of the episodes")
    parser.add_argument("--image-size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), help="enlarge the camera image")
    parser.add_argument("--command-type", choices=("Twist", "TwistStamped"), default="Twist")
    parser.add_argument("--realtime", type=int, default=0, metavar="PRIORITY", help="SCHED_FIFO priority, like 20")
    parser.add_argument("--simulator", default="bridge.simulate:ChairSimulator", metavar="MODULE:FACTORY")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the node until its episodes are over, SIGTERM or Ctrl-C."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    options = parse_arguments(own)
    if options.simulator.startswith("bridge.simulate:"):  # others may abort with it
        from whill_mjx.processor import share_results

        share_results()
    vehicle = make_vehicle(options)
    with ros.node_session("bridge_simulate", ros_arguments, options.realtime) as node:
        simulate = SimulateNode(node, vehicle, options)
        ros.spin(node, simulate.finished)
        if options.results:
            ros.write_json(options.results, simulate.results())
    return 0


if __name__ == "__main__":
    sys.exit(main())
