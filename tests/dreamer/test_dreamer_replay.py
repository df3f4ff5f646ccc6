import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import echo_env, tiny_config

from dreamer.experience import iteration, replay
from dreamer.model import optim, world_model
from dreamer.model.rssm import Latent
from dreamer.types import Mirror, Transition

N, T = 3, 4
CONFIG = tiny_config(batch_size=6, batch_length=T, replay_capacity=20 * N)
SHAPE = (2, 2, 1)


def written(rows, config=CONFIG):
    """A memory after `rows` steps; the action of step t in stream n is t + n / 10, the latent's deter alike."""
    def one(memory, t):
        name = t + jnp.arange(N) / 10
        transition = Transition(
            obs=jnp.broadcast_to(t.astype(jnp.uint8), (N, *SHAPE)), reward=name, is_first=jnp.full((N,), t % 7 == 0),
            is_last=jnp.full((N,), t % 7 == 6), is_terminal=jnp.full((N,), t % 14 == 6), metrics={},
        )
        deter = jnp.broadcast_to(name[:, None], (N, config.deter))
        stoch = jax.nn.one_hot(jnp.broadcast_to(t % config.classes, (N, config.stoch)), config.classes)
        latent = Latent(deter, stoch.reshape(N, -1))
        return replay.write(config, memory, transition, name[:, None], latent), None

    memory = replay.init(config, N, SHAPE, 1)
    return jax.jit(lambda: jax.lax.scan(one, memory, jnp.arange(rows))[0])()


@jax.jit
def draw(memory, key):
    return replay.sample(CONFIG, memory, key)


@pytest.mark.parametrize("rows", [6, 20, 33, 57])
def test_sampled_steps_are_consecutive_steps_of_one_stream(rows):
    memory = written(rows)
    for seed in range(20):
        memory, batch, window = draw(memory, jax.random.PRNGKey(seed))
        step, stream = np.asarray(batch.reward) // 1, np.asarray(batch.reward) % 1 * 10
        np.testing.assert_array_equal(np.diff(step, axis=0), 1.0)  # never across the write head
        np.testing.assert_allclose(stream, np.broadcast_to(np.asarray(window.stream), stream.shape), atol=1e-3)
        assert step.min() >= max(rows - 20, 0) + 1 and step.max() <= rows - 1
        np.testing.assert_allclose(batch.prev_action[..., 0], batch.reward - 1.0, atol=1e-5)
        np.testing.assert_array_equal(batch.obs[..., 0, 0, 0], step)
        np.testing.assert_array_equal(batch.is_first, step % 7 == 0)
        np.testing.assert_array_equal(batch.is_last, step % 7 == 6)
        np.testing.assert_array_equal(batch.is_terminal, step % 14 == 6)


