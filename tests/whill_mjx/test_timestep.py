"""The time step: what a coarse one changes."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.physics import timestep_errors
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import HUSKY, WHILL_CR


def test_the_default_step_keeps_a_figure_eight_within_2_mm_and_2_mrad_of_one_eight_times_smaller():
    position, turn, rims = timestep_errors("whill_cr_physical", VehicleConfig().physics_dt)
    assert position < 2e-3 and turn < 2e-3  # m, rad
    assert rims < 5e-3  # m/s


@lru_cache
def compiled(spec, dt):
    """Drive of any parameters, with steps of dt [s]."""
    model = build_model(spec, VehicleConfig(physics_dt=dt))

    def run(params, commands):
        def step(state, command):
            state = drive(model, params, state, command)
            return state, jnp.concatenate([jnp.stack(reference_pose(model, state.qpos)), state.qvel[6:8]])

        return jax.lax.scan(step, place(model, params, 0.0, 0.0, 0.0), commands)[1]

    return jax.jit(run)


def roll(params, spec, dt, commands):
    """(T, 5) x, y, yaw [m, rad] and spins of both wheels [rad/s] after every command of commands (T, 2)."""
    return np.asarray(compiled(spec, dt)(params, commands))


@pytest.mark.parametrize("grip, kp", [(0.1, 7.0), (0.2, 25.0), (0.35, 40.0)])
def test_the_default_step_drives_a_slippery_floor_as_one_eight_times_smaller(grip, kp):
    """Wheels break away at every start and every stop: their speed is then a matter of their own small inertia."""
    params = preset_params(WHILL_CR, "physical")
    names = ("slip_traction.mu", "slip_traction.slip_speed", "torque_drive.kp", "torque_drive.limit")
    params = set_values(params, names, jnp.array([grip, 0.01, kp, 25.0]))
    commands = jnp.repeat(jnp.array([[0.9, 0.0], [0.0, 0.0], [0.6, 0.5], [-0.3, -0.6], [0.0, 0.0]]), 15, axis=0)
    coarse, fine = (roll(params, WHILL_CR, dt, commands) for dt in (VehicleConfig().physics_dt, 0.000625))
    broke_away = np.abs(fine[2, 3] * WHILL_CR.wheel_radius - np.diff(fine[1:3, 0])[0] / 0.1)
    assert broke_away > 0.1  # m/s between rim and floor
    np.testing.assert_allclose(coarse[:, :3], fine[:, :3], atol=0.01)
    np.testing.assert_allclose(coarse[14, 3:], fine[14, 3:], atol=0.05)
    assert np.abs(coarse[70:, 3:]).max() < 0.1  # at rest again, but for what the integral still holds


def test_how_far_skidding_tyres_turn_does_not_depend_on_the_step():
    params = preset_params(HUSKY, "physical")
    commands = jnp.repeat(jnp.array([[0.8, 0.8], [0.4, -1.0], [0.0, 1.0]]), 10, axis=0)
    poses = [roll(params, HUSKY, dt, commands)[-1, :3] for dt in (0.005, 0.01)]
    assert abs(poses[0][2]) > 0.1
    np.testing.assert_allclose(poses[1], poses[0], atol=5e-3)
