import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, tiny_config

from dreamer.layers import distributions as dist
from dreamer.model import agent, behavior, rssm, world_model
from dreamer.model.behavior import ReturnNorm

CONFIG = tiny_config(imag_horizon=15)
M = 4
NORM = ReturnNorm(jnp.zeros(()), jnp.zeros(()))


@pytest.mark.quick
def test_lambda_return_equals_three_steps_by_hand():
    reward, live = jnp.array([9.0, 1.0, 2.0, 3.0]), jnp.array([9.0, 0.5, 0.9, 0.8])
    mix, value = jnp.full((4,), 0.6), jnp.array([9.0, 10.0, 20.0, 30.0])
    r2 = 3.0 + 0.8 * 30.0  # 27
    r1 = 2.0 + 0.9 * (0.4 * 20.0 + 0.6 * r2)  # 23.78
    r0 = 1.0 + 0.5 * (0.4 * 10.0 + 0.6 * r1)  # 10.134
    np.testing.assert_allclose(behavior.lambda_return(reward, live, mix, value), [r0, r1, r2], rtol=1e-6)
    assert r0 == pytest.approx(10.134)


@pytest.mark.parametrize("unroll", [1, 8])
def test_lambda_return_equals_a_plain_loop(unroll):
    reward, live, mix, value = np.random.default_rng(0).uniform(size=(4, 33, 5))
    expected = [value[-1]]
    for t in reversed(range(32)):
        after = (1 - mix[t + 1]) * value[t + 1] + mix[t + 1] * expected[0]
        expected.insert(0, reward[t + 1] + live[t + 1] * after)
    actual = behavior.lambda_return(*map(jnp.asarray, (reward, live, mix, value)), unroll)
    np.testing.assert_allclose(actual, expected[:-1], atol=1e-6)


@pytest.mark.quick
def test_reward_one_for_ever_is_worth_the_horizon():
    live = jnp.full((16,), CONFIG.discount)  # what the continue head learns; nothing else may discount

    def sweep(_, value):
        return jnp.full((16,), behavior.lambda_return(jnp.ones((16,)), live, jnp.full((16,), 0.95), value)[0])

    value = jax.jit(lambda: jax.lax.fori_loop(0, 400, sweep, jnp.zeros((16,))))()
    assert float(value[0]) == pytest.approx(333.0, rel=1e-3)


def constant_continue(params, probability):
    """The same agent with a continue head that always answers `probability`."""
    out = params["continue"]["out"]
    bias = jnp.full_like(out["b"], np.log(probability / (1 - probability)))
    head = {**params["continue"], "out": {"w": jnp.zeros_like(out["w"]), "b": bias}}
    return {**params, "continue": head}


@pytest.fixture(scope="module")
def agent_state():
    return jax.jit(lambda: agent.init_agent(CONFIG, SHAPE, 2, jax.random.PRNGKey(0)))()


@pytest.fixture(scope="module")
def imagination(agent_state):
    """Losses, returns and gradients of the policy's loss, on an agent that goes on with probability 0.7."""
    params = constant_continue(agent_state.params, 0.7)
    # A reward head and critic that are not flat: otherwise every advantage is zero.
    for name in ("reward", "value"):
        out = params[name]["out"]
        weight = 0.3 * jax.random.normal(jax.random.PRNGKey(2), out["w"].shape)
        params = {**params, name: {**params[name], "out": {**out, "w": weight}}}
    start = rssm.initial(CONFIG, M)

    def policy_loss(params, slow):
        losses, returns, norm, metrics = behavior.imagination_loss(
            CONFIG, params, slow, NORM, start, jax.random.PRNGKey(3)
        )
        return jnp.mean(losses["policy"]), (losses, returns, norm)

    return jax.jit(jax.grad(policy_loss, has_aux=True))(params, agent_state.slow_value)


def test_the_policy_gradient_touches_the_policy_alone(imagination):
    gradients, _ = imagination
    for name, gradient in gradients.items():
        largest = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(gradient))
        assert (largest > 0) == (name == "policy"), name


def test_imagination_has_sixteen_states_and_fifteen_returns(agent_state, imagination):
    rollout = jax.eval_shape(
        lambda p: dataclasses.astuple(behavior.imagine(CONFIG, p, rssm.initial(CONFIG, M), jax.random.PRNGKey(3))),
        agent_state.params,
    )
    assert rollout[0].shape == (16, M, CONFIG.deter + CONFIG.stoch_size)
    assert rollout[1].shape == (16, M, 2)
    losses = imagination[1][0]
    assert losses["policy"].shape == losses["value"].shape == (15, M)


