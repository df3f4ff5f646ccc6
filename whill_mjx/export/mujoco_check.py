"""One drive in C MuJoCo and in the simulator, and how far apart they are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from whill_mjx.export.force_callback import VehicleForces
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose, rotation_from_quaternion
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec
from whill_mjx.vehicle.types import VehicleState
from whill_mjx.vehicle.vehicle_file import load_vehicle

TIPPED = 0.8  # rad of tilt from which no vehicle comes back on its wheels


@dataclass(frozen=True)
class BothDrives:
    """The same drive in C MuJoCo and in the simulator, at every physics step."""

    mujoco: np.ndarray  # (T, 3) x, y [m], yaw [rad] of the reference point
    simulator: np.ndarray  # (T, 3)
    tilt: np.ndarray
    """(T,) of the vehicle against the vertical, the larger of both [rad]."""

    @property
    def upright(self) -> int:
        """Steps until it tips over; all where it does not."""
        fallen = np.flatnonzero(self.tilt > TIPPED)
        return int(fallen[0]) if len(fallen) else len(self.tilt)

    @property
    def distance(self) -> float:
        """Largest distance between the two while the vehicle stands on its wheels [m]."""
        apart = (self.mujoco - self.simulator)[: self.upright, :2]
        return float(np.linalg.norm(apart, axis=1).max(initial=0.0))

    @property
    def turn(self) -> float:
        """Largest difference of the yaw meanwhile [rad]."""
        apart = (self.mujoco - self.simulator)[: self.upright, 2]
        return float(np.abs(np.angle(np.exp(1j * apart))).max(initial=0.0))


def drive_both(folder: Path, commands: np.ndarray) -> BothDrives:
    """Drive an exported folder in C MuJoCo and its vehicle in the simulator.

    Args:
        commands: (T, 2) v [m/s] and omega [rad/s] in force in each physics step.
    """
    host = mujoco.MjModel.from_xml_path(str(folder / "vehicle.xml"))
    data = mujoco.MjData(host)
    spec, params, _ = load_vehicle(folder / "vehicle.toml")
    callback = VehicleForces(spec, params, host)
    callback.place(data)
    driven = []
    mujoco.set_mjcb_control(callback)
    try:
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(host, data)
            driven.append(data.qpos.copy())
    finally:
        mujoco.set_mjcb_control(None)
    dt = float(host.opt.timestep)
    model = build_model(spec, VehicleConfig(control_dt=dt, physics_dt=dt))

    def seen(qpos: jax.Array) -> jax.Array:
        """x, y, yaw and tilt."""
        upward = rotation_from_quaternion(qpos[3:7])[2, 2]
        return jnp.stack([*reference_pose(model, qpos), jnp.arccos(jnp.clip(upward, -1.0, 1.0))])

    def one(state: VehicleState, command: jax.Array) -> tuple[VehicleState, jax.Array]:
        state = substep(model, params, state, command)
        return state, seen(state.qpos)

    dtype = jnp.result_type(float)
    limits = host.actuator_ctrlrange  # MuJoCo clips what it is given
    clipped = jnp.asarray(np.clip(commands, limits[:, 0], limits[:, 1]), dtype)
    simulated = jax.jit(lambda c: jax.lax.scan(one, place(model, params, 0.0, 0.0, 0.0), c)[1])(clipped)
    ours, theirs = (np.asarray(one, float) for one in (
        simulated, jax.jit(jax.vmap(seen))(jnp.asarray(np.stack(driven), dtype))))
    return BothDrives(theirs[:, :3], ours[:, :3], np.maximum(ours[:, 3], theirs[:, 3]))


def scenario_in_proportion(spec: VehicleSpec) -> Scenario:
    """How hard a vehicle of this size is driven: a small one tips over as easily as a large one (Froude number)."""
    slower = math.sqrt(spec.track / WHILL_CR.track)
    usual = Scenario()
    return Scenario(v=min(usual.v * slower, spec.v_max), omega=min(usual.omega / slower, spec.omega_max))
