"""The planner with the true scene: the ceiling of the obstacle course, and proof that it can be driven."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env, reset_state, step_state
from whill_mjx.evaluation.planner import Begin, first_plan, for_task, plan_action, predicted_poses, predicted_return
from whill_mjx.tasks.tasks import sample_world
from whill_mjx.vehicle.dynamics import drive, place
from whill_mjx.vehicle.kinematics import body_twist, reference_pose
from whill_mjx.world.scene import no_boxes


def episode(env, params, key, steps):
    """Rewards, ends and actions (steps,) of one planned episode."""
    config = for_task(env.task)
    reset_key, plan_key, drive_key = jax.random.split(key, 3)
    state = reset_state(env, params, reset_key)

    def one_step(carry, step_key):
        state, plan = carry
        action, plan = plan_action(config, env, state, plan, step_key)
        after, outcome = step_state(env, params, state, action)
        return (after, plan), outcome.reward

    plan = first_plan(config, env, state, plan_key)
    (state, _), _ = jax.lax.scan(one_step, (state, plan), jax.random.split(drive_key, steps))
    return state.episode_return, state.goal_distance, state.step_count, state.done


def test_planner_arrives_in_time_with_the_return_the_course_was_set_for():
    """It arrived in all of 1000 other worlds."""
    env, params = make_env("obstacle_course")
    drive = jax.jit(jax.vmap(lambda key: episode(env, params, key, 65)))
    returns, distance, periods, done = map(np.asarray, drive(jax.random.split(jax.random.key(1), 10)))
    there = distance <= 1.0
    assert done.all() and there.all()
    assert 220 <= returns.mean() <= 226  # 225.0 over 1000 worlds
    assert 4.6 <= periods.mean() * 0.1 <= 5.2  # 4.92 s over 1000 worlds


def test_planner_gets_past_the_box_in_the_corridor():
    env, params = make_env("corridor")
    drive = jax.jit(jax.vmap(lambda key: episode(env, params, key, 240)))
    returns, distance, _, done = drive(jax.random.split(jax.random.key(2), 3))
    assert np.asarray(done).all() and (np.asarray(distance) <= 1.0).all()
    assert 170 <= float(returns.mean()) <= 215


@pytest.mark.quick
def test_predicted_return_of_full_speed_over_an_open_field_is_that_of_the_reward():
    env, _ = make_env("obstacle_course", layout="fixed")
    scene = sample_world(env.task, jax.random.key(0)).scene
    open_field = scene.replace(boxes=no_boxes(1))
    config = for_task(env.task)
    start, straight = jnp.zeros(5), jnp.tile(jnp.array([1.0, 0.0]), (config.knots, 1))
    value = float(predicted_return(config, env, Begin(open_field, start, jnp.zeros(2)), straight))
    periods = 4.3 + 0.29
    assert value == pytest.approx(100 + 30 * 4.35 - periods * 10 * (0.05 + config.hurry), abs=3.0)
    blocked = float(predicted_return(config, env, Begin(scene, start, jnp.zeros(2)), straight))
    assert blocked < value - 100


def test_its_model_goes_where_the_vehicle_goes_and_without_the_lag_runs_ahead():
    env, params = make_env("obstacle_course")
    commands = jnp.repeat(jnp.array([[1.0, 0.0], [1.0, 0.8], [0.4, -0.5]]), 6, axis=0)

    def period(state, command):
        state = drive(env.model, params, state, command)
        twist = body_twist(env.model, state.qpos, state.qvel)
        return state, jnp.stack([*reference_pose(env.model, state.qpos), *twist])

    begin = place(env.model, params, 0.0, 0.0, 0.0)
    driven = np.asarray(jax.jit(lambda state: jax.lax.scan(period, state, commands)[1])(begin))
    config = for_task(env.task)
    errors = []
    for lag in (config.lag, (1e-3, 1e-3)):
        model = dataclasses.replace(config, lag=lag)
        whole = predicted_poses(model, env, jnp.zeros(5), jnp.zeros(2), commands, 0.1)
        later = predicted_poses(model, env, jnp.asarray(driven[5]), commands[5], commands[6:], 0.1)
        errors.append([np.hypot(*(poses[-1, :2] - driven[-1, :2])) for poses in (whole, later)])
    assert max(errors[0]) < 0.04  # m, after 1.3 m
    assert errors[0][0] < errors[1][0] / 1.5
