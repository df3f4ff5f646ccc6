"""The losses of actor and critic, as they are put together, against plain loops over the heads' outputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, tiny_config

from dreamer.layers import distributions as dist
from dreamer.model import agent, behavior, world_model
from dreamer.model.behavior import Outcome, ReturnNorm
from dreamer.model.rssm import Latent

CONFIG = tiny_config(imag_horizon=15)
M, T, B, A = 5, 6, 3, 2
NORM = ReturnNorm(jnp.array(-2.0), jnp.array(10.0))
KEY = jax.random.PRNGKey(3)


def lively(params, seed):
    """The same parameters with heads that answer differently in every state, with rewards and values around 1."""
    keys = iter(jax.random.split(jax.random.PRNGKey(seed), 4))
    hill = -0.5 * ((jnp.arange(CONFIG.bins) - 130.0) / 6) ** 2  # what lies far out is never predicted
    biases = {"reward": hill, "value": hill, "continue": jnp.full((1,), 2.0), "policy": jnp.zeros((2 * A,))}
    for name, bias in biases.items():
        shape = params[name]["out"]["w"].shape
        out = {"w": jax.random.normal(next(keys), shape), "b": bias}
        params = {**params, name: {**params[name], "out": out}}
    return params


@pytest.fixture(scope="module")
def params():
    shapes = jax.eval_shape(lambda: agent.init_params(CONFIG, SHAPE, A, KEY))
    rng = np.random.default_rng(0)
    some = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 0.3, jnp.float32), shapes)
    return lively(some, 1)


@pytest.fixture(scope="module")
def slow(params):
    return lively(params, 2)["value"]


def states(*batch):
    deter = jax.random.normal(jax.random.PRNGKey(4), (*batch, CONFIG.deter))
    index = jax.random.randint(jax.random.PRNGKey(5), (*batch, CONFIG.stoch), 0, CONFIG.classes)
    return Latent(deter, jax.nn.one_hot(index, CONFIG.classes).reshape(*batch, -1))


def expected_value(logits):
    """Mean of two-hot logits."""
    probs = np.exp(np.asarray(logits, np.float64))
    return (probs * dist.twohot_bins(CONFIG.bins)).sum(-1) / probs.sum(-1)


def surprise(logits, value):
    """Cross-entropy of two-hot logits (bins,) to a value, by the two bins around it."""
    bins = dist.twohot_bins(CONFIG.bins).astype(np.float64)
    below = np.searchsorted(bins, value, side="right") - 1
    share = (value - bins[below]) / (bins[below + 1] - bins[below])
    log_probs = np.asarray(logits, np.float64) - np.log(np.exp(np.asarray(logits, np.float64)).sum())
    return -(1 - share) * log_probs[below] - share * log_probs[below + 1]


def largest(tree):
    return max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(tree))


@pytest.fixture(scope="module")
def imagined(params, slow):
    """Gradients by parameters, slow critic and starts; and all that they come from."""

    def total(params, slow, start):
        losses, returns, norm, _ = behavior.imagination_loss(CONFIG, params, slow, NORM, start, KEY)
        rollout = behavior.imagine(CONFIG, params, start, KEY)
        heads = {name: world_model.head(params[name], rollout.features) for name in ("reward", "policy", "value")}
        heads["slow"] = world_model.head(slow, rollout.features)
        alive = jax.nn.sigmoid(world_model.head(params["continue"], rollout.features)[..., 0])
        loss = jnp.mean(losses["policy"]) + jnp.mean(losses["value"])
        return loss, (losses, returns, norm, rollout.features[0], rollout.actions, heads, alive)

    return jax.jit(jax.grad(total, (0, 1, 2), has_aux=True))(params, slow, states(M))


def test_imagination_trains_each_state_by_its_own_action_and_what_comes_after(imagined):
    losses, returns, norm, first, actions, heads, alive = jax.tree.map(np.asarray, imagined[1])
    np.testing.assert_array_equal(first, states(M).features())
    reward, value = expected_value(heads["reward"]), expected_value(heads["value"])
    assert np.std(reward) > 0.1 and np.std(value) > 0.1 and 0.3 < alive.min() < alive.max() < 0.99
    expected = [value[15]]
    for t in reversed(range(15)):  # the continue head holds the discount: nothing else discounts
        after = 0.05 * value[t + 1] + 0.95 * expected[0]
        expected.insert(0, reward[t + 1] + alive[t + 1] * after)
    expected = np.array(expected[:15])
    np.testing.assert_allclose(returns, expected[0], rtol=1e-4)
    low, high = -2.0 * 0.99 + 0.01 * np.quantile(expected, 0.05), 10.0 * 0.99 + 0.01 * np.quantile(expected, 0.95)
    np.testing.assert_allclose([norm.low, norm.high], [low, high], rtol=1e-4)
    mean = np.tanh(heads["policy"][..., :A])
    std = 0.9 / (1 + np.exp(-heads["policy"][..., A:] - 2.0)) + 0.1
    for m in range(M):
        weight = 1.0
        for t in range(15):
            weight *= alive[t, m]  # the root's own continue included
            z = (actions[t, m] - mean[t, m]) / std[t, m]
            log_prob = np.sum(-0.5 * z**2 - np.log(std[t, m] * np.sqrt(2 * np.pi)))
            entropy = np.sum(np.log(std[t, m] * np.sqrt(2 * np.pi * np.e)))
            advantage = (expected[t, m] - value[t, m]) / (high - low)  # of the state the action is taken in
            policy = -weight * (log_prob * advantage + CONFIG.entropy_scale * entropy)
            assert losses["policy"][t, m] == pytest.approx(policy, rel=1e-3, abs=1e-4)
            brake = surprise(heads["value"][t, m], expected_value(heads["slow"][t, m]))
            critic = weight * (surprise(heads["value"][t, m], expected[t, m]) + brake)
            assert losses["value"][t, m] == pytest.approx(critic, rel=1e-3)


def test_imagination_trains_policy_and_critic_and_nothing_else(imagined):
    gradients, slow_gradient, start_gradient = imagined[0]
    assert {name for name, gradient in gradients.items() if largest(gradient) > 0} == {"policy", "value"}
    assert largest(slow_gradient) == largest(start_gradient) == 0.0


@pytest.fixture(scope="module")
def replayed():
    """States, rewards, ends of three streams (a time-out, a terminal, none), and imagined returns."""
    reward, boot = jax.random.normal(KEY, (2, T, B)) * 2 + 1
    last = jnp.zeros((T, B), bool).at[2, 0].set(True).at[3, 1].set(True)
    return states(T, B), Outcome(reward, last, jnp.zeros((T, B), bool).at[3, 1].set(True)), boot


@pytest.fixture(scope="module")
def replay_learned(params, slow, replayed):
    """Gradients by parameters, slow critic, states and imagined returns; and losses with both critics' outputs."""
    latent, outcome, boot = replayed

    def total(params, slow, latent, boot):
        losses = behavior.replay_loss(CONFIG, params, slow, latent, outcome, boot)
        return jnp.mean(losses), (losses, [world_model.head(p, latent.features()) for p in (params["value"], slow)])

    return jax.jit(jax.grad(total, (0, 1, 2, 3), has_aux=True))(params, slow, latent, boot)


