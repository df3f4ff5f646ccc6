"""The time step: what a coarse one changes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.physics import timestep_errors
from whill_mjx.config import VehicleConfig
from whill_mjx.kinematics import reference_pose
from whill_mjx.model import build_model
from whill_mjx.presets import preset_params
from whill_mjx.specs import HUSKY
from whill_mjx.vehicle import drive, place


def test_the_default_step_keeps_a_figure_eight_within_2_mm_and_2_mrad_of_one_eight_times_smaller():
    position, turn, rims = timestep_errors("whill_cr_physical", VehicleConfig().physics_dt)
    assert position < 2e-3 and turn < 2e-3  # m, rad
    assert rims < 5e-3  # m/s


def test_how_far_skidding_tyres_turn_does_not_depend_on_the_step():
    params = preset_params(HUSKY, "physical")
    commands = jnp.repeat(jnp.array([[0.8, 0.8], [0.4, -1.0], [0.0, 1.0]]), 10, axis=0)
    poses = []
    for dt in (0.005, 0.01):
        model = build_model(HUSKY, VehicleConfig(physics_dt=dt))

        def roll(state, model=model):
            return jax.lax.scan(lambda s, c: (drive(model, params, s, c), None), state, commands)[0]

        poses.append(np.array(reference_pose(model, jax.jit(roll)(place(model, params, 0.0, 0.0, 0.0)).qpos)))
    assert abs(poses[0][2]) > 0.1
    np.testing.assert_allclose(poses[1], poses[0], atol=5e-3)
