"""The task of a kerb and its ramp: the vehicle feels the ramp, and the kerb stops it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env, observe, reset_state, step_state
from whill_mjx.evaluation.conditions import begin_under, nominal
from whill_mjx.tasks.kerb_ramp import KerbRamp


@pytest.fixture(scope="module")
def driven():
    """Heights, pitches and ends of two drives straight ahead: towards the cut, and towards the kerb beside it."""
    env, params = make_env(KerbRamp(layout="fixed", max_steps=60), vehicle="whill_cr_ramp")
    start = reset_state(env, params, jax.random.key(0))

    def drive(start_y):
        yaw = -jnp.rad2deg(jnp.arctan2(0.4, 2.2))  # the start looks at the cut; these look along the way
        condition = dataclasses.replace(nominal(), start_y=start_y, start_yaw_deg=yaw)
        state = begin_under(condition, env, params, start)

        def one(state, _):
            state, outcome = step_state(env, params, state, jnp.array([0.6, 0.0]))
            qpos = state.vehicle.qpos
            pitch = jnp.arcsin(2 * (qpos[4] * qpos[6] - qpos[3] * qpos[5]))  # nose up
            return state, (qpos[0], qpos[2], pitch, outcome.metrics["collision"], state.vehicle.diverged)

        return jax.lax.scan(one, state, None, length=60)

    end, path = jax.jit(jax.vmap(drive))(jnp.array([0.4, -0.8]))
    image = jax.jit(lambda state: observe(env, state))
    return env, start, [np.asarray(leaf) for leaf in path], image(start), image(jax.tree.map(lambda leaf: leaf[0], end))


def test_a_vehicle_that_drives_through_the_cut_climbs_the_ramp_and_stands_level_on_the_pavement(driven):
    _, start, (x, z, pitch, collided, diverged), _, _ = driven
    ramp = start.scene.ground[0]
    rise, length = float(ramp.rise), float(ramp.length)
    assert not collided[0].any() and not diverged.any()
    assert x[0, -1] > 2.2 + length + 0.5
    assert z[0, -1] - z[0, 0] == pytest.approx(rise, abs=0.01)
    assert 0.4 * rise / length < pitch[0].max() < 1.6 * rise / length
    assert abs(pitch[0, -1] - pitch[0, 0]) < 0.01


def test_the_kerb_beside_the_cut_stops_the_vehicle(driven):
    _, _, (x, z, _, collided, _), _, _ = driven
    assert collided[1].sum() == 1
    assert x[1, -1] < 2.2 and z[1, -1] == pytest.approx(z[1, 0], abs=0.01)


def test_the_camera_sees_ramp_and_pavement(driven):
    env, start, _, before, after = driven
    level = start.scene.replace(solids=None, ghosts=None)
    plain = jax.jit(lambda state: observe(env, state))(start.replace(scene=level))
    assert np.mean(np.any(np.asarray(before) != np.asarray(plain), -1)) > 0.05
    assert not np.array_equal(before, after)


def test_worlds_of_the_kerb_vary_and_leave_a_way_through():
    task = KerbRamp()
    worlds = jax.jit(jax.vmap(task.sample_world))(jax.random.split(jax.random.key(1), 64))
    ramp = worlds.scene.ground[0]
    assert np.all(np.asarray(1.5 * ramp.rise / ramp.length) <= 1.5 / task.run[0] + 1e-6)
    assert np.std(np.asarray(ramp.rise)) > 0.01
    left, right = (worlds.scene.boxes.centre[:, index, 1] - side * worlds.scene.boxes.half[:, index, 1]
                   for index, side in ((3, 1.0), (4, -1.0)))  # fmt: skip
    width = np.asarray(left - right)
    assert width.min() >= task.cut[0] - 1e-5 and width.max() <= task.cut[1] + 1e-5


@pytest.mark.quick
def test_a_ramp_that_leads_through_the_wall_behind_the_marker_is_refused():
    KerbRamp(rise=(0.06, 0.14), run=(8.0, 30.0))  # it ends at 6.4 m, the room at 7.5 m
    for fields in ({"rise": (0.1, 0.5)}, {"run": (8.0, 40.0)}, {"kerb_x": 6.0}, {"goal_x": 1.5}):
        with pytest.raises(ValueError, match="the ramp ends at .* and the room at .* farther goal_x"):
            KerbRamp(**fields)
