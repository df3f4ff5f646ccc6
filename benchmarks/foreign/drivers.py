"""Who drives in the foreign room: a policy file, and the controls beside which its figure stands."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.drive import Pose
from benchmarks.foreign.room import GOAL, WIDTH, Room

CONTROLS = ("planner", "straight", "blank", "frozen")
"""A planner that knows the truth, straight ahead, and the policy with black images or its first one kept."""
SPEED, TURN = 0.3, 0.6  # m/s, rad/s


class Planner:
    """Follows a path on the wider side of the carton; it knows the truth."""

    def __init__(self, room: Room) -> None:
        x, y, half_x, half_y, yaw = room.carton
        across = half_x * abs(math.sin(yaw)) + half_y * abs(math.cos(yaw))
        along = half_x * abs(math.cos(yaw)) + half_y * abs(math.sin(yaw))
        side = -1.0 if y > 0 else 1.0
        inner = y + side * across
        near = [t for t in room.things if t[1] * side > 0 and abs(t[0] - x) < along + t[2] + 1.0]
        outer = min([WIDTH / 2] + [side * t[1] - t[3] for t in near])
        lane = (inner + side * outer) / 2
        self.path = [(x - along - 0.65, lane), (x + along + 0.45, lane), (GOAL[0], GOAL[1])]

    def command(self, pose: Pose) -> tuple[float, float]:
        """v [m/s], omega [rad/s]."""
        while len(self.path) > 1 and pose.x > self.path[0][0] - 0.05:
            self.path.pop(0)
        ahead = self.path[0]
        if len(self.path) == 2:  # beside the carton: keep to the lane
            ahead = (pose.x + 0.6, self.path[0][1])
        error = math.atan2(ahead[1] - pose.y, ahead[0] - pose.x) - pose.yaw
        error = math.atan2(math.sin(error), math.cos(error))
        return SPEED * max(0.0, math.cos(2 * max(-0.78, min(0.78, error)))), max(-TURN, min(TURN, 2.0 * error))


class Sighted:
    """A policy file, with the images as they are, blank, or the first one kept; with its stop for the unknown."""

    def __init__(self, policy: Any, see: str = "policy", stop: bool = False) -> None:
        self.policy, self.see, self.first = policy, see, None
        self.stop = stop
        policy.reset()

    def command(self, image: np.ndarray) -> tuple[float, float]:
        """v [m/s], omega [rad/s]."""
        if self.see == "blank":
            image = np.zeros_like(image)
        elif self.see == "frozen":
            self.first = image if self.first is None else self.first
            image = self.first
        v, omega = self.policy.step(image)
        return float(v), float(omega)


def load(path: str | Path) -> Any:
    """The policy of a file."""
    from bridge.policy import Policy

    return Policy.load(path)
