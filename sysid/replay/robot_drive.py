"""Drives of a robot file in C MuJoCo, many at once on the host's cores."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from sysid.replay.arrays import moved, rotated
from sysid.replay.cores import cores
from sysid.replay.robot import Robot
from sysid.replay.robot_parameters import Entry, Overlaid, Size

SPIN = 5.0  # rad/s of a wheel in the drives that are tried
SECONDS = 3.0  # of each; the first second is left out
RAMP = 0.5  # s in which the command is reached: stiff servos would tip what is light in front
SINKS = 0.05  # share by which a wheel may roll on less than its radius; one that does by more slips
LOST = 1e6  # m, rad or their rates: where a drive no longer means anything


class RobotDrive:
    """`sysid.replay.records.Host.drive` of a robot."""

    def __init__(self, robot: Robot, entries: Mapping[str, Entry | Size]):
        self._robot, self._entries = robot, entries
        self._models: list[mujoco.MjModel] = []

    def __call__(
        self, values: dict[str, np.ndarray], states: Any, commands: np.ndarray, warm_up: int, starts: np.ndarray
    ) -> np.ndarray:
        """Motion (N, B, S, 6) of N parameter sets on B trials."""
        robot = self._robot
        sets, trials, steps = commands.shape[:3]
        models = [self.model(i, {name: one[i] for name, one in values.items()}) for i in range(sets)]
        host = models[0]
        width = mujoco.mj_stateSize(host, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        first = np.zeros((sets, trials, width))
        place, speed = slice(1, 1 + host.nq), slice(1 + host.nq, 1 + host.nq + host.nv)
        first[..., place], first[..., speed] = states.qpos, states.qvel
        if host.na:
            first[..., speed.stop : speed.stop + host.na] = robot.activation
        control = self.controls(commands)
        rows = sets * trials
        data = [mujoco.MjData(host) for _ in range(min(cores(), rows))]
        path, _ = rollout.rollout([models[i // trials] for i in range(rows)], data, first.reshape(rows, -1),
                                  control.reshape(rows, steps, -1), nstep=steps)
        path = path.reshape(sets, trials, steps, -1)
        seen = self.observe(path[..., place], path[..., speed])
        if warm_up:
            before, seen = seen[:, :, warm_up - 1, None, :3], seen[:, :, warm_up:].copy()
            seen[..., :3] = moved(seen[..., :3], before, starts[:, :, None])
        lost = ~(np.abs(seen) < LOST).all(-1)
        seen[lost] = 0.0
        return np.concatenate([seen, np.maximum.accumulate(lost, axis=2)[..., None]], axis=-1)

    def controls(self, commands: np.ndarray) -> np.ndarray:
        """Commands (..., nu) of the actuators for the commands v [m/s], omega [rad/s] (..., 2) of the robot."""
        robot, host = self._robot, self._robot.host
        half = commands[..., 1] * robot.track / 2
        control = np.zeros((*commands.shape[:-1], host.nu))
        wanted = (commands[..., 0] - half, commands[..., 0] + half)
        units = np.ones(len(robot.wheels)) if robot.motors else robot.units
        for side, one, sign, unit in zip(robot.sides, robot.actuators, robot.sign, units, strict=True):
            control[..., one] = sign * wanted[side] / robot.wheel_radius * unit
        for side, one, sign in zip(robot.sides, robot.integrals, robot.sign, strict=False):
            control[..., one] = sign * wanted[side] / robot.wheel_radius
        return control

    def model(self, number: int, values: Mapping[str, float]) -> mujoco.MjModel:
        """The robot's model with values put in, one of a pool."""
        robot, nominal = self._robot, self._robot.host
        while len(self._models) <= number:
            self._models.append(copy.copy(nominal))
        model, arrays = self._models[number], dict[str, np.ndarray]()
        for name, entry in self._entries.items():
            arrays.update(entry.changes(Overlaid(nominal, arrays), float(values[name])))
        for name, array in arrays.items():
            getattr(model, name)[:] = array
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if robot.motors:
            _close_loop(model, nominal, robot, float(values["drive.kp"]))
        return model

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """(..., 5) x, y, yaw of the reference point, v and omega of the wheels."""
        robot = self._robot
        quaternion = qpos[..., robot.root + 3 : robot.root + 7]
        where = qpos[..., robot.root : robot.root + 3] + rotated(quaternion, robot.point)
        forward = rotated(quaternion, robot.forward)
        rims = np.array(robot.sign) * qvel[..., list(robot.wheels)] * robot.wheel_radius
        left, right = (rims[..., robot.sides == side].mean(-1) for side in (0, 1))
        yaw = np.arctan2(forward[..., 1], forward[..., 0])
        return np.stack([where[..., 0], where[..., 1], yaw, (left + right) / 2, (right - left) / robot.track], axis=-1)


def from_rest(robot: Robot, commands: np.ndarray) -> np.ndarray:
    """Motion (B, S, 6) of drives of `SECONDS` from rest, each with one command (B, 2) that is reached in `RAMP`."""
    count, steps = len(commands), round(SECONDS / robot.host.opt.timestep)
    ramp = np.minimum(np.arange(1, steps + 1) * robot.host.opt.timestep / RAMP, 1.0)
    states = SimpleNamespace(qpos=np.tile(robot.rest, (1, count, 1)), qvel=np.zeros((1, count, robot.host.nv)))
    values = {"drive.kp": np.array([robot.drive_gain[0]])} if robot.motors else {}
    return RobotDrive(robot, {})(values, states, commands[None, :, None] * ramp[:, None], 0, np.zeros((1, count, 3)))[0]


def rolling_ratio(robot: Robot) -> float:
    """Way of a straight drive over what its wheels turn times their radius: soft contacts let them sink, and roll on
    less. 1 where the robot does not drive."""
    path = from_rest(robot, np.array([[SPIN * robot.wheel_radius, 0.0]]))[0]
    path = path[round(SECONDS / 2 / robot.host.opt.timestep) :]
    turned = path[1:, 3].sum() * robot.host.opt.timestep
    way = np.hypot(*np.diff(path[:, :2], axis=0).T).sum()
    ratio = float(way / turned) if turned > 0 else 1.0
    return ratio if abs(ratio - 1) < SINKS else 1.0


def _close_loop(model: mujoco.MjModel, nominal: mujoco.MjModel, robot: Robot, kp: float) -> None:
    """Put the speed controller before motors into their law: torque = |gear gain| kp (target - speed)."""
    for one in robot.actuators:
        gain, gear = model.actuator_gainprm[one, 0], model.actuator_gear[one, 0]
        slope = abs(gain) * kp / abs(gear)
        model.actuator_biastype[one] = int(mujoco.mjtBias.mjBIAS_AFFINE)
        model.actuator_gainprm[one, 0] = slope * gear  # it may turn the motor the other way round
        model.actuator_biasprm[one, :3] = 0.0, 0.0, -slope
        if nominal.actuator_ctrllimited[one]:
            limits = np.sort(nominal.actuator_ctrlrange[one] * gain)
            if nominal.actuator_forcelimited[one]:
                limits = np.clip(limits, *nominal.actuator_forcerange[one])
            model.actuator_ctrllimited[one], model.actuator_forcelimited[one] = 0, 1
            model.actuator_forcerange[one] = limits