def test_losses_are_weighted_by_the_continues_from_the_root_on(agent_state):
    params = constant_continue(agent_state.params, 0.7)
    # Both critics are arguments: jaxlib 0.10.2 on a CPU reads foreign memory where a softmax follows a product with a
    # matrix that is known to be zero when it compiles (NaN in every other program).
    losses, returns, _, _ = jax.jit(
        lambda p, slow: behavior.imagination_loss(
            CONFIG, p, slow, NORM, rssm.initial(CONFIG, M), jax.random.PRNGKey(3)
        )
    )(params, agent_state.slow_value)
    np.testing.assert_array_equal(returns, 0.0)  # reward and value heads are exactly zero at the start
    weight = 0.7 ** np.arange(1, 16)  # the root's own continue included
    expected = weight * 2.0 * np.log(255.0)  # flat critic against return and slow critic
    np.testing.assert_allclose(losses["value"], np.repeat(expected[:, None], M, 1), rtol=1e-4)


@pytest.mark.parametrize("paying", [1.0, -1.0])
def test_a_bandit_in_imagination_moves_the_policy_towards_what_pays(paying):
    action = jax.random.normal(jax.random.PRNGKey(0), (2, 4096, 1))  # states 0 and 1; only action 0 has an outcome
    reward = jnp.stack([-5.0 * paying * action[0, :, 0], paying * action[0, :, 0]])  # index 0: earned before
    live = jnp.stack([jnp.full((4096,), 0.5), jnp.zeros((4096,))])
    returns = behavior.lambda_return(reward, live, jnp.full_like(live, 0.95), jnp.zeros_like(live))
    weight = jnp.cumprod(live, 0)[:-1]

    def loss(mean):
        means = jnp.full((1, 4096, 1), mean)
        log_prob = dist.normal_log_prob(means, jnp.ones_like(means), action[:1])
        return jnp.mean(behavior.actor_loss(CONFIG, log_prob, jnp.zeros_like(log_prob), returns, weight))

    # d log pi / d mean = a, the advantage is +-a: the gradient is -+ weight * E[a^2], with the root's weight 0.5.
    assert float(jax.grad(loss)(0.0)) == pytest.approx(-0.5 * paying, abs=0.05)


def test_entropy_alone_widens_the_policy():
    std = jnp.full((1, 8, 1), 0.5)
    zeros, ones = jnp.zeros((1, 8)), jnp.ones((1, 8))

    def loss(std):
        return jnp.sum(behavior.actor_loss(CONFIG, zeros, dist.normal_entropy(std), zeros, ones))

    gradient = jax.grad(loss)(std)
    np.testing.assert_allclose(gradient, -CONFIG.entropy_scale / 0.5, rtol=1e-5)


def test_a_mean_in_saturation_is_pulled_back_where_every_action_pays_the_same(agent_state):
    out = agent_state.params["policy"]["out"]
    far = {**out, "b": out["b"].at[0].set(-5.0)}  # tanh(-5): nothing leads back, all rewards are 0
    params = {**agent_state.params, "policy": {**agent_state.params["policy"], "out": far}}

    def bias_gradient(pull):
        config = dataclasses.replace(CONFIG, mean_pull=pull, entropy_scale=0.0)

        def loss(params):
            start, key = rssm.initial(config, M), jax.random.key(3)
            losses, *_ = behavior.imagination_loss(config, params, agent_state.slow_value, NORM, start, key)
            return jnp.mean(losses["policy"])

        return jax.jit(jax.grad(loss))(params)["policy"]["out"]["b"]

    np.testing.assert_allclose(bias_gradient(0.0), 0.0, atol=1e-9)
    pulled = bias_gradient(0.01)
    assert pulled[0] < 0  # descending it raises the mean
    np.testing.assert_allclose(pulled[2:], 0.0, atol=1e-9)  # the deviations are left alone


@pytest.mark.quick
def test_small_returns_are_not_blown_up_and_large_ones_are_scaled_down():
    returns = jnp.linspace(0.0, 1000.0, 1001)[None]
    norm = NORM
    for _ in range(2):
        norm = behavior.update_return_norm(CONFIG, norm, returns)
    np.testing.assert_allclose(norm.high, 950 * (1 - 0.99**2), rtol=1e-4)
    np.testing.assert_allclose(norm.scale(), 900 * (1 - 0.99**2), rtol=1e-4)
    assert float(ReturnNorm(jnp.array(0.1), jnp.array(0.2)).scale()) == 1.0


def test_reward_and_value_are_exactly_zero_before_training(agent_state):
    features = jax.random.normal(jax.random.PRNGKey(5), (6, CONFIG.deter + CONFIG.stoch_size))
    np.testing.assert_array_equal(world_model.predict_reward(agent_state.params, features), 0.0)
    value = behavior.dist.twohot_mean(world_model.head(agent_state.params["value"], features))
    np.testing.assert_array_equal(value, 0.0)


def test_replayed_returns_stop_at_terminals_and_bootstrap_at_time_outs():
    reward, boot = jnp.array([0.0, 1.0, 1.0, 1.0]), jnp.full((4,), 50.0)
    is_last = jnp.array([0.0, 0.0, 1.0, 0.0])
    mix = 0.95 * (1 - is_last)
    for terminal, expected in ((1.0, 1.0), (0.0, 1.0 + CONFIG.discount * 50.0)):
        live = CONFIG.discount * (1 - terminal * is_last)
        returns = behavior.lambda_return(reward, live, mix, boot)
        assert float(returns[1]) == pytest.approx(expected)
