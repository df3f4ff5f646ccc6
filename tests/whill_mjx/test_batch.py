"""Many instances: auto-reset, equality with single instances, random parameters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.batch import make_batch
from whill_mjx.env import make_env, observe, step
from whill_mjx.task import ObstacleCourse

COUNT = 3


@pytest.fixture(scope="module")
def batch():
    """Episodes of three steps, vehicles that differ, and compiled reset and step."""
    env, params = make_env(ObstacleCourse(max_steps=3), height=16, width=16)
    many = make_batch(env, params, COUNT, spread=0.05)
    return many, jax.jit(many.reset), jax.jit(many.step)


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
    _, on = advance(again, actions)
    assert not bool(on.first.any()) and np.asarray(on.reward).any()


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


def test_instances_can_be_split_over_devices_and_uneven_splits_are_refused():
    env, params = make_env(ObstacleCourse(max_steps=3), height=16, width=16)
    devices = tuple(jax.devices())
    split = make_batch(env, params, 2 * len(devices), devices=devices)
    _, first = jax.jit(split.reset)(jax.random.key(0))
    assert len(first.obs.sharding.device_set) == len(devices)
    with pytest.raises(ValueError, match="evenly"):
        make_batch(env, params, 3, devices=devices * 2)
