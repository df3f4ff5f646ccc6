"""A robot of a file: compiled, at rest on its floor, and where its parts are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

ACROSS = 0.5  # of an axis across the vehicle, below which a wheel does not roll ahead


@dataclass(frozen=True)
class Robot:
    """A compiled differential drive and where its parts are."""

    path: Path
    spec: Any  # the editable mujoco.MjSpec
    host: mujoco.MjModel
    root: int  # address of the free joint in qpos
    speed: int  # address of the free joint in qvel
    wheels: tuple[int, ...]
    """Addresses of the driven wheels in qvel: those on the left, then as many on the right."""
    actuators: tuple[int, ...]
    sign: tuple[float, ...]  # 1 where a positive speed of the joint drives forwards
    motors: bool  # the actuators take a torque, and not a speed
    drive_gain: tuple[float, float]
    """Gain of a speed controller before motors, and the highest stable one [N m s/rad over the motor's gain]."""
    point: np.ndarray  # (3,) middle between the driven wheels, root's frame
    forward: np.ndarray  # (3,) root's frame
    wheel_radius: float
    track: float
    rest: np.ndarray  # qpos after SETTLE
    added: tuple[int, ...] = ()  # actuators that the file does not have
    sliding: tuple[int, ...] = ()  # geoms that stand on the floor and neither turn nor swivel
    distance: float = 0.0  # between the driven wheels, as the file says [m]
    notes: tuple[str, ...] = ()  # what was left out of the file
    integrals: tuple[int, ...] = ()
    """Actuators that take the same targets and pull by how far their wheels lag behind; none, or one for each wheel."""
    spin: float = 0.0  # inertia of a driven wheel, motor included [kg m^2]
    load: float = 0.0  # inertia that it speeds up, its share of the vehicle's included [kg m^2]
    falls: bool = False  # whether it falls over while nothing drives it, as a robot that balances does

    @property
    def joints(self) -> tuple[int, ...]:
        """Those of the driven wheels."""
        return tuple(int(self.host.dof_jntid[wheel]) for wheel in self.wheels)

    @property
    def askew(self) -> tuple[str, ...]:
        """Driven joints whose axes do not lie across the vehicle: their wheels do not roll ahead."""
        return tuple(self.host.joint(one).name for one in self.joints
                     if abs(float(self.resting.xaxis[one] @ self.axes[1])) < ACROSS)

    @property
    def base(self) -> int:
        """Body that moves freely."""
        return int(self.host.body_rootid[self.host.jnt_bodyid[self.joints[0]]])

    @cached_property
    def resting(self) -> mujoco.MjData:
        """Where everything is at rest; not to be changed."""
        data = mujoco.MjData(self.host)
        data.qpos[:] = self.rest
        mujoco.mj_forward(self.host, data)
        return data

    @property
    def axes(self) -> np.ndarray:
        """(3, 3) ahead, to the left and up at rest, in the room."""
        ahead = self.resting.xmat[self.base].reshape(3, 3) @ self.forward
        return np.stack([ahead, np.cross([0.0, 0.0, 1.0], ahead), [0.0, 0.0, 1.0]])

    @property
    def units(self) -> np.ndarray:
        """(W,) Command of its actuator for 1 rad/s of a wheel; of a motor, the sign of the one that speeds it up.

        A servo regulates the speed behind its gear: force = gain command + bias (gear speed), with a negative bias.
        """
        ids = list(self.actuators)
        gear, gain = self.host.actuator_gear[ids, 0], self.host.actuator_gainprm[ids, 0]
        return np.sign(gear * gain) if self.motors else -gear * self.host.actuator_biasprm[ids, 2] / gain

    @property
    def activation(self) -> np.ndarray:
        """(na,) of actuators with a memory, at rest: no wheel lags behind."""
        found = np.zeros(self.host.na)
        for one, joint in zip(self.integrals, self.joints, strict=False):
            found[self.host.actuator_actadr[one]] = self.rest[self.host.jnt_qposadr[joint]]
        return found

    @property
    def sides(self) -> np.ndarray:
        """(W,) 0 for each driven wheel on the left, then 1 for each on the right."""
        return np.repeat([0, 1], len(self.wheels) // 2)
