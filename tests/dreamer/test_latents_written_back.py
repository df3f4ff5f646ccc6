"""Which latents go back into the replay: those of the update, each with the step it was inferred from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import tiny_config

from dreamer.experience import iteration, replay
from dreamer.experience.replay import Window
from dreamer.model.rssm import Latent

T = 4
CONFIG = tiny_config(batch_size=4, batch_length=T, replay_capacity=24)


def constant(values):
    """(T, B) states that all hold their sequence's number, as deter and as class."""
    number = jnp.broadcast_to(jnp.asarray(values), (T, len(values)))
    classes = jax.nn.one_hot(jnp.repeat(number[..., None], CONFIG.stoch, -1), CONFIG.classes)
    deter = jnp.repeat(number[..., None].astype(jnp.float32), CONFIG.deter, -1)
    return Latent(deter, classes.reshape(T, len(values), -1))


@pytest.mark.quick
@pytest.mark.parametrize("starts", [(2, 4), (4, 2), (11, 9), (9, 11)])
def test_of_overlapping_sequences_the_last_one_keeps_its_states_whole(starts):
    memory = replay.init(CONFIG, 2, (2, 2, 1), 1)  # 12 rows of 2 streams
    first, second = starts
    begin = jnp.array([first, second, first, first])
    window = Window((begin + jnp.arange(-1, T)[:, None]) % 12, jnp.array([0, 0, 1, 1]))
    after = replay.write_back(CONFIG, memory, window, constant([1, 2, 1, 3]))
    expected = np.zeros((12, 2))
    expected[np.arange(first, first + T) % 12, 0] = 1
    expected[np.arange(second, second + T) % 12, 0] = 2
    expected[np.arange(first, first + T) % 12, 1] = 3  # the same steps twice
    np.testing.assert_array_equal(after.deter, np.repeat(expected[..., None], CONFIG.deter, -1))
    np.testing.assert_array_equal(after.stoch, np.repeat(expected[..., None], CONFIG.stoch, -1))


def test_updates_refresh_the_states_of_the_steps_they_were_given():
    """The update is replaced by one that infers from each frame the number of its row."""
    config = tiny_config(batch_size=3, batch_length=T, replay_capacity=60, online=False)
    number = jnp.arange(60.0).reshape(30, 2)  # row and stream of a step, told by its reward
    memory = replay.init(config, 2, (2, 2, 1), 1)
    memory = dataclasses.replace(memory, reward=number, written=jnp.array(30), deter=memory.deter - 1.0)
    nothing = jnp.zeros(())
    state = iteration.TrainState(*[nothing] * 4, memory, *[nothing] * 5)

    def update(config, agent, batch, key):
        deter = jnp.repeat(batch.reward[..., None], config.deter, -1)
        index = jnp.repeat((batch.reward % config.classes).astype(jnp.int32)[..., None], config.stoch, -1)
        stoch = jax.nn.one_hot(index, config.classes).reshape(T, 3, -1)
        return agent, Latent(deter, stoch), {"context": jnp.sum(batch.start.deter[:, 0] == -1.0)}

    after = jax.jit(
        lambda: iteration.replayed_updates(config, state, jnp.array(5), jax.random.PRNGKey(0), update, None)
    )()[0].replay
    fresh = np.asarray(after.deter[..., 0]) != -1.0
    assert 2 * T < fresh.sum() <= 5 * 3 * T and not fresh[0].any()  # row 0 is only ever the context
    np.testing.assert_array_equal(np.asarray(after.deter[..., 0])[fresh], np.asarray(number)[fresh])
    np.testing.assert_array_equal(np.asarray(after.stoch[..., 0])[fresh], np.asarray(number)[fresh] % config.classes)
