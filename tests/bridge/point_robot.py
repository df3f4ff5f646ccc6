"""A point on a plane instead of a chair: its camera image is one colour that changes as it moves."""

import math
from dataclasses import replace

import numpy as np

from bridge.policy import SensorInput
from bridge.simulation.simulated import Frame, Grid


class PointRobot:
    """Drives from x = 0; the goal is at x = 0.3 m, so at 0.3 m/s it is reached in about a second."""

    period = 0.1
    goal = 0.3
    longest = 3000
    intrinsics = (60.0, 60.0, 32.0, 32.0)
    grid = Grid(np.array([[False, False, True], [False] * 3]), 0.5, -1.0, 0.0)

    def __init__(self, task="", vehicle=None):
        self.reset(0)

    def reset(self, seed):
        self.x = self.y = self.yaw = 0.0
        self.steps = 0
        return self._frame(0.0, 0.0)

    def step(self, v, omega):
        self.yaw += omega * self.period
        self.x += v * self.period * math.cos(self.yaw)
        self.y += v * self.period * math.sin(self.yaw)
        self.steps += 1
        return self._frame(v, omega)

    def _frame(self, v, omega):
        image = np.full((64, 64, 3), 255, np.uint8)
        image[0, self.steps % 64] = 254 - self.steps % 100  # each frame differs, as a real camera's do
        reached = self.x >= self.goal
        done = reached or self.steps >= self.longest
        return Frame(image, self.x, self.y, self.yaw, v, omega, reached_goal=reached, done=done, terminated=reached,
                     odometry=(self.x, self.y, self.yaw, v, omega),
                     ranges=np.array([max(4.0 - self.x, 0.0), 1.0, 10.0, 1.0]))


class SensingRobot(PointRobot):
    """Has a second camera and a lidar of the policy's own; it never reaches its goal, but may stop before."""

    goal, longest = 100.0, 100_000
    sensors = {"camera": SensorInput("camera", "camera", (64, 64, 3)), "rear": SensorInput("rear", "camera", (6, 8, 3)),
               "lidar": SensorInput("lidar", "lidar", (4,), {"reach": 8.0}),
               "odometry": SensorInput("odometry", "odometry", (5,))}

    def _frame(self, v, omega):
        frame = super()._frame(v, omega)
        rear = np.full((6, 8, 3), 250, np.uint8)
        rear[0, self.steps % 8] = self.steps % 100
        lidar = np.array([8.0, 3.0 - self.x, 5.0, 8.0])
        return replace(frame, sensed={"camera": frame.image, "rear": rear, "lidar": lidar})


class CrashingRobot(PointRobot):
    """Meets a wall after half a second, whatever it is told."""

    def step(self, v, omega):
        frame = super().step(0.0, 0.0)
        hit = self.steps >= 5
        return replace(frame, collided=hit, done=hit, terminated=hit)


class EndlessRobot(PointRobot):
    """Never arrives within a test."""

    goal = 100.0


class RovingRobot(EndlessRobot):
    """Drives about in a single episode."""

    longest = 100_000
