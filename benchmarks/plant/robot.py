"""The contact plant as a robot: a process of its own behind ROS topics, with simulated time on /clock.

    python -m benchmarks.plant.robot --seed 3 --draw 5 --answers truth.json

It hears commands (geometry_msgs/TwistStamped) and publishes its odometry, an outside pose, an emergency stop that is
never pulled, and /clock. `--draw N` builds in one effect, drawn by N, which nothing but the file `--answers` names.

Simulated time runs `--speed` times as fast as the wall clock, and waits for its driver. A driver sends a command every
50 ms of simulated time; where the next one is late, because the computer is busy, time stands until it is there. So a
drive does not depend on the load of the machine. After PATIENCE time goes on by a step, and waits again: while nobody
drives, it nearly stands.

Between two trials somebody carries a vehicle back to its start. Here the call `reset` does (`bridge.episodes`), with
the number of the trial as the seed; the port is printed at the start.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from typing import Any

import numpy as np

from benchmarks.plant.base import TICK
from benchmarks.plant.draw import draw_effect
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.make import Experiment, plan
from benchmarks.plant.online import OnlinePlant
from bridge.episodes import PROTOCOL, Calls, EpisodeServer, number
from bridge.nodes import ros
from bridge.nodes.options import Parser, in_range, result_file, whole

STEP = 0.05
"""Seconds between two messages on /clock, two reports, and two commands of a driver.

