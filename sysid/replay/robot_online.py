"""A robot file that is driven as it goes, a command at a time, in C MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from sysid.replay.robot_drive import RobotDrive
from sysid.replay.robot_loading import load_robot
from sysid.replay.robot_vehicle import outline_of
from whill_mjx.vehicle.specs import VehicleSpec, in_proportion


class OnlineRobot:
    """One robot on a flat floor, with its own controller; nothing else is in its world."""

    def __init__(self, path: str | Path, wheels: Sequence[str] = ()) -> None:
        """Compile an MJCF, URDF or xacro file and stand at the origin; FileNotFoundError or ValueError where it is
        none.

        `wheels`: joints or actuators of the driven wheels, left and right; by default those that their names show.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path}: no such robot file. Give an MJCF, URDF or xacro file.")
        self.robot = load_robot(Path(path), wheels, regulated=True)
        self._drive = RobotDrive(self.robot, {})
        self._model = self._drive.model(0, {"drive.kp": self.robot.drive_gain[0]} if self.robot.motors else {})
        self._data = mujoco.MjData(self._model)
        self._due = 0.0  # s asked for and not yet simulated, less than a step
        self.place(0.0, 0.0, 0.0)

    def spec(self, base: VehicleSpec) -> VehicleSpec:
        """Sizes and outline of the robot; limits and camera are those of `base`, and the rest in proportion to it."""
        robot, (middle, body) = self.robot, outline_of(self.robot)
        mass = float(robot.host.body_subtreemass[robot.base])
        spec = in_proportion(base, robot.path.stem, robot.wheel_radius, robot.track, mass=mass)
        return replace(spec, drive="differential", driven_axle="rear", rear_axle_x=-middle, camera=base.camera, **body)

    def place(self, x: float, y: float, yaw: float) -> None:
        """Stand still with the middle between the driven wheels at x, y [m], heading yaw [rad]."""
        robot, data = self.robot, self._data
        mujoco.mj_resetData(self._model, data)
        data.qpos[:] = robot.rest
        data.act[:] = robot.activation
        here = self._drive.observe(data.qpos, data.qvel)
        turn = yaw - here[2]
        arm = data.qpos[robot.root : robot.root + 2] - here[:2]
        cos, sin = math.cos(turn), math.sin(turn)
        data.qpos[robot.root : robot.root + 2] = x + cos * arm[0] - sin * arm[1], y + sin * arm[0] + cos * arm[1]
        attitude = data.qpos[robot.root + 3 : robot.root + 7].copy()
        mujoco.mju_mulQuat(data.qpos[robot.root + 3 : robot.root + 7], [math.cos(turn / 2), 0, 0, math.sin(turn / 2)],
                           attitude)
        mujoco.mj_forward(self._model, data)
        self.odometry = np.zeros(5)
        """(5,) x, y [m], yaw [rad], v [m/s], omega [rad/s] as its wheels report them, from its start."""

    def advance(self, v: float, omega: float, seconds: float) -> None:
        """Drive with a command, v [m/s], omega [rad/s]; ValueError where the motion is no longer finite."""
        data, dt = self._data, float(self._model.opt.timestep)
        data.ctrl[:] = self._drive.controls(np.array([v, omega]))
        self._due += seconds
        steps = round(self._due / dt)
        self._due -= steps * dt
        for _ in range(steps):
            mujoco.mj_step(self._model, data)
            speed, turn = self._drive.observe(data.qpos, data.qvel)[3:]
            x, y, yaw = self.odometry[:3]
            heading = yaw + turn * dt / 2
            self.odometry[:] = (x + speed * dt * math.cos(heading), y + speed * dt * math.sin(heading), yaw + turn * dt,
                                speed, turn)
        if not np.isfinite(data.qpos).all():
            raise ValueError(f"{self.robot.path}: its motion became non-finite. Take a smaller option timestep.")

    @property
    def motion(self) -> np.ndarray:
        """(5,) x, y [m], yaw [rad], v [m/s], omega [rad/s] of the middle between the driven wheels now."""
        robot, data = self.robot, self._data
        x, y, yaw = self._drive.observe(data.qpos, data.qvel)[:3]
        attitude = data.xmat[robot.base].reshape(3, 3)
        turn, arm = attitude @ data.qvel[robot.speed + 3 : robot.speed + 6], attitude @ robot.point
        velocity = data.qvel[robot.speed : robot.speed + 3] + np.cross(turn, arm)
        return np.array([x, y, yaw, math.cos(yaw) * velocity[0] + math.sin(yaw) * velocity[1], turn[2]])
