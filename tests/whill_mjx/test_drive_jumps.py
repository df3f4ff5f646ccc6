"""Commands that jump within a physics step while the motors are at their torque limit."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset

TWISTS = np.array([(0.0, 0.0)] * 2 + [(0.9, 0.6)] * 10 + [(0.0, 0.0)] * 12)  # every 0.1 s
DELAYS = np.arange(0.0152, 0.0249, 0.0002)


def test_where_a_drive_ends_depends_smoothly_on_when_its_commands_arrive():
    """Over two steps of 5 ms the rate at which the end moves with the delay stays near the speed of the drive (0.9 m/s,
    0.6 rad/s). Anti-windup that goes by the mean target of a step moved the heading by up to 7 rad/s there."""
    with jax.enable_x64(True):
        build_model.cache_clear()
        spec, params = preset("whill_cr_physical")
        model = build_model(spec, VehicleConfig(physics_dt=0.005))

        def end(delay):
            effects = (replace(e, delay=delay) if e.name == "command_delay" else e for e in params.effects)
            vehicle = replace(params, effects=tuple(effects))
            start = place(model, vehicle, 0.0, 0.0, 0.0)
            state, _ = jax.lax.scan(lambda s, c: (drive(model, vehicle, s, c), None), start, jnp.asarray(TWISTS))
            return jnp.stack(reference_pose(model, state.qpos))

        ends = np.asarray(jax.jit(jax.vmap(end))(jnp.asarray(DELAYS)))
        build_model.cache_clear()
    slopes = np.diff(ends, axis=0) / np.diff(DELAYS)[:, None]
    x, y, yaw = np.abs(slopes - np.median(slopes, 0)).max(0)
    assert max(x, y) < 1.8 and yaw < 1.5
