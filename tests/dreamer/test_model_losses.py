"""Which part of a replayed step each loss of the world model reads, and the gates of its recurrence."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, tiny_config

from dreamer.experience.replay import Batch
from dreamer.model import agent, rssm, world_model

CONFIG = tiny_config()
T, B = 5, 2
KEY = jax.random.PRNGKey(2)


@pytest.fixture(scope="module")
def batch():
    keys = jax.random.split(KEY, 3)
    never = jnp.zeros((T, B), bool)
    return Batch(
        obs=jax.random.randint(keys[0], (T, B, *SHAPE), 0, 256).astype(jnp.uint8),
        prev_action=jax.random.normal(keys[1], (T, B, 2)), reward=jax.random.normal(keys[2], (T, B)), is_first=never,
        is_last=never, is_terminal=never, start=rssm.initial(CONFIG, B),
    )  # fmt: skip


@pytest.fixture(scope="module")
def losses_of():
    """(batch, with flags) -> losses (T, B) by name and deter (T, B, D)."""
    shapes = jax.eval_shape(lambda: agent.init_params(CONFIG, SHAPE, 2, KEY))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 0.3, jnp.float32), shapes)

    @jax.jit
    def run(batch):
        losses, latent, _ = world_model.loss(CONFIG, params, batch, KEY)
        return losses, latent.deter

    def call(batch, **flags):
        places = {name: jnp.zeros((T, B), bool).at[place].set(True) for name, place in flags.items()}
        return jax.tree.map(np.asarray, run(dataclasses.replace(batch, **places)))

    return call


def test_a_terminal_changes_the_continue_loss_of_its_own_step_and_a_time_out_nothing(losses_of, batch):
    plain, deter = losses_of(batch)
    timed_out, _ = losses_of(batch, is_last=(2, 0))
    ended, _ = losses_of(batch, is_last=(2, 0), is_terminal=(2, 0))
    for name, loss in plain.items():
        np.testing.assert_array_equal(timed_out[name], loss)
        changed = np.argwhere(ended[name] != loss).tolist()
        assert changed == ([[2, 0]] if name == "continue" else []), name
    # -(d log p + (1 - d) log(1 - p)) where it goes on, -log(1 - p) where it ends: the difference is d times the logit
    logit = (ended["continue"] - plain["continue"])[2, 0] / CONFIG.discount
    p = 1 / (1 + np.exp(-logit))
    assert ended["continue"][2, 0] == pytest.approx(-np.log(1 - p), rel=1e-4)


def test_a_first_step_forgets_state_and_action_of_its_own_sequence_alone(losses_of, batch):
    _, plain = losses_of(batch)
    _, begun = losses_of(batch, is_first=(2, 0))
    np.testing.assert_array_equal(begun[:2], plain[:2])
    np.testing.assert_array_equal(begun[:, 1], plain[:, 1])
    assert np.any(begun[2, 0] != plain[2, 0])
    other = dataclasses.replace(batch, prev_action=batch.prev_action.at[2, 0].set(0.3).at[:2, 0].set(-0.4))
    np.testing.assert_array_equal(losses_of(other, is_first=(2, 0))[1][2:, 0], begun[2:, 0])


def test_an_update_in_bf16_keeps_parameters_and_moments_in_float32_and_loses_what_float32_does(batch):
    def updated(dtype):
        config = tiny_config(compute_dtype=dtype)

        @jax.jit
        def update(batch):
            begun = agent.init_agent(config, SHAPE, 2, KEY)
            return agent.update(config, begun, dataclasses.replace(batch, start=rssm.initial(config, B)), KEY)

        return update(batch)

    learner, latent, metrics = updated("bfloat16")
    _, exact_latent, exact = updated("float32")
    assert latent.deter.dtype == latent.stoch.dtype == jnp.bfloat16 and exact_latent.deter.dtype == jnp.float32
    kept = [leaf for leaf in jax.tree.leaves(learner) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert {leaf.dtype for leaf in kept} == {jnp.dtype(jnp.float32)} and all(np.isfinite(leaf).all() for leaf in kept)
    for name in ("loss_recon", "loss_reward", "loss_continue", "loss_value"):
        assert metrics[name].dtype == jnp.float32
        assert float(metrics[name]) == pytest.approx(float(exact[name]), rel=0.02), name


def test_the_losses_have_the_weights_of_the_configuration(losses_of, batch):
    losses, _ = losses_of(batch)
    assert set(losses) == {"dyn", "rep", "recon", "reward", "continue"}
    # Both are the same divergence: they differ in what their gradient reaches, and in weight.
    np.testing.assert_allclose(losses["rep"], 0.1 * losses["dyn"], rtol=1e-6)
    assert losses["dyn"].min() >= 1.0


@pytest.mark.quick
def test_the_gates_of_the_recurrence_by_hand():
    config = tiny_config(deter=4, blocks=2)
    gates = jnp.array([[[0.5, -1.0, 2.0, 0.3, 1.0, -2.0], [0.0, 0.7, -0.4, 1.5, 3.0, 0.2]]])  # 3 x 2 units per block
    old = np.array([0.9, -0.2, 0.1, 0.6])
    new = rssm.gru(config, jnp.asarray(old, jnp.float32)[None], gates)[0]

    def sigmoid(x):
        return 1 / (1 + np.exp(-np.asarray(x)))

    reset, candidate, update = np.array([0.5, -1.0, 0.0, 0.7]), np.array([2.0, 0.3, -0.4, 1.5]), [1.0, -2.0, 3.0, 0.2]
    share = sigmoid(np.array(update) - 1.0)  # slow to change at the start
    np.testing.assert_allclose(new, share * np.tanh(sigmoid(reset) * candidate) + (1 - share) * old, rtol=1e-5)
