"""The grid world of the benchmark, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import grid_env
from benchmarks.grid_env import Room


def walk(room, actions):
    """Steps of one room, from a state given by hand."""
    env = grid_env.make(1)
    step = jax.jit(env.step)
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], room)
    steps = []
    for action in actions:
        state, transition = step(state, jnp.array([action]))
        steps.append(jax.tree.map(lambda leaf: np.asarray(leaf)[0], transition))
    return steps


def seen(step):
    """Cells (row, column) of agent, key and door as far as the picture shows them."""
    channels = np.moveaxis(step.obs["image"][:: grid_env.PIXELS, :: grid_env.PIXELS], -1, 0)
    return np.array([cell for channel in channels for cell in np.argwhere(channel)])


def room(**changes):
    start = dict(agent=jnp.array([0, 0]), key_place=jnp.array([0, 1]), door=jnp.array([1, 1]), has_key=jnp.array(False),
                 count=jnp.array(0), over=jnp.array(False), random=jax.random.PRNGKey(0))  # fmt: skip
    return Room(**{**start, **changes})


def test_the_key_pays_once_and_the_door_only_with_it():
    steps = walk(room(), [1, 3, 2, 0, 3, 2, 3, 1])  # onto the door without the key, back for it, off, on, to the door
    rewards = [round(float(step.reward), 2) for step in steps]
    assert rewards == [-0.01, -0.01, -0.01, -0.01, 0.99, -0.01, -0.01, 0.99]
    assert [bool(step.is_terminal) for step in steps] == [False] * 7 + [True]
    np.testing.assert_array_equal(seen(steps[3]), [[0, 0], [0, 1], [1, 1]])
    np.testing.assert_array_equal(seen(steps[4]), [[0, 1], [1, 1]])  # the key is taken
    assert [float(step.obs["holding"][0]) for step in steps] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert steps[-1].metrics["success"] == 1.0


def test_walls_hold_and_time_runs_out_without_a_terminal():
    steps = walk(room(agent=jnp.array([3, 3]), count=jnp.array(grid_env.LIMIT - 2)), [1, 3, 0])
    assert seen(steps[0])[0].tolist() == [3, 3]
    assert bool(steps[1].is_last) and not bool(steps[1].is_terminal)
    assert bool(steps[2].is_first) and float(steps[2].reward) == 0.0 and not bool(steps[2].is_last)


@pytest.mark.quick
def test_agent_key_and_door_begin_in_different_cells():
    _, transition = jax.jit(grid_env.make(200).reset)(jax.random.PRNGKey(1))
    image = np.asarray(transition.obs["image"]).reshape(200, -1, 3)
    places = image.argmax(1)
    assert all(len(set(row)) == 3 for row in places) and len({tuple(row) for row in places}) > 150
    np.testing.assert_array_equal((image > 0).sum(1), grid_env.PIXELS**2)
