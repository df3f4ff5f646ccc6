"""Faults injected while a policy drives, and the time to the first zero that the base hears.

    python -m benchmarks.bridge --parts faults [--faults camera_silent dead_man]
    python -m benchmarks.bridge_faults POLICY            # `bridge.drive` whose policy step takes 90 ms at dark images

Each fault is injected by a plain ROS node (benchmarks.bridge_robot) that shares no code with the bridge. The policy is
the stand-in of benchmarks.bridge: at a white image its action is not a number, at a pale one its surprise is high.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.bridge_robot import Robot, Switch, environment_of, message_type

Figures = dict[str, tuple[Any, ...]]
"""Repeats, unit and, where there is one, a table of more, of each figure by its name."""
USUAL, DARK, PALE = 120, 40, 200
"""Shades of the camera's image: at DARK the policy is slow, at PALE it is surprised."""
SLOW_STEP = 0.09
"""Seconds of a policy step at DARK; more than 0.08 is an overrun, more than 0.15 a dead node."""
PAGE = Path(__file__).resolve().parents[1] / "docs" / "bridge.md"
COMMAND_TOPIC = "whill/controller/cmd_vel"


class Bridge:
    """A policy node that drives a robot of plain ROS."""

    def __init__(self, policy: Path, domain: int, *options: str, module: str = "bridge.drive") -> None:
        self.robot = Robot(domain)
        self.robot.shade = USUAL
        self.robot.base()
        self.robot.watch()
        self.camera = self.robot.camera()
        self.e_stop = self.robot.e_stop()
        self.enable = Switch(self.robot, "enable", True)
        self.collision = self.robot.publisher("std_msgs/Bool", "collision_sensor")
        self.robot.joystick()
        if SIMULATED[-1] in options:
            self.robot.clock()
        self.other: Any = None
        environment = environment_of(domain)
        self.process = subprocess.Popen([sys.executable, "-m", module, str(policy), *options], env=environment,
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if LIFECYCLE[0] in options:
            self.change("configure", "activate")

    def collide(self, value: bool) -> None:
        """Publish one value of the collision sensor."""
        self.collision.publish(message_type("std_msgs/Bool")(data=value))

    def join(self) -> None:
        """Let another node publish on the command topic; it sends nothing."""
        self.other = self.robot.publisher("geometry_msgs/Twist", COMMAND_TOPIC)

    def leave(self) -> None:
        """Take that publisher away."""
        self.robot.node.destroy_publisher(self.other)

    def change(self, *transitions: str) -> None:
        """Move the managed node through its states."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        client = self.robot.node.create_client(ChangeState, "bridge_drive/change_state")
        client.wait_for_service(60)
        for name in transitions:
            request = ChangeState.Request()
            request.transition.id = getattr(Transition, f"TRANSITION_{name.upper()}")
            client.call(request, timeout_sec=60)

    def guard(self) -> int:
        """Return the process of its guard."""
        with open(f"/proc/{self.process.pid}/task/{self.process.pid}/children") as file:
            return int(file.read().split()[0])

    def close(self) -> None:
        """End it, and the robot."""
        self.process.send_signal(signal.SIGCONT)
        self.process.terminate()
        self.process.wait(60)
        self.robot.close()


def setting(name: str, value: Any) -> Callable[[Bridge], None]:
    """Return the injection that sets an attribute of the robot."""
    return lambda bridge: setattr(bridge.robot, name, value)


SIMULATED = ("--ros-args", "-p", "use_sim_time:=true")
LIFECYCLE = ("--lifecycle",)
SHADED = setting("shade", USUAL)
STOPS: dict[str, tuple[tuple[str, ...], Any, Any]] = {
    "e_stop": ((), lambda bridge: bridge.e_stop.turn(True), lambda bridge: bridge.e_stop.turn(False)),
    "e_stop_silent": ((), lambda bridge: bridge.e_stop.timer.cancel(), lambda bridge: bridge.e_stop.timer.reset()),
    "collision": ((), lambda bridge: bridge.collide(True), lambda bridge: bridge.collide(False)),
    "enable": (("--enable", "require"), lambda bridge: bridge.enable.turn(False),
               lambda bridge: bridge.enable.turn(True)),
    "camera_silent": ((), lambda bridge: bridge.camera.cancel(), lambda bridge: bridge.camera.reset()),
    "frozen_camera": ((), setting("frozen", True), setting("frozen", False)),
    "late_stamps": ((), setting("clock_offset", -5.0), setting("clock_offset", 0.0)),
    "wrong_encoding": ((), setting("encoding", "bayer_rggb8"), setting("encoding", "rgb8")),
    "wrong_length": ((), setting("short", True), setting("short", False)),
    "repeated_stamp": ((), setting("repeats_stamp", True), setting("repeats_stamp", False)),
    "dark_camera": (("--blind", "stop"), setting("dark", True), setting("dark", False)),
    "slow_policy": ((), setting("shade", DARK), SHADED),
    "novel_surroundings": ((), setting("shade", PALE), SHADED),
    "dead_man": (("--dead-man-button", "0"), setting("held", False), setting("held", True)),
    "second_commander": ((), lambda bridge: bridge.join(), lambda bridge: bridge.leave()),
    "clock_stops": (SIMULATED, setting("ticking", False), setting("ticking", True)),
    "clock_jumps": (SIMULATED, setting("clock_offset", 90.0), setting("clock_offset", 0.0)),
    "guard_killed": ((), lambda bridge: os.kill(bridge.guard(), signal.SIGKILL), lambda bridge: None),
    "node_stopped": (("--signal-age", "5"), lambda bridge: bridge.process.send_signal(signal.SIGSTOP),
                     lambda bridge: bridge.process.send_signal(signal.SIGCONT)),
    "deactivated": (LIFECYCLE, lambda bridge: bridge.change("deactivate"), lambda bridge: bridge.change("activate")),
    "node_ends": ((), lambda bridge: bridge.process.terminate(), None),
    "interrupted": ((), lambda bridge: bridge.process.send_signal(signal.SIGINT), None),
    "killed": ((), lambda bridge: bridge.process.kill(), None),
    "killed_first": ((), lambda bridge: bridge.process.kill(), None),
}
"""Options, injection and its end by the name of a fault; without an end each repeat takes a new node."""
FOREIGN = "foreign_command"
"""The fault after which the bridge sends no zero but is silent."""
FAULTS = (*STOPS, FOREIGN)
MODULES = {"slow_policy": "benchmarks.bridge_faults"}
"""What runs as the policy node, where it is not `bridge.drive` itself."""


def measure_faults(policy: Path, domain: int, repeats: int, names: Sequence[str]) -> Figures:
    """Return the reaction times to the faults of these names, and the time until silence when a person takes over."""
    found: Figures = {}
    for name in names:
        if name == FOREIGN:
            found |= measure_yield(policy, domain, repeats)
            continue
        options, inject, end = STOPS[name]
        reactions: list[float] = []
        while len(reactions) < repeats:
            bridge = Bridge(policy, domain, *options, module=MODULES.get(name, "bridge.drive"))
            try:
                reactions.extend(reaction_times(bridge, name, inject, end, repeats if end else 1, len(reactions)))
            finally:
                bridge.close()
        title = title_of(name)
        found[title] = (reactions, "ms from the fault to the first zero")
        print(f"{title:28s} {np.median(reactions):8.1f} ms", flush=True)
    return found


def title_of(name: str) -> str:
    """Return the name of the figure of a fault."""
    if name == FOREIGN:
        return f"yield_{name}_ms"
    return "e_stop_ms" if name == "e_stop" else f"stop_{name}_ms"


def fault_rows() -> list[tuple[str, list[str]]]:
    """Return each row of the documented fault table, with the figures and tests that it names."""
    _, _, page = PAGE.read_text(encoding="utf-8").partition("## What stops the vehicle")
    cells = [line.split(" | ") for line in page.partition("\n## ")[0].splitlines() if line.startswith("| ")]
    return [(row[0].lstrip("| "), re.findall(r"`(\w+)`", row[-1])) for row in cells[1:]]


def reaction_times(bridge: Bridge, name: str, inject: Any, end: Any, repeats: int, phase: int) -> list[float]:
    """Return the times [ms] from a fault to the first zero, each at another phase of the control period."""
    robot, found = bridge.robot, []
    for i in range(repeats):
        robot.wait_until(moving_after(time.monotonic()))
        if name != "killed_first":
            time.sleep(0.7 + 0.037 * (i + phase))
            robot.wait_until(moving_after(time.monotonic()))  # a busy machine may have stopped it meanwhile
        at = time.monotonic()
        inject(bridge)
        found.append(1e3 * robot.first_zero(at))
        if end is None:
            break
        end(bridge)
        with contextlib.suppress(AssertionError):  # resumed by itself
            robot.wait_for_status(2.0, state="disarmed", holds="[]")
            robot.arm()
    return found


def moving_after(since: float) -> Callable[[Robot], Any]:
    """Return the condition that a motion is commanded after a time."""
    return lambda robot: robot.moving(since)


def measure_yield(policy: Path, domain: int, repeats: int) -> Figures:
    """Return how long the bridge still sends after the first command of a person who takes over."""
    found: list[float] = []
    bridge = Bridge(policy, domain, "--allow-other-commanders")
    robot = bridge.robot
    try:
        publisher, make = robot.commander(0.123)
        for i in range(repeats):
            robot.wait_until(moving_after(time.monotonic()))
            time.sleep(0.7 + 0.037 * i)
            at = time.monotonic()
            publisher.publish(make())
            robot.wait_for_status(state="yielded")
            own = [t for t, v, _ in robot.commands if t > at and abs(v - 0.123) > 1e-6]
            found.append(1e3 * max(0.0, max(own, default=at) - at))
            robot.wait_for_status(state="disarmed", holds="[]")
            robot.arm()
    finally:
        bridge.close()
    return {title_of(FOREIGN): (found, "ms from a foreign command to the bridge's last one")}


def drive_slowly() -> int:
    """Run the policy node with a policy whose step takes SLOW_STEP at dark images."""
    from bridge import drive
    from bridge.policy import Policy

    step = Policy.step

    def slow(policy: Policy, image: np.ndarray) -> np.ndarray:
        if abs(float(image[2:].mean()) - DARK) < 5:
            time.sleep(SLOW_STEP)
        return step(policy, image)

    with mock.patch.object(Policy, "step", slow):
        return drive.main()


if __name__ == "__main__":
    sys.exit(drive_slowly())