def test_the_replayed_critic_learns_from_real_rewards_and_imagined_returns(replayed, replay_learned):
    reward, last, terminal, boot = map(np.asarray, (*replayed[1], replayed[2]))
    losses, (logits, slow_logits) = jax.tree.map(np.asarray, replay_learned[1])
    assert losses.shape == (T - 1, B)
    discount = 1 - 1 / CONFIG.horizon
    for b in range(B):
        after = boot[T - 1, b]
        for t in reversed(range(T - 1)):
            live = 0.0 if terminal[t + 1, b] else discount
            mix = 0.0 if last[t + 1, b] else 0.95  # beyond an end lies another episode
            after = reward[t + 1, b] + live * ((1 - mix) * boot[t + 1, b] + mix * after)
            brake = surprise(logits[t, b], expected_value(slow_logits[t, b]))
            expected = 0.0 if last[t, b] else surprise(logits[t, b], after) + brake
            assert losses[t, b] == pytest.approx(expected, rel=1e-3), (t, b)


def test_the_replayed_critic_trains_the_states_too_but_neither_target(replay_learned):
    critic, slow_gradient, latent, boot = replay_learned[0]
    assert {name for name, gradient in critic.items() if largest(gradient) > 0} == {"value"}
    assert largest(latent) > 0.0  # so encoder and recurrent model learn what the value needs
    assert largest(slow_gradient) == largest(boot) == 0.0
