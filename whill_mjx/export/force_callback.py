"""The forces of a vehicle in C MuJoCo, as a control callback.

It does what `whill_mjx.vehicle.dynamics.forces` does, with the same code compiled for the processor.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from whill_mjx.effects.base import apply_chain
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import advance_odometry, forces, place
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import VehicleModel, build_model
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import Odometry, VehicleParams, VehicleState
from whill_mjx.vehicle.vehicle_file import load_vehicle


class VehicleForces:
    """The forces of one vehicle as a control callback of MuJoCo, with the memory of its effects."""

    def __init__(self, spec: VehicleSpec, params: VehicleParams, model: mujoco.MjModel, prefix: str = ""):
        """Look the vehicle up in a compiled model.

        Args:
            spec, params: the vehicle that `vehicle.xml` was exported from.
            model: that file, or a scene that it is part of.
            prefix: of the vehicle's names in the scene.

        Raises:
            ValueError: the model has no such vehicle, or another integrator or timestep than the simulator.
        """
        if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            raise ValueError("the model's integrator is not Euler; the vehicle's controller and delays count steps. "
                             'Set integrator="Euler".')
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
            raise ValueError("the model disables actuation, and MuJoCo then leaves control callbacks out. Remove the "
                             "flag.")
        dt = float(model.opt.timestep)
        self._static = build_model(spec, VehicleConfig(control_dt=dt, physics_dt=dt))
        self._params = params
        try:
            joints = [model.joint(prefix + name) for name in ("root", "left_wheel", "right_wheel")]
            self._ctrl = np.array([model.actuator(prefix + name).id for name in ("v", "omega")])
        except KeyError as error:
            raise ValueError(f"the model has no vehicle of prefix {prefix!r}: {error.args[0]} Export it with "
                             "`python -m whill_mjx.export_mjcf`.") from None
        root, left, right = joints
        self._qpos = np.r_[root.qposadr[0] : root.qposadr[0] + 7, left.qposadr, right.qposadr]
        self._qvel = np.r_[root.dofadr[0] : root.dofadr[0] + 6, left.dofadr, right.dofadr]
        self._advance = jax.jit(_advance, static_argnums=0)
        self._time, self._moved = math.inf, False
        self._before: dict[str, Any] = {}
        self._after: dict[str, Any] = {}

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write the forces of the present state and command into data.qfrc_applied of the vehicle's joints.

        Called again at the same data.time, it repeats itself; when time has gone back, the vehicle starts afresh.
        """
        if data.time < self._time:
            self._before, self._moved = _start(self._static, self._params, data.qvel[self._qvel]), False
        elif data.time > self._time:
            self._before, self._moved = self._after, True
        self._time = data.time
        call = _Call(data.qpos[self._qpos], data.qvel[self._qvel], data.ctrl[self._ctrl], self._moved)
        state, force = self._advance(self._static, self._params, self._before, call)
        self._after = state
        data.qfrc_applied[self._qvel] = np.asarray(force)

    def place(self, data: mujoco.MjData, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, v: float = 0.0,
              omega: float = 0.0) -> None:  # fmt: skip
        """Put the vehicle's reference point at a pose [m, rad], driving at v [m/s] and omega [rad/s], as if new."""
        state = place(self._static, self._params, x, y, yaw, (v, omega))
        data.qpos[self._qpos], data.qvel[self._qvel] = np.asarray(state.qpos), np.asarray(state.qvel)
        self._time = math.inf

    def pose(self, data: mujoco.MjData) -> np.ndarray:
        """x, y [m] and yaw [rad] of the reference point."""
        return np.array(reference_pose(self._static, jnp.asarray(data.qpos[self._qpos])), float)

    @property
    def odometry(self) -> dict[str, float]:
        """What the vehicle reports: x, y [m], yaw [rad], v [m/s], omega [rad/s], gyro [rad/s]."""
        reading = self._after.get("reading")
        return {name: float(getattr(reading, name, 0.0)) for name in ("x", "y", "yaw", "v", "omega", "gyro")}


def load_forces(path: str | Path, model: mujoco.MjModel, prefix: str = "") -> VehicleForces:
    """The callback for a vehicle file; errors as of `load_vehicle` and `VehicleForces`."""
    spec, params, _ = load_vehicle(path)
    return VehicleForces(spec, params, model, prefix)


def _start(model: VehicleModel, params: VehicleParams, qvel: np.ndarray) -> dict[str, Any]:
    """Memory of a vehicle that was never driven, its wheels turning with `qvel` (8,)."""
    zero = jnp.zeros(())
    blank = Odometry(*(zero,) * 6)
    encoder = replace(advance_odometry(blank, jnp.asarray(qvel[6:8], zero.dtype), model), x=zero, y=zero, yaw=zero)
    encoder = replace(encoder, gyro=jnp.asarray(qvel[5], zero.dtype))
    state = place(model, params, 0.0, 0.0, 0.0)
    _, _, motion = forces(model, params, state, jnp.zeros(2))
    memory = tuple(effect.init() for effect in params.effects)
    return {"memory": memory, "encoder": encoder, "reading": encoder, "motion": motion}


class _Call(NamedTuple):
    """What MuJoCo holds when it calls."""

    qpos: jax.Array
    qvel: jax.Array
    command: jax.Array
    moved: bool
    """A step has passed since the call before."""


def _advance(
    model: VehicleModel, params: VehicleParams, before: dict[str, Any], call: _Call
) -> tuple[dict[str, Any], jax.Array]:
    """State after the present call, and qfrc_applied (8,)."""
    dtype, moved = before["encoder"].x.dtype, call.moved
    qpos, qvel, command = (jnp.asarray(value, dtype) for value in call[:3])
    encoder = replace(advance_odometry(before["encoder"], qvel[6:8], model), gyro=qvel[5])
    sensed, reading = apply_chain(params.effects, before["memory"], "sensing", encoder, before["motion"])
    memory, encoder, reading = jax.tree.map(
        lambda new, old: jnp.where(moved, new, old), (sensed, encoder, reading),
        (before["memory"], before["encoder"], before["reading"]))
    state = VehicleState(qpos, qvel, memory, encoder, reading, jnp.zeros((), bool))
    memory, force, motion = forces(model, params, state, command)
    return {"memory": memory, "encoder": encoder, "reading": reading, "motion": motion}, force
