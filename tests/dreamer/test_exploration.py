"""How training acts: noise with a memory, its distribution and where it acts, and instances without any."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import choice_env, corridor_env, tiny_config

from dreamer import spaces
from dreamer.experience import exploration, iteration
from dreamer.model import world_model
from dreamer.model.rssm import Latent

INSTANCES, WIDTH, STEPS = 8, 512, 60
CONFIG = tiny_config(noise_steps=20.0)


@pytest.fixture(scope="module")
def drawn():
    """Noise of every step, (steps, instances, width)."""

    def step(noise, key):
        noise = exploration.advance(CONFIG, noise, key)
        return noise, noise

    start = exploration.init(CONFIG, INSTANCES, WIDTH, jax.random.key(0))
    return np.asarray(jax.lax.scan(step, start, jax.random.split(jax.random.key(1), STEPS))[1])


def test_every_step_is_a_unit_normal(drawn):
    np.testing.assert_allclose(drawn.std((0, 2)), 1.0, atol=0.05)
    assert abs(drawn[-1].mean()) < 0.06


def test_time_constants_go_in_equal_ratios_from_one_step_to_the_longest(drawn):
    found = (drawn[1:] * drawn[:-1]).mean((0, 2))
    np.testing.assert_allclose(found, np.exp(-1.0 / 20.0 ** np.linspace(0, 1, INSTANCES)), atol=0.06)
    assert float(exploration.correlations(CONFIG, 1)[0, 0]) == pytest.approx(np.exp(-1 / 20))


def test_random_actions_are_uniform(drawn):
    actions = np.asarray(exploration.uniform(drawn))
    np.testing.assert_allclose(np.quantile(actions, [0.0, 0.25, 0.5, 0.75, 1.0]), [-1, -0.5, 0, 0.5, 1], atol=0.05)


def test_what_integrates_random_actions_gets_several_times_as_far(drawn):
    reached = np.asarray(exploration.uniform(drawn)).sum(0).std(-1)  # of each instance
    assert reached[-1] > 3.5 * np.sqrt(STEPS / 3)  # independent uniform actions: sqrt(steps / 3)


def test_actions_before_learning_are_this_noise_mirrored_ones_follow():
    env = corridor_env(4)
    state = jax.jit(lambda: iteration.init_state(env, CONFIG, 0))()
    after, _ = jax.jit(lambda state: iteration.collect(env, CONFIG, state, jax.random.key(3)))(state)
    np.testing.assert_array_equal(after.carry["action"], exploration.uniform(after.noise))
    assert np.any(np.asarray(after.noise) != np.asarray(state.noise))


def test_the_policy_is_sampled_with_this_noise():
    env = corridor_env(4)
    state = jax.jit(lambda: iteration.init_state(env, CONFIG, 0))()
    learning = jax.tree.map(jnp.copy, state).replace(env_steps=jnp.int32(CONFIG.learning_starts))
    after, _ = jax.jit(lambda state: iteration.collect(env, CONFIG, state, jax.random.key(3)))(learning)
    centred = np.asarray(after.carry["action"] / after.noise)  # an untrained policy's mean is near zero
    np.testing.assert_allclose(centred, np.median(centred), rtol=0.1)


def test_without_a_time_constant_there_is_no_noise_to_keep():
    assert jax.eval_shape(lambda: iteration.init_state(corridor_env(2), tiny_config(), 0)).noise is None


def test_classes_and_too_short_memories_are_refused():
    with pytest.raises(ValueError, match=r"noise_steps = 20.*only continuous actions.*Set it to 0"):
        iteration.init_state(choice_env(2), CONFIG, 0)
    with pytest.raises(ValueError, match="noise_steps = 0.5"):
        tiny_config(noise_steps=0.5)


@pytest.mark.parametrize("make_env", [corridor_env, choice_env])
def test_greedy_instances_act_as_evaluations_do_once_learning_has_begun(make_env):
    """Two of eight."""
    env, config = make_env(8), tiny_config(greedy_share=0.2)
    state = jax.jit(lambda: iteration.init_state(env, config, 0))()
    collect = jax.jit(lambda state: iteration.collect(env, config, state, jax.random.key(3))[0].carry)
    kind = spaces.actions(env.action_dim)

    def best(state):  # of each instance: is its action the most probable one of the state that it has inferred?
        carry, policy = collect(state), state.agent.params["policy"]
        features = Latent(carry["deter"], carry["stoch"]).features()
        action = np.asarray(kind.mode(config, world_model.head(policy, features)))
        return np.all(np.isclose(carry["action"], action, atol=1e-6), axis=1).tolist()

    learning = jax.tree.map(jnp.copy, state).replace(env_steps=jnp.int32(config.learning_starts))
    assert best(learning)[6:] == [True, True] and not all(best(learning)[:6])
    assert not all(best(state)[6:])  # the first steps are random everywhere


def test_a_share_rounds_up_and_leaves_noise_somewhere():
    assert exploration.greedy(tiny_config(), 16) is None
    assert int(exploration.greedy(tiny_config(greedy_share=0.25), 16).sum()) == 4
    assert int(exploration.greedy(tiny_config(greedy_share=0.01), 16).sum()) == 1
    with pytest.raises(ValueError, match=r"greedy_share = 1.0.*below 1"):
        tiny_config(greedy_share=1.0)
