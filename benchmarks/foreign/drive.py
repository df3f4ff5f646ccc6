"""The contact plant in lock-step with a driver: one command, 0.1 s of contact dynamics, one image."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import mujoco
import numpy as np

from benchmarks.plant.base import TICK
from benchmarks.plant.chair import Chair
from benchmarks.plant.trial import ROLLING, Noise, Plant

PERIOD = 0.1
"""Time from one command to the next [s]."""


@dataclass(frozen=True)
class Pose:
    """Drive-axle centre in the room."""

    x: float
    y: float
    yaw: float
    pitch: float
    roll: float


class SteppedPlant(Plant):
    """The plant, driven command by command instead of by a whole table of them."""

    def __init__(self, chair: Chair, start: tuple[float, float, float], random: np.random.Generator) -> None:
        super().__init__(chair)
        self.noise, self.random = Noise().of(chair), random
        self.integral, self.push = [0.0, 0.0], [0.0, 0.0]
        late = round(chair.delay / TICK)
        self.waiting = deque([(0.0, 0.0)] * late, maxlen=late + 1)
        self.model.pair_friction[:2, :2] = chair.friction * np.exp(self.noise.grip * random.standard_normal((2, 1)))
        self._place(start)

    def pose(self) -> Pose:
        """Where the chair is."""
        w, x, y, z = self.data.qpos[3:7]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        return Pose(float(self.data.qpos[0]), float(self.data.qpos[1]), yaw, pitch, roll)

    def drive_period(self, v: float, omega: float) -> None:
        """Drive one period with the command v [m/s], omega [rad/s]."""
        chair, data = self.chair, self.data
        rho = math.exp(-TICK / self.noise.correlation)
        fresh = math.sqrt(1 - rho * rho)
        half, nominal = chair.nominal.track / 2, chair.nominal
        for _ in range(round(PERIOD / TICK)):
            self.waiting.append((v, omega))
            v_now, omega_now = self.waiting[0]
            w = data.qvel
            pose = self.pose()
            cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
            targets = (v_now - half * omega_now) / nominal.radius, (v_now + half * omega_now) / nominal.radius
            torques = []
            for side in (0, 1):
                error = targets[side] - float(w[self.wheel_v[side]])
                self.integral[side] += error * TICK
                wanted = chair.kp * error + chair.ki * self.integral[side]
                torques.append(max(-chair.torque_limit, min(chair.torque_limit, wanted)))
            spins = abs(float(w[self.wheel_v[0]])) + abs(float(w[self.wheel_v[1]]))
            rough = min(1.0, spins / ROLLING)
            sizes = self.noise.road_force, self.noise.yaw_torque
            self.push = [rho * old + fresh * size * self.random.standard_normal()
                         for old, size in zip(self.push, sizes, strict=True)]  # fmt: skip
            sideways = cos * w[1] - sin * w[0]
            rollers = -2 * chair.roller_drag * (sideways + nominal.wheelbase * w[5])
            forward = rough * self.push[0]
            applied = data.qfrc_applied
            applied[0], applied[1] = cos * forward - sin * rollers, sin * forward + cos * rollers
            applied[5] = rough * self.push[1] + nominal.wheelbase * rollers
            for side in (0, 1):
                applied[self.wheel_v[side]] = torques[side]
            mujoco.mj_step(self.model, data, self.substeps)
