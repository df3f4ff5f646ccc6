"""The planner with the true scene: the ceiling of the obstacle course, and proof that it can be driven."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env, reset_state, step_state
from whill_mjx.planner import first_plan, for_task, plan_action, predicted_return
from whill_mjx.scene import no_boxes
from whill_mjx.task import sample_world


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
    """Its own model has no lag: now and then it grazes a box (once in 144 worlds)."""
    env, params = make_env("obstacle_course")
    drive = jax.jit(jax.vmap(lambda key: episode(env, params, key, 65)))
    returns, distance, periods, done = map(np.asarray, drive(jax.random.split(jax.random.key(1), 10)))
    there = distance <= 1.0
    assert done.all() and there.sum() >= 9
    assert 220 <= returns[there].mean() <= 226  # 224.9 over 96 worlds
    assert 4.6 <= periods[there].mean() * 0.1 <= 5.2  # 4.93 s over 96 worlds


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
    value = float(predicted_return(config, env, open_field, start, jnp.zeros(()), straight))
    periods = 4.3 + 0.29
    assert value == pytest.approx(100 + 30 * 4.35 - periods * 10 * (0.05 + config.hurry), abs=3.0)
    blocked = float(predicted_return(config, env, scene, start, jnp.zeros(()), straight))
    assert blocked < value - 100
