"""Who drives in the foreign room: a policy file, and the controls beside which its figure stands."""

from __future__ import annotations

import heapq
import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.drive import PERIOD, Pose
from benchmarks.foreign.plan import BEGIN
from benchmarks.foreign.room import AHEAD, Room
from bridge.safeguards.safety import SafetyConfig

CONTROLS = ("planner", "straight", "blank", "frozen")
"""A planner that knows the truth, straight ahead, and the policy with black images or its first one kept."""
WITH_STOP = "with_stop"
"""The policy, slowed down and stopped by its surprise, as the bridge does."""
SPEED, TURN = 0.3, 0.6  # m/s, rad/s
RADIUS = 0.32
"""Of the circles that hold the chair in the planner's search [m]."""


class Planner:
    """Follows a path that it searched with the truth: A* over place and heading, then pure pursuit."""

    def __init__(self, room: Room) -> None:
        self.plan = room.plan
        self.boxes = np.array([(*one[:4], one.yaw) for one in (*room.obstacles, *room.things)])
        self.path = self._search(room.plan.start)

    def command(self, pose: Pose) -> tuple[float, float]:
        """v [m/s], omega [rad/s]."""
        gaps = np.hypot(self.path[:, 0] - pose.x, self.path[:, 1] - pose.y)
        nearest = int(np.argmin(gaps))
        ahead = self.path[min(nearest + 3, len(self.path) - 1)]
        error = math.atan2(ahead[1] - pose.y, ahead[0] - pose.x) - pose.yaw
        error = math.atan2(math.sin(error), math.cos(error))
        return SPEED * max(0.0, math.cos(2 * max(-0.78, min(0.78, error)))), max(-TURN, min(TURN, 2.0 * error))

    def _room_left(self, x, y, yaw) -> float:
        """Least distance [m] of three circles along the chair's body from walls and boxes, less their radius."""
        left = math.inf
        for along in (AHEAD - 0.2, AHEAD, AHEAD + 0.2):
            cx, cy = x + along * math.cos(yaw), y + along * math.sin(yaw)
            left = min(left, self.plan.half_width - abs(cy), self.plan.end - cx, cx - BEGIN)
            dx, dy = cx - self.boxes[:, 0], cy - self.boxes[:, 1]
            cos, sin = np.cos(self.boxes[:, 4]), np.sin(self.boxes[:, 4])
            out_x = np.maximum(np.abs(dx * cos + dy * sin) - self.boxes[:, 2], 0.0)
            out_y = np.maximum(np.abs(dy * cos - dx * sin) - self.boxes[:, 3], 0.0)
            left = min(left, float(np.hypot(out_x, out_y).min()))
        return left - RADIUS

    def _search(self, start: tuple[float, float, float]) -> np.ndarray:
        """(K, 3) poses from the start to the goal's circle, 0.1 m apart."""
        goal = self.plan.goal
        heap: list[Any] = [(0.0, 0.0, start, ())]
        came: dict[tuple[int, int, int], Any] = {}
        while heap:
            _, cost, pose, before = heapq.heappop(heap)
            cell = (round(pose[0] / 0.1), round(pose[1] / 0.1), round(pose[2] / 0.15))
            if cell in came:
                continue
            came[cell] = (pose, before)
            if math.hypot(pose[0] - goal[0], pose[1] - goal[1]) < 0.9:
                path = [pose]
                while before:
                    pose, before = came[before]
                    path.append(pose)
                return np.array(path[::-1])
            for forward, turn in ((0.1, 0.0), (0.1, 0.15), (0.1, -0.15), (0.0, 0.15), (0.0, -0.15)):
                yaw = pose[2] + turn
                after = (pose[0] + forward * math.cos(yaw), pose[1] + forward * math.sin(yaw), yaw)
                left = self._room_left(*after)
                if left < 0.02 or abs(yaw) > 1.5:
                    continue
                spent = cost + forward + 0.3 * abs(turn) + 0.2 * max(0.0, 0.2 - left) + (0.05 if not forward else 0.0)
                heapq.heappush(heap, (spent + math.hypot(after[0] - goal[0], after[1] - goal[1]), spent, after, cell))
        return np.array([start, (*goal, 0.0)])


class Sighted:
    """A policy file, with the images as they are, blank, or the first one kept; each decision is held as long as in
    training."""

    def __init__(self, policy: Any, driver: str) -> None:
        self.policy, self.driver = policy, driver
        self.limits: tuple[float, float] | None = policy.contract.novelty if driver == WITH_STOP else None
        self.first: np.ndarray | None = None
        self.held, self.periods = (0.0, 0.0), 0
        self.stopped = False
        policy.reset()

    @property
    def looks(self) -> bool:
        """Whether the next command needs a new image."""
        decides = self.periods % self.policy.contract.action_repeat == 0
        return decides and not self.stopped and (self.driver in ("policy", WITH_STOP) or self.periods == 0)

    def command(self, image: np.ndarray) -> tuple[float, float]:
        """v [m/s], omega [rad/s] of one period; zeros for good after the surprise has reached the second limit."""
        if self.periods % self.policy.contract.action_repeat == 0 and not self.stopped:
            self.held = self._decide(image)
        self.periods += 1
        return self.held

    def _decide(self, image: np.ndarray) -> tuple[float, float]:
        if self.driver == "blank":
            image = np.zeros_like(image)
        elif self.driver == "frozen":
            self.first = image if self.first is None else self.first
            image = self.first
        v, omega = self.policy.step(image)
        share = 1.0
        if self.limits is not None:
            slow, stop = self.limits
            self.stopped = self.policy.novelty >= stop
            share = 0.0 if self.stopped else SafetyConfig.slow_factor if self.policy.novelty >= slow else 1.0
        return share * float(v), share * float(omega)


def load(path: str | Path, driver: str) -> Any:
    """The policy of a file, to be driven as `driver` says.

    Raises:
        ValueError: it needs more than an image or another rate than the plant's, or has no limits to be stopped by.
    """
    from bridge.policy import AgentContract, Policy

    policy = Policy.load(path)
    contract, needed = policy.contract, 1.0 / PERIOD
    if isinstance(contract, AgentContract):
        raise ValueError(f"{path}/policy.json: observes {', '.join(sorted(contract.sensors))}; this room shows one "
                         "camera image alone. Drive a policy of that.")
    rate = contract.rate_hz
    if abs(rate - needed) > 1e-6:
        raise ValueError(f"{path}/policy.json: rate_hz is {rate:g}; the plant takes {needed:g} commands a second. "
                         "Export the policy with that rate.")
    if driver == WITH_STOP and contract.novelty is None:
        raise ValueError(f"{path}/policy.json: has no novelty, the limits of --with-stop. Leave the option out, or "
                         "train with the preset transfer.")
    return policy
