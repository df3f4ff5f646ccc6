import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, tiny_config

from dreamer.layers import distributions as dist
from dreamer.layers import image
from dreamer.model import agent, rssm, world_model
from dreamer.model.rssm import Latent

CONFIG = tiny_config()
T, B, A = 8, 2, 2
KEY = jax.random.PRNGKey(7)


@pytest.fixture(scope="module")
def params():
    params = jax.jit(lambda: agent.init_params(CONFIG, SHAPE, A, jax.random.PRNGKey(0)))()
    # Biases and scales are trivial at the start; disturb them so that forgetting one is seen.
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.PRNGKey(1), len(leaves))
    noisy = [x + 0.1 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(structure, noisy)


@pytest.fixture(scope="module")
def sequence():
    """Frames, previous actions and random numbers of T steps."""
    keys = jax.random.split(KEY, 3)
    obs = jax.random.randint(keys[0], (T, B, *SHAPE), 0, 256).astype(jnp.uint8)
    return obs, jax.random.normal(keys[1], (T, B, A)), jax.random.uniform(keys[2], (T, B, CONFIG.stoch))


@pytest.fixture(scope="module")
def observe():
    @jax.jit
    def run(params, start, actions, obs, is_first, uniform):
        tokens = image.encode(CONFIG, params["enc"], obs)
        return rssm.observe(CONFIG, params["dyn"], start, rssm.Sequences(actions, tokens, is_first, uniform))

    return run


def garbage_start():
    return Latent(jnp.full((B, CONFIG.deter), 0.7), jnp.full((B, CONFIG.stoch_size), 0.3))


def test_a_spliced_episode_equals_a_fresh_run_bit_for_bit(params, sequence, observe):
    obs, actions, uniform = sequence
    half = T // 2
    first = jnp.zeros((T, B), bool).at[0].set(True)
    fresh, _ = observe(params, garbage_start(), actions, obs, first, uniform)
    spliced = [jnp.concatenate([jnp.flip(x[half:], 0), x[:half]]) for x in (actions, obs, uniform)]
    again, _ = observe(params, garbage_start(), *spliced[:2], first.at[half].set(True), spliced[2])
    for name in ("deter", "stoch"):
        np.testing.assert_array_equal(getattr(again, name)[half:], getattr(fresh, name)[:half])
    kept, _ = observe(params, garbage_start(), *spliced[:2], first, spliced[2])
    assert np.any(kept.deter[half:] != fresh.deter[:half])  # without the flag the past is seen


def test_acting_infers_the_same_latents_as_training(params, sequence, observe):
    obs, _, _ = sequence
    is_first = jnp.zeros((T, B), bool).at[0].set(True).at[5, 1].set(True)
    keys = jax.random.split(KEY, T)
    carry = agent.init_carry(CONFIG, B, A)
    act = jax.jit(lambda carry, obs, first, key: agent.act(CONFIG, params, carry, obs, first, agent.Choice(key)))
    acted, actions = [], [jnp.zeros((B, A))]
    for t in range(T):
        carry, action = act(carry, obs[t], is_first[t], keys[t])
        acted.append(carry)
        actions.append(action)
    uniform = jnp.stack([jax.random.uniform(jax.random.split(k)[0], (B, CONFIG.stoch)) for k in keys])
    trained, _ = observe(params, rssm.initial(CONFIG, B), jnp.stack(actions[:-1]), obs, is_first, uniform)
    np.testing.assert_allclose(np.stack([c["deter"] for c in acted]), trained.deter, atol=2e-5)
    np.testing.assert_allclose(np.stack([c["stoch"] for c in acted]), trained.stoch, atol=1e-5)


def test_the_vehicle_step_equals_acting_in_mode_from_a_zero_carry(params, sequence):
    obs, _, _ = sequence
    act = jax.jit(lambda carry, obs, first: agent.act(CONFIG, params, carry, obs, first, agent.Choice()))
    step = jax.jit(lambda carry, obs: agent.policy_step(CONFIG, params, carry, obs))
    batched, single = agent.init_carry(CONFIG, B, A), agent.policy_carry(CONFIG, A)
    for t in range(3):
        first = jnp.full((B,), t == 0)
        batched, action = act(batched, obs[t], first)
        single, one = step(single, obs[t, 0])
        np.testing.assert_allclose(one, action[0], atol=1e-5)
    assert {k: v.dtype for k, v in single.items()} == {k: jnp.float32 for k in single}
    assert np.all(np.abs(one) <= 1.0)


def test_gradients_of_the_fast_scan_equal_those_of_the_plain_recurrence(params, sequence):
    obs, actions, uniform = sequence
    is_first = jnp.zeros((T, B), bool).at[0].set(True).at[3, 0].set(True)
    weigh = jax.random.normal(KEY, (T, B, CONFIG.deter + CONFIG.stoch_size))
    tokens = image.encode(CONFIG, params["enc"], obs)

    def plain(dyn, tokens):
        latent, total = garbage_start(), 0.0
        for t in range(T):
            keep = 1.0 - is_first[t][:, None]
            deter = rssm.core(CONFIG, dyn, Latent(keep * latent.deter, keep * latent.stoch), keep * actions[t])
            probs = rssm.posterior_probs(CONFIG, dyn, deter, tokens[t])
            index = dist.sample_index(jax.lax.stop_gradient(probs), uniform[t])
            latent = Latent(deter, dist.straight_through(probs, index).reshape(B, -1))
            total += jnp.sum(weigh[t] * latent.features()) + jnp.sum(jnp.square(probs))
        return total

    def fast(dyn, tokens):
        latent, probs = rssm.observe(CONFIG, dyn, garbage_start(), rssm.Sequences(actions, tokens, is_first, uniform))
        return jnp.sum(weigh * latent.features()) + jnp.sum(jnp.square(probs))

    expected = jax.jit(jax.value_and_grad(plain, argnums=(0, 1)))(params["dyn"], tokens)
    actual = jax.jit(jax.value_and_grad(fast, argnums=(0, 1)))(params["dyn"], tokens)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4), actual, expected)