def test_the_start_is_the_stored_latent_of_the_step_before():
    memory = written(33)
    _, batch, _ = draw(memory, jax.random.PRNGKey(0))
    before = np.asarray(batch.reward[0]) - 1.0
    np.testing.assert_allclose(batch.start.deter, np.repeat(before[:, None], CONFIG.deter, 1), atol=1e-5)
    classes = np.asarray(batch.start.stoch).reshape(6, CONFIG.stoch, CONFIG.classes).argmax(-1)
    np.testing.assert_array_equal(classes, np.repeat((before.round(1) // 1 % CONFIG.classes)[:, None], CONFIG.stoch, 1))


def test_without_stored_latents_sequences_begin_as_episodes_do_and_are_the_same_otherwise():
    memory, key = written(33), jax.random.PRNGKey(0)
    plain = replay.sample(CONFIG, memory, key)[1]
    found = replay.sample(dataclasses.replace(CONFIG, stored_latents=False), memory, key)[1]
    assert not np.asarray(found.start.deter).any() and not np.asarray(found.start.stoch).any()
    jax.tree.map(np.testing.assert_array_equal, found, dataclasses.replace(plain, start=found.start))


def test_refreshed_latents_replace_the_stored_ones_and_nothing_else():
    memory = written(33)
    _, batch, window = draw(memory, jax.random.PRNGKey(0))
    index = jnp.full((T, 6, CONFIG.stoch), 3)
    fresh = Latent(jnp.full((T, 6, CONFIG.deter), -1.0), jax.nn.one_hot(index, CONFIG.classes).reshape(T, 6, -1))
    after = replay.write_back(CONFIG, memory, window, fresh)
    touched = np.zeros(memory.reward.shape, bool)
    touched[np.asarray(window.row[1:]), np.asarray(window.stream)] = True
    np.testing.assert_array_equal(np.asarray(after.deter[..., 0] == -1.0), touched)
    assert np.all(np.asarray(after.stoch)[touched] == 3)
    np.testing.assert_array_equal(np.asarray(after.stoch)[~touched], np.asarray(memory.stoch)[~touched])
    np.testing.assert_array_equal(after.action, memory.action)


def test_fresh_sequences_come_first_once_each_and_without_overlap():
    memory = replay.init(CONFIG, N, SHAPE, 1)
    taken = []
    for rows in (T + 1, 2 * T + 1, 3 * T + 1):  # a generation of N sequences is complete at each of these
        memory = dataclasses.replace(written(rows), online_next=memory.online_next)
        memory, batch, _ = draw(memory, jax.random.PRNGKey(0))
        taken.append(np.asarray(batch.reward)[:, :N])
    expected = sorted(t + n / 10 for t in range(1, 3 * T + 1) for n in range(N))
    np.testing.assert_allclose(np.sort(np.concatenate(taken, None)), expected, atol=1e-5)
    draws = [np.asarray(draw(memory, jax.random.PRNGKey(seed))[2].row) for seed in (1, 2)]
    assert np.any(draws[0] != draws[1])  # the queue is empty: random from here on


def test_an_overfull_queue_keeps_its_newest_generation():
    memory = written(4 * T + 1)
    _, batch, _ = draw(memory, jax.random.PRNGKey(0))
    fresh = np.asarray(batch.reward)[0, :N] // 1
    assert set(fresh) <= {2 * T + 1.0, 3 * T + 1.0}


def test_uniform_draws_reach_every_position_and_stream():
    config = dataclasses.replace(CONFIG, online=False)
    memory = written(33, config)
    sample = jax.jit(lambda k: replay.sample(config, memory, k)[2])
    windows = [sample(jax.random.PRNGKey(seed)) for seed in range(60)]
    pairs = {(int(r), int(s)) for w in windows for r, s in zip(w.row[0], w.stream, strict=True)}
    assert len(pairs) == (20 - T) * N


@pytest.mark.quick
def test_too_small_a_memory_names_the_size_it_needs():
    with pytest.raises(ValueError, match="replay_capacity = 20 .*Raise it to 36"):
        replay.rows_for(dataclasses.replace(CONFIG, replay_capacity=20), 4)


def test_the_model_foresees_the_frame_from_the_right_action_and_not_from_a_shuffled_one():
    """The frame shows the previous action: with the true pairing nothing is left to learn from it."""
    env = echo_env(8)
    config = tiny_config(
        learning_starts=10**6, replay_capacity=1600, free_nats=0.0, lr=3e-3, warmup=0, rep_scale=1.0, online=False
    )

    def collect(state, key):
        return iteration.collect(env, config, state, key)[0], None

    def fit(shuffled):
        state = iteration.init_state(env, config, 0)
        state, _ = jax.lax.scan(collect, state, jax.random.split(jax.random.PRNGKey(1), 150))

        def learn(carry, key):
            params, opt = carry
            sample_key, loss_key, shuffle_key = jax.random.split(key, 3)
            _, batch, _ = replay.sample(config, state.replay, sample_key)
            mixed = jax.random.permutation(shuffle_key, batch.prev_action.reshape(-1, 1)).reshape(-1, 4, 1)
            batch = dataclasses.replace(batch, prev_action=jnp.where(shuffled, mixed, batch.prev_action))

            def loss(params):
                losses, _, metrics = world_model.loss(config, params, batch, loss_key)
                return sum(jnp.mean(x) for x in losses.values()), (metrics["kl"], jnp.mean(losses["recon"]))

            gradients, watched = jax.grad(loss, has_aux=True)(params)
            return optim.update(config, params, gradients, opt), watched

        start = (state.agent.params, state.agent.opt)
        return jax.lax.scan(learn, start, jax.random.split(jax.random.PRNGKey(2), 600))[1]

    fit = jax.jit(fit)
    (kl, recon), (mixed_kl, _) = fit(False), fit(True)
    assert np.mean(kl[-50:]) < 0.1
    assert np.mean(recon[-50:]) < 5.0  # of about 190 for a grey guess
    assert np.mean(mixed_kl[-50:]) > 0.4  # a coin's entropy is 0.69 nat


def test_the_mirror_fills_a_second_stream_of_each_instance_and_counts_for_nothing():
    plain_env = echo_env(2)
    mirror = Mirror(lambda state, obs, worlds: 255 - obs[None], lambda action, worlds: -action[None])
    env = dataclasses.replace(plain_env, mirror=mirror)
    config = tiny_config(mirror=1, learning_starts=0)
    with pytest.raises(ValueError, match="has no mirror"):
        iteration.init_state(plain_env, config, 0)
    step = jax.jit(lambda state: iteration.train_iteration(env, config, state))
    state, updates = iteration.compile_init(env, config, 0)(), 0
    for _ in range(14):
        state, metrics = step(state)
        updates += int(metrics["updates"])
    rows = int(state.replay.written)
    assert rows == 14 and state.replay.reward.shape[1] == 4 and int(state.env_steps) == 28
    assert state.replay.reward.shape[0] == replay.rows_for(config, 2)  # the same time back as without
    real, mirrored = (jax.tree.map(lambda x: np.asarray(x[:rows]), columns(state.replay, part))
                      for part in (slice(0, 2), slice(2, 4)))  # fmt: skip
    np.testing.assert_array_equal(mirrored["action"], -real["action"])
    np.testing.assert_array_equal(mirrored["obs"], 255 - real["obs"])
    assert np.abs(real["action"]).max() > 0.1
    for name in ("reward", "is_first", "is_last", "is_terminal"):
        np.testing.assert_array_equal(mirrored[name], real[name])
    gain, price = iteration.credit_rates(config, 2)
    assert updates == (14 - config.batch_length) * gain // price


def test_each_world_of_the_mirror_has_a_stream_of_its_own():
    mirror = Mirror(
        lambda state, obs, worlds: jnp.stack([obs // 4 + 50 * (1 + i) for i in range(worlds)]),
        lambda action, worlds: jnp.stack([action / (1 + i) for i in range(worlds)]), worlds=2,
    )  # fmt: skip
    env = dataclasses.replace(echo_env(2), mirror=mirror)
    with pytest.raises(ValueError, match="mirror = 3, .* more than 2 other worlds"):
        iteration.init_state(env, tiny_config(mirror=3), 0)
    config = tiny_config(mirror=2, learning_starts=0)
    step = jax.jit(lambda state: iteration.train_iteration(env, config, state))
    state = iteration.compile_init(env, config, 0)()
    for _ in range(8):
        state, _ = step(state)
    real, one, other = (jax.tree.map(lambda x: np.asarray(x[:8]), columns(state.replay, slice(i, i + 2)))
                        for i in (0, 2, 4))  # fmt: skip
    np.testing.assert_array_equal(one["obs"], real["obs"] // 4 + 50)
    np.testing.assert_array_equal(other["obs"], real["obs"] // 4 + 100)
    np.testing.assert_array_equal(other["action"], one["action"] / 2)
    np.testing.assert_array_equal(one["action"], real["action"])


def columns(memory, part):
    """Fields of some streams of a replay."""
    names = ("obs", "action", "reward", "is_first", "is_last", "is_terminal")
    return {name: getattr(memory, name)[:, part] for name in names}
