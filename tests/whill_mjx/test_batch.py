"""Many instances: auto-reset, equality with single instances, random parameters."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.batch import make_batch
from whill_mjx.env import make_env, observe, step
from whill_mjx.learning.setup import functional_env
from whill_mjx.tasks.tasks import ObstacleCourse

ROOT = Path(__file__).parents[2]
TWO_DEVICES = """
import json
import jax, jax.numpy as jnp, numpy as np
from whill_mjx.batch import make_batch
from whill_mjx.env import make_env
from whill_mjx.tasks.tasks import ObstacleCourse
env, params = make_env(ObstacleCourse(max_steps=1), height=16, width=16)
told = {}
def run(devices):
    batch = make_batch(env, params, 4, 0.1, devices)
    def drive(key):
        state, _ = batch.reset(key)
        return jax.lax.scan(batch.step, state, jnp.ones((2, 4, 2)))
    compiled = jax.jit(drive).lower(jax.random.key(0)).compile()
    state, frames = compiled(jax.random.key(0))
    told["exchanged"] = any(name in compiled.as_text() for name in ("all-gather", "all-reduce", "collective-permute"))
    told["rows"] = [shard.data.shape[1] for shard in frames.obs.addressable_shards]
    told["firsts"] = np.asarray(frames.first).tolist()
    return np.asarray(frames.obs, int), np.append(state.env.vehicle.qpos, frames.reward)
