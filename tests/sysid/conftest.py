"""A small kinematic vehicle in place of the simulator, and a dataset driven with it."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sysid.errors.pose_objective import Objective, estimate_noise
from sysid.errors.space import Space
from sysid.replay.records import Plant
from sysid.replay.rollout import Replay, make_batch
from whill_mjx.logs.manoeuvres import Scenario
from whill_mjx.vehicle.specs import WHILL_CR

SHORT = Scenario(v=0.5, omega=0.8, length=3.0)


def unicycle_plant(dt: float = 0.02) -> Plant:
    """v and omega follow the command with lags tau_v, tau_omega; the body turns `turn` times what the odometry sees."""

    def place(params, start):
        x, y, yaw, v, omega = start
        zero = jnp.zeros_like(x)
        return jnp.stack([x, y, yaw, v, omega, zero, zero, zero])

    def substep(params, state, command):
        tau_v, tau_omega, turn = params
        x, y, yaw, v, omega, ox, oy, oyaw = state
        v = v + dt * (command[0] - v) / tau_v
        omega = omega + dt * (command[1] - omega) / tau_omega
        yaw, oyaw = yaw + dt * turn * omega, oyaw + dt * omega
        return jnp.stack([x + dt * v * jnp.cos(yaw), y + dt * v * jnp.sin(yaw), yaw, v, omega,
                          ox + dt * v * jnp.cos(oyaw), oy + dt * v * jnp.sin(oyaw), oyaw])

    def observe(state):
        x, y, yaw, v, omega, ox, oy, oyaw = state
        wrapped = jnp.arctan2(jnp.sin(yaw), jnp.cos(yaw))
        return jnp.stack([x, y, wrapped, ox, oy, oyaw, v, omega, jnp.zeros_like(x)])

    def move(state, start):
        return jnp.concatenate([start[:3], state[3:5], jnp.zeros(3)])

    return Plant(place, substep, observe, dt, move)


TRUTH = np.array([0.25, 0.15, 0.9])
UNICYCLE_SPACE = Space(("tau_v", "tau_omega", "turn"), np.array([0.02, 0.02, 0.5]), np.array([1.0, 1.0, 1.5]),
                       np.array([0.1, 0.1, 1.0]), np.array([True, True, False]))


def unicycle_objective(trials, space: Space = UNICYCLE_SPACE) -> Objective:
    plant = unicycle_plant()
    batch, measured = make_batch(trials, plant.dt, record_dt=0.04)
    return Objective(Replay(plant, batch, lambda values: values), space, trials, measured, estimate_noise(trials))


@pytest.fixture(scope="session")
def unicycle_log(tmp_path_factory):
    """Log of the kinematic vehicle at TRUTH, with sensor noise."""
    from benchmarks.planted_logs import Schedule, write_dataset
    from sysid.logs.log import load_log

    folder = tmp_path_factory.mktemp("unicycle") / "log"
    write_dataset(folder, WHILL_CR, jnp.asarray(TRUTH), Schedule(replicates=2, scenario=SHORT, seed=3),
                  plant=unicycle_plant())
    return load_log(folder)


@pytest.fixture(scope="session")
def objective(unicycle_log) -> Objective:
    return unicycle_objective(unicycle_log.training)


def shared_folder(name: str) -> Path:
    """Folder of a measured set beside the repository (or under WHILL_SHARED); skips where it is not there."""
    shared = Path(os.environ.get("WHILL_SHARED", Path(__file__).parents[2] / ".." / "shared"))
    root = shared / "data" / "measured" / name
    if not root.is_dir():
        pytest.skip(f"measured set {name} is not in {root}; set WHILL_SHARED to the folder that holds data/measured")
    return root


def without_start_noise(trial):
    none = dict.fromkeys(("position_sigma", "yaw_sigma", "odometry_position_sigma", "odometry_yaw_sigma"), 0.0)
    return dataclasses.replace(trial, start=dataclasses.replace(trial.start, **none))