A command counts from its stamp, and time waits for the command that is due. So the same manoeuvre is always the same
commands."""
PATIENCE = 5.0
"""Seconds of the wall clock that simulated time waits for it: a busy computer may let a process wait for seconds."""
BEAT = 0.1
"""Seconds between two messages of the emergency stop."""


class RobotNode:
    """Serves one plant on the ROS graph."""

    def __init__(self, node: Any, plant: OnlinePlant, speed: float) -> None:
        from geometry_msgs.msg import TwistStamped
        from nav_msgs.msg import Odometry
        from std_msgs.msg import Bool

        self.node, self.plant, self.speed = node, plant, speed
        self._odometry_type = Odometry
        self._odometry = node.create_publisher(Odometry, ros.ODOMETRY_TOPIC, ros.reliable(100))
        self._truth = node.create_publisher(Odometry, ros.GROUND_TRUTH_TOPIC, ros.reliable(100))
        self._e_stop = node.create_publisher(Bool, ros.E_STOP_TOPIC, ros.latched())
        self._clock = ros.clock_publisher(node)
        node.create_subscription(TwistStamped, ros.COMMAND_TOPIC, self._on_command, ros.reliable(10))
        ros.steady_timer(node, BEAT, lambda: self._e_stop.publish(Bool(data=False)))
        self._changed = threading.Condition()
        self._base = 1.0  # a stamp of 0 means none
        self._steps = 0
        self._last = -math.inf
        self.stopping = False

    @property
    def now(self) -> float:
        """Simulated seconds; they never go back."""
        return self._base + self._steps * STEP

    def calls(self) -> Calls:
        """Return the calls of episode control."""
        return {"hello": lambda _: {"protocol": PROTOCOL, "period": STEP}, "reset": self._call_reset,
                "state": self._call_state}

    def _call_reset(self, message: dict[str, Any]) -> dict[str, Any]:
        index = int(number(message, "seed", 0, 2**31 - 1))
        start = None
        if "x" in message:
            x, y, yaw = (number(message, name, -1e3, 1e3) for name in ("x", "y", "yaw"))
            start = x, y, yaw
        with self._changed:
            # a step later: what is still on its way from the last trial is older than all of this one
            self._base, self._last, self._steps = self.now + STEP, -math.inf, 0
            self.plant.place(index, start)
            self._changed.notify()
        return {"episode": index, "stamp": stamp_of(self.now)}

    def _call_state(self, _: dict[str, Any]) -> dict[str, Any]:
        with self._changed:
            return {"t": self.now, **dict(zip(("x", "y", "yaw", "v", "omega"), self.plant.state, strict=True))}

    def _on_command(self, message: Any) -> None:
        with self._changed:
            sent = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            # a message that was on its way for a step counts from when it was sent; other clocks do not matter
            t = sent if self.now - 1.5 * STEP <= sent <= self.now + 1e-6 else self.now
            self._last = self.now
            self.plant.command(t - self._base, message.twist.linear.x, message.twist.angular.z)
            self._changed.notify()

    def stop(self) -> None:
        """End `serve` soon, also where it waits for a driver."""
        with self._changed:
            self.stopping = True
            self._changed.notify()

    def serve(self) -> None:
        """Let time pass until `stop` is called."""
        due = time.monotonic()
        while not self.stopping:
            due = max(due, time.monotonic() - STEP) + STEP / self.speed
            with self._changed:
                last, until = self._last, time.monotonic() + PATIENCE
                while self._last == last and self.now - last > STEP - 1e-6 and not self.stopping:
                    if not self._changed.wait(max(until - time.monotonic(), 0.0)) and not self.stopping:
                        self._last = -math.inf
                        break
                self._steps += 1
                self.plant.advance(round(self._steps * STEP / TICK) - round((self._steps - 1) * STEP / TICK))
                reports = self.plant.reports()
            self._publish(*reports)
            time.sleep(max(due - time.monotonic(), 0.0))

    def _publish(self, rows: np.ndarray, poses: np.ndarray) -> None:
        for t, x, y, yaw, v, omega in rows.tolist():
            self._odometry.publish(self._message(t, "odom", (x, y, yaw), v, omega))
        for t, x, y, yaw in poses.tolist():
            self._truth.publish(self._message(t, "map", (x, y, yaw)))
        self._clock(*stamp_of(self.now))

    def _message(self, t: float, frame: str, pose: tuple[float, float, float], v: float = 0.0, omega: float = 0.0
                 ) -> Any:
        x, y, yaw = pose
        message = self._odometry_type()
        message.header.stamp.sec, message.header.stamp.nanosec = stamp_of(self._base + t)
        message.header.frame_id, message.child_frame_id = frame, "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        message.twist.twist.linear.x, message.twist.twist.angular.z = v, omega
        return message


def stamp_of(t: float) -> tuple[int, int]:
    """Return seconds and nanoseconds, to the microsecond."""
    microseconds = round(t * 1e6)
    return microseconds // 1_000_000, microseconds % 1_000_000 * 1000


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="python -m benchmarks.plant.robot", description=__doc__,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=whole(0), default=0, help="of the day, its disturbances and its sensors' noise")
    parser.add_argument("--draw", type=whole(0), help="build in one effect, drawn by this number; default: none")
    parser.add_argument("--effect", choices=sorted(EFFECTS), help="which effect, instead of a drawn one")
    parser.add_argument("--answers", type=result_file("effects", "seed"),
                        help="JSON file for the effect; keep it away from the drives")
    parser.add_argument("--noise", type=in_range(0, 100), default=1.0, help="factor on disturbances and sensor noise")
    parser.add_argument("--speed", type=in_range(0.01, 1000), default=1.0, help="simulated seconds per second at most")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Serve the plant until SIGTERM or Ctrl-C; return 1 where its motion cannot go on, 2 where an option is refused."""
    own, ros_arguments = ros.split_ros_arguments(sys.argv[1:] if arguments is None else arguments)
    options = parse_arguments(own)
    if options.effect and options.draw is None:
        print("benchmarks.plant.robot: --effect: its size is drawn. Add --draw NUMBER.", file=sys.stderr)
        return 2
    effects = {} if options.draw is None else draw_effect(options.draw, options.effect)
    if options.answers:
        ros.write_json(options.answers, {"effects": effects, "seed": options.seed})
    setting, _ = plan(Experiment(effects, options.seed, options.noise, True))
    plant = OnlinePlant(setting)
    failures: list[ValueError] = []
    with ros.node_session("contact_plant", ros_arguments) as node:
        robot = RobotNode(node, plant, options.speed)
        server = EpisodeServer(robot.calls(), "127.0.0.1", 0, "")

        def serve() -> None:
            try:
                robot.serve()
            except ValueError as error:
                failures.append(error)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        print(f"port {server.port}", flush=True)
        ros.spin(node, lambda: not thread.is_alive())
        robot.stop()
        thread.join(PATIENCE + 1)
        server.close()
    for failure in failures:
        print(f"benchmarks.plant.robot: {failure}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