@pytest.mark.quick
def test_identical_distributions_cost_exactly_the_free_nats():
    probs = dist.unimix_probs(jax.random.normal(KEY, (3, 4, 5)), 0.01)
    dyn, rep = world_model.kl_losses(CONFIG, probs, probs)
    total = CONFIG.dyn_scale * dyn + CONFIG.rep_scale * rep
    np.testing.assert_array_equal(total, np.full((3,), np.float32(1.1)))


@pytest.mark.quick
def test_free_nats_apply_to_the_sum_over_latents_of_each_step():
    p = jnp.stack([jnp.tile(jnp.array([0.9, 0.1]), (4, 1)), jnp.tile(jnp.array([0.5, 0.5]), (4, 1))])
    q = jnp.full_like(p, 0.5)
    each = 0.9 * np.log(1.8) + 0.1 * np.log(0.2)  # 0.37 per latent: below one nat alone, above it in sum
    dyn, _ = world_model.kl_losses(CONFIG, p, q)
    np.testing.assert_allclose(dyn, [4 * each, 1.0], rtol=1e-5)


def test_dynamics_loss_trains_the_prior_and_representation_loss_the_posterior():
    p, q = jnp.array([[[0.9, 0.1]] * 4]), jnp.array([[[0.2, 0.8]] * 4])
    for index, wanted in ((0, (False, True)), (1, (True, False))):
        gradients = jax.grad(lambda p, q, i=index: jnp.sum(world_model.kl_losses(CONFIG, p, q)[i]), (0, 1))(p, q)
        assert tuple(bool(np.any(g)) for g in gradients) == wanted


@pytest.mark.quick
def test_a_time_out_keeps_the_discount_and_a_terminal_ends_it():
    target = world_model.continue_target(dataclasses.replace(CONFIG, horizon=333.0), jnp.array([False, True]))
    np.testing.assert_allclose(target, [1 - 1 / 333, 0.0], rtol=1e-6)


@pytest.mark.quick
def test_large_actions_are_scaled_back_to_one(params):
    embedded = rssm.embed_action(params["dyn"], jnp.array([[3.0, 0.5], [1.0, 0.5]]), jnp.float32)
    np.testing.assert_allclose(embedded[0], embedded[1], rtol=1e-6)
