"""One environment instance: rewards along a drive, endings, metrics, compilation."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import Env, make_env, reset_state, step, step_state
from whill_mjx.tasks.tasks import ObstacleCourse
from whill_mjx.vehicle.model import build_model


@pytest.fixture(scope="module")
def course():
    """Fixed course, its parameters, and compiled reset and image-free step."""
    env, params = make_env("obstacle_course", layout="fixed")
    begin = jax.jit(lambda params, key: reset_state(env, params, key))
    advance = jax.jit(lambda params, state, action: step_state(env, params, state, action))
    return env, params, begin, advance


def drive_until_done(params, state, advance, action):
    outcomes = []
    while not bool(state.done):
        state, outcome = advance(params, state, jnp.asarray(action))
        outcomes.append(outcome)
    return state, outcomes


def test_driving_straight_on_ends_in_a_collision_with_the_papers_reward(course):
    _, params, begin, advance = course
    start = begin(params, jax.random.key(0))
    state, outcomes = drive_until_done(params, start, advance, [1.0, 0.0])
    last = outcomes[-1]
    assert bool(last.terminated) and not bool(last.truncated)
    assert last.metrics["collision"] == 1 and last.metrics["success"] == 0 and last.metrics["clearance"] == 0
    progress = float(start.goal_distance) - float(last.metrics["goal_distance"])
    np.testing.assert_allclose(float(state.episode_return), 30 * progress - 0.05 * len(outcomes) - 50.0, atol=0.01)
    np.testing.assert_allclose(float(state.episode_return), sum(float(one.reward) for one in outcomes), rtol=1e-4)
    np.testing.assert_allclose(last.metrics["episode_return"], state.episode_return, rtol=1e-5)
    np.testing.assert_allclose(last.metrics["time_s"], 0.1 * len(outcomes), rtol=1e-5)
    assert all(float(one.metrics["time_s"]) == 0 for one in outcomes[:-1])


def test_each_step_pays_progress_time_and_smoothness(course):
    _, params, begin, advance = course
    state = begin(params, jax.random.key(0))
    before = float(state.goal_distance)
    for action in ([1.0, 0.3], [1.0, -0.2]):
        omega = float(state.command[1])
        state, outcome = advance(params, state, jnp.asarray(action))
        distance = float(outcome.metrics["goal_distance"])
        by_hand = 30 * (before - distance) - 0.05 - abs(action[1] - omega)
        np.testing.assert_allclose(float(outcome.reward), by_hand, atol=1e-3)
        goal_x, goal_y = (float(value) for value in state.scene.marker.position[:2])
        x, y = float(outcome.metrics["x"]), float(outcome.metrics["y"])
        np.testing.assert_allclose(distance, np.hypot(goal_x - x, goal_y - y), rtol=1e-5)
        before = distance


def test_goal_is_reached_within_one_metre_of_the_driven_axle(course):
    _, params, begin, advance = course
    state = begin(params, jax.random.key(0))
    open_field = dataclasses.replace(state.scene.boxes, mask=jnp.zeros_like(state.scene.boxes.mask))
    state = dataclasses.replace(state, scene=dataclasses.replace(state.scene, boxes=open_field))
    state, outcomes = drive_until_done(params, state, advance, [1.0, 0.0])
    last = outcomes[-1]
    assert last.metrics["success"] == 1 and bool(last.terminated)
    assert 0.85 < float(last.metrics["goal_distance"]) <= 1.0 < float(outcomes[-2].metrics["goal_distance"])
    assert float(last.reward) > 100
    assert 4.4 < float(last.metrics["time_s"]) < 4.9  # 4.3 m with a ramp of 1.7 m/s^2


def test_nothing_moves_after_the_end(course):
    _, params, begin, advance = course
    state, _ = drive_until_done(params, begin(params, jax.random.key(0)), advance, [1.0, 0.0])
    after, outcome = advance(params, state, jnp.array([1.0, 0.0]))
    assert float(outcome.reward) == 0.0 and not bool(outcome.terminated) and outcome.metrics["collision"] == 0
    np.testing.assert_array_equal(after.vehicle.qpos, state.vehicle.qpos)
    assert int(after.step_count) == int(state.step_count)


def test_a_diverged_vehicle_ends_the_episode_and_is_counted(course):
    _, params, begin, advance = course
    state = begin(params, jax.random.key(0))
    broken = dataclasses.replace(params, body=dataclasses.replace(params.body, mass=jnp.array(jnp.nan)))
    after, outcome = advance(broken, state, jnp.array([1.0, 0.0]))
    assert bool(outcome.terminated) and outcome.metrics["diverged"] == 1 and outcome.metrics["collision"] == 0
    assert np.isfinite(float(outcome.reward)) and np.isfinite(np.asarray(after.vehicle.qpos)).all()


@pytest.mark.parametrize("action", [[jnp.nan, 0.0], [1.0, jnp.nan], [jnp.inf, 0.0]])
def test_an_action_that_is_no_number_is_standstill_and_ends_the_episode(course, action):
    _, params, begin, advance = course
    state = begin(params, jax.random.key(0))
    after, outcome = advance(params, state, jnp.array(action))
    assert bool(outcome.terminated) and bool(after.done) and bool(after.vehicle.diverged)
    assert outcome.metrics["diverged"] == 1 and outcome.metrics["success"] == outcome.metrics["collision"] == 0
    np.testing.assert_array_equal(after.command, [0.0, 0.0])
    still, _ = advance(params, state, jnp.zeros(2))
    np.testing.assert_array_equal(after.vehicle.qpos, still.vehicle.qpos)
    assert np.isfinite(float(outcome.reward))


@pytest.mark.parametrize(("roll", "over"), [(60.0, False), (120.0, True)])
def test_a_vehicle_that_has_fallen_over_ends_the_episode_as_diverged(course, roll, over):
    _, params, begin, advance = course
    state = begin(params, jax.random.key(0))
    half = np.radians(roll) / 2
    qpos = state.vehicle.qpos.at[3:7].set(jnp.array([np.cos(half), np.sin(half), 0.0, 0.0])).at[2].add(1.0)
    fallen = dataclasses.replace(state, vehicle=dataclasses.replace(state.vehicle, qpos=qpos))
    after, outcome = advance(params, fallen, jnp.zeros(2))
    assert bool(after.vehicle.diverged) == over and bool(outcome.terminated) == over
    assert outcome.metrics["diverged"] == over and outcome.metrics["collision"] == 0


def test_other_parameters_and_worlds_need_no_second_compilation(course):
    _, params, begin, advance = course
    advance(params, begin(params, jax.random.key(0)), jnp.array([1.0, 0.0]))
    compiled = advance._cache_size()
    heavy = jnp.full_like(params.body.mass, 90.0)  # of the same type: a plain 90.0 is a weak one, another program
    heavier = dataclasses.replace(params, body=dataclasses.replace(params.body, mass=heavy))
    advance(heavier, begin(heavier, jax.random.key(7)), jnp.array([0.5, 0.5]))
    assert advance._cache_size() == compiled > 0


def test_action_repeat_sums_rewards_and_stops_at_the_time_limit():
    _, params = make_env("obstacle_course")
    task = ObstacleCourse(layout="fixed", action_repeat=2, max_steps=3)
    env = Env(build_model(make_env()[0].model.spec), task, 16, 16)
    single = dataclasses.replace(env, task=dataclasses.replace(task, action_repeat=1))
    state = reset_state(env, params, jax.random.key(0))
    action = jnp.array([1.0, 0.2])
    twice = jax.jit(lambda state, action: step(env, params, state, action))
    once = jax.jit(lambda state, action: step_state(single, params, state, action))
    rewards, steps = [], state
    for _ in range(3):
        steps, outcome = once(steps, action)
        rewards.append(float(outcome.reward))
    middle, first = twice(state, action)
    np.testing.assert_allclose(float(first.reward), rewards[0] + rewards[1], rtol=1e-4)
    assert not bool(first.truncated) and int(middle.step_count) == 2 and first.obs.shape == (16, 16, 3)
    end, last = twice(middle, action)
    np.testing.assert_allclose(float(last.reward), rewards[2], rtol=1e-4)  # only one period was left
    assert bool(last.truncated) and not bool(last.terminated) and last.metrics["timeout"] == 1
    assert int(end.step_count) == 3


@pytest.mark.quick
def test_unknown_tasks_and_layouts_are_refused():
    with pytest.raises(ValueError, match="obstacle_course"):
        make_env("slalom")
    with pytest.raises(ValueError, match="randomised"):
        make_env("corridor", layout="maze")
    with pytest.raises(ValueError, match="task is 3; give a Task"):
        make_env(3)


@pytest.mark.quick
@pytest.mark.parametrize("changes", [{"height": 0}, {"width": -3}, {"height": 16.5}, {"width": True},
                                     {"exploring_starts": float("nan")}])
def test_an_environment_refuses_arguments_that_make_no_image_or_share(changes):
    (name, value), = changes.items()
    with pytest.raises(ValueError, match=f"environment: {name} is {value}; it must "):
        make_env("obstacle_course", **changes)


@pytest.mark.quick
def test_the_randomised_corridor_has_random_looks_unless_told_otherwise():
    env, _ = make_env("corridor")
    assert env.random_looks and env.photometric
    plain, _ = make_env("corridor", layout="fixed")
    assert not plain.random_looks and not plain.photometric
    assert not make_env("corridor", random_looks=False)[0].random_looks