alone, many = run(()), run(tuple(jax.devices()))
told["equal_pixels"] = float((np.abs(alone[0] - many[0]) <= 1).mean())
told["difference"] = float(np.abs(alone[1] - many[1]).max())
print(json.dumps(told))
"""
COUNT = 3


@pytest.mark.quick
@pytest.mark.parametrize("changes", [{"count": 0}, {"count": -2}, {"count": 2.5}, {"spread": float("nan")},
                                     {"spread": -0.1}, {"second_tries": float("nan")}])
def test_a_batch_refuses_arguments_that_are_no_number_of_instances_or_spread(changes):
    (name, value), = changes.items()
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        make_batch(*make_env("obstacle_course", height=16, width=16), **{"count": 2, **changes})


@pytest.mark.quick
def test_an_environment_and_its_parameters_in_the_wrong_order_are_refused():
    env, params = make_env("obstacle_course", height=16, width=16)
    with pytest.raises(ValueError, match="env is a VehicleParams, not Env.*make_batch\\(env, params, count\\)"):
        make_batch(params, env, 2)


@pytest.fixture(scope="module")
def batch():
    """Episodes of three steps, vehicles that differ, and compiled reset and step."""
    env, params = make_env(ObstacleCourse(max_steps=3), height=16, width=16)
    many = make_batch(env, params, COUNT, spread=0.05)
    return many, jax.jit(many.reset), jax.jit(many.step)


def test_the_goal_reaches_the_learner_with_its_reward_and_its_own_frame():
    env, params = make_env(ObstacleCourse(goal_radius=20.0), height=16, width=16)  # there at once
    learned = functional_env(make_batch(env, params, COUNT))
    reset, advance = jax.jit(learned.reset), jax.jit(learned.step)
    state, first = reset(jax.random.key(0))
    state, goal = advance(state, jnp.ones((COUNT, 2)))
    assert bool((goal.is_terminal & goal.is_last & ~goal.is_first).all())
    assert bool(goal.metrics["success"].all()) and bool((goal.reward > 90).all())
    seen = jax.jit(jax.vmap(lambda one: observe(env, one)))(state.env)
    assert (np.abs(np.asarray(seen, int) - goal.obs) <= 1).mean() > 0.99
    _, after = advance(state, jnp.ones((COUNT, 2)))
    assert bool((after.is_first & ~after.is_terminal).all()) and not np.asarray(after.reward).any()


def test_terminal_observation_is_kept_and_the_next_call_starts_a_new_episode(batch):
    many, reset, advance = batch
    state, first = reset(jax.random.key(0))
    assert bool(first.first.all()) and not np.asarray(first.reward).any()
    actions = jnp.tile(jnp.array([1.0, 0.1]), (COUNT, 1))
    for _ in range(3):
        state, last = advance(state, actions)
        assert not bool(last.first.any())
    assert bool(last.truncated.all()) and bool(last.metrics["timeout"].all())
    seen = jax.jit(jax.vmap(lambda one: observe(many.env, one)))(state.env)
    # The frame of the end, not of the next start; other fusion may round a grey level differently.
    assert (np.abs(np.asarray(seen, int) - np.asarray(last.obs, int)) <= 1).mean() > 0.99
    again, begun = advance(state, actions)
    assert bool(begun.first.all()) and not np.asarray(begun.reward).any() and not bool(begun.truncated.any())
    assert (np.asarray(again.env.step_count) == 0).all() and not np.asarray(again.env.command).any()
    assert not np.allclose(again.env.scene.boxes.centre, state.env.scene.boxes.centre)
    assert not np.allclose(again.params.body.mass, state.params.body.mass)
    assert not np.asarray(again.tries).any()  # no share of failed worlds is begun again by default
    _, on = advance(again, actions)
    assert not bool(on.first.any()) and np.asarray(on.reward).any()


@pytest.mark.parametrize("shape", [(2,), (COUNT, 1), (COUNT, 3), (COUNT, 2, 1), (COUNT + 1, 2)])
def test_actions_of_another_shape_are_refused(batch, shape):
    many, reset, _ = batch
    state, _ = jax.eval_shape(reset, jax.random.key(0))
    with pytest.raises(ValueError, match=rf"a step takes \({COUNT}, 2\)"):
        jax.eval_shape(many.step, state, jnp.zeros(shape))


def test_a_batch_equals_its_instances_one_by_one(batch):
    many, reset, advance = batch
    state, _ = reset(jax.random.key(1))
    actions = jax.random.uniform(jax.random.key(2), (COUNT, 2), minval=-1.0)
    _, together = advance(state, actions)
    alone = jax.jit(lambda params, state, action: step(many.env, params, state, action))
    for index in range(COUNT):
        one = jax.tree.map(lambda leaf, i=index: leaf[i], state)
        _, single = alone(one.params, one.env, actions[index])
        np.testing.assert_allclose(single.reward, together.reward[index], atol=1e-3)
        np.testing.assert_allclose(single.metrics["x"], together.metrics["x"][index], atol=1e-5)
        assert (np.abs(np.asarray(single.obs, int) - np.asarray(together.obs[index], int)) <= 1).mean() > 0.99


def test_instances_have_their_own_worlds_and_vehicles(batch):
    state, first = batch[1](jax.random.key(3))
    assert len(np.unique(np.asarray(state.params.body.mass))) == COUNT
    assert len(np.unique(np.asarray(state.env.scene.boxes.centre[:, 3, 1]))) == COUNT
    assert first.obs.shape == (COUNT, 16, 16, 3) and first.obs.dtype == jnp.uint8


def test_the_same_key_gives_the_same_worlds(batch):
    one, other = (batch[1](jax.random.key(4))[1] for _ in range(2))
    np.testing.assert_array_equal(one.obs, other.obs)


def test_devices_step_their_own_instances_and_give_what_one_device_gives():
    flags = "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"}
    command = [sys.executable, "-c", TWO_DEVICES]
    answer = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr[-3000:]
    told = json.loads(answer.stdout.splitlines()[-1])
    assert told["rows"] == [2, 2] and not told["exchanged"]
    assert told["firsts"] == [[False] * 4, [True] * 4]  # the second step begins new episodes
    assert told["difference"] < 1e-5 and told["equal_pixels"] > 0.99


def test_instances_can_be_split_over_devices_and_uneven_splits_are_refused():
    env, params = make_env(ObstacleCourse(max_steps=3), height=16, width=16)
    devices = tuple(jax.devices())
    split = make_batch(env, params, 2 * len(devices), devices=devices)
    _, first = jax.jit(split.reset)(jax.random.key(0))
    assert len(first.obs.sharding.device_set) == len(devices)
    with pytest.raises(ValueError, match="evenly"):
        make_batch(env, params, 3, devices=devices * 2)


@dataclasses.dataclass(frozen=True)
class Lot(ObstacleCourse):
    """A success far from the goal in a fourth of the worlds, and none beside the goal, where each of them ends."""

    max_steps: int = 1
    goal_radius: float = 100.0

    def endings(self, moment):
        lot = 1e3 * jnp.sum(moment.scene.boxes.centre)
        return {"success": lot - jnp.floor(lot) < 0.25}


@pytest.mark.parametrize("count", [8, 32])  # one by one, and as a processor begins many
def test_a_share_of_the_failed_worlds_is_begun_again(count):
    """The same world, vehicle and start; one with a success, wherever it was, is never begun again."""
    env, params = make_env(Lot(), height=8, width=8)
    many = make_batch(env, params, count, spread=0.05, second_tries=0.5)

    def drive(key):
        state, _ = many.reset(key)
        return jax.lax.scan(advance, (state, state), None, length=768 // count)[1]

    def advance(last_two, _):  # an episode has one step, at whose end time is up
        begun, ended = last_two
        new, frame = many.step(ended, jnp.ones((count, 2)))
        same = [jax.vmap(lambda one, two: jnp.allclose(one, two, atol=1e-5))(a, b) for a, b in zip(
            jax.tree.leaves((begun.env.scene, begun.params, begun.env.vehicle.qpos)),
            jax.tree.leaves((new.env.scene, new.params, new.env.vehicle.qpos)), strict=True)]
        told = jnp.all(frame.first), frame.metrics["success"] > 0, new.tries
        return (ended, new), (jnp.all(jnp.stack(same), 0), *told)

    same, first, success, tries = (np.asarray(each) for each in jax.jit(drive)(jax.random.key(2)))
    same, first, arrived, tries = same[1::2], first[1::2], success[::2], tries[1::2]
    assert first.all()  # every second step begins episodes
    assert 0.1 < arrived.mean() < 0.5
    assert not same[arrived].any() and 0.35 <= same[~arrived].mean() <= 0.65
    counted = np.zeros(count, int)
    for row, told in zip(same, tries, strict=True):
        counted = np.where(row, counted + 1, 0)
        np.testing.assert_array_equal(told, counted)


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_failed_worlds_cannot_be_begun_again_for_ever(share):
    env, params = make_env(height=8, width=8)
    with pytest.raises(ValueError, match="second_tries"):
        make_batch(env, params, 2, second_tries=share)
