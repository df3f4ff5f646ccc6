"""One drive of an exported Python file and in the simulator, and how far apart they are."""

from __future__ import annotations

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, VehicleState


def largest_distance(path: Path, spec: VehicleSpec, params: VehicleParams, commands: np.ndarray) -> float:
    """Largest distance [m] between a drive of an exported file and the same drive in the simulator.

    Args:
        commands: (T, 2) v [m/s] and omega [rad/s] in force in each physics step.
    """
    with jax.enable_x64(True):
        space = runpy.run_path(str(path))
        state, driven = space["start"](), []
        for v, omega in commands:
            state = space["step"](state, v, omega)
            driven.append(np.concatenate(space["pose"](state))[:2])
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), params)
        model = build_model(spec, VehicleConfig(control_dt=space["DT"], physics_dt=space["DT"]))

        def one(state: VehicleState, command: jax.Array) -> tuple[VehicleState, jax.Array]:
            state = substep(model, params, state, command)
            return state, jnp.stack(reference_pose(model, state.qpos))[:2]

        first = place(model, params, 0.0, 0.0, 0.0)
        simulated = jax.jit(lambda given: jax.lax.scan(one, first, given)[1])(jnp.asarray(commands))
        return float(np.linalg.norm(np.stack(driven) - np.asarray(simulated), axis=1).max())
