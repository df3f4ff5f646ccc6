"""Observations drawn anew for each update, from what the replay holds of the steps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, corridor_env, echo_env, tiny_config, with_redraw

from dreamer.experience import iteration, redraw, replay
from dreamer.train import TrainingOptions, train
from dreamer.types import Mirror

QUIET = TrainingOptions(progress=False, log_every_s=1e9, checkpoint_every_s=1e9)


def after(env, config, iterations):
    step = jax.jit(lambda state: iteration.train_iteration(env, config, state))
    state = iteration.compile_init(env, config, 0)()
    for _ in range(iterations):
        state, _ = step(state)
    return state


def test_a_sequence_looks_alike_throughout_and_like_no_other_and_mirrored_streams_are_mirrored():
    mirror = Mirror(lambda state, obs, worlds: 255 - obs[None], lambda action, worlds: -action[None])
    env = dataclasses.replace(with_redraw(echo_env(2)), mirror=mirror)
    config = tiny_config(mirror=1, redraw=True, learning_starts=10**6)
    state = after(env, config, 20)
    held = state.replay.obs
    assert held.shape == (replay.rows_for(config, 2), 4) and held.dtype == jnp.float32  # numbers, no images
    np.testing.assert_array_equal(held[:, :2], held[:, 2:])

    @jax.jit
    def batch_of(key):
        _, batch, window = replay.sample(config, state.replay, key)
        return batch, window, redraw.drawn(env, config, batch, key), redraw.drawn(env, config, batch, key + 1)

    sides = set()
    for seed in range(6):
        batch, window, obs, again = jax.device_get(batch_of(jax.random.PRNGKey(seed)))
        mirrored = window.stream >= 2
        assert obs.shape == (config.batch_length, config.batch_size, *SHAPE) and obs.dtype == np.uint8
        plain = np.where(mirrored[:, None, None, None], 255 - obs, obs)
        np.testing.assert_array_equal(plain[..., 0, 0, 0] >= 128, batch.obs > 0.5)  # the moment is the one that is held
        paint = plain[..., 0, 0, 0] % 128
        assert (paint == paint[0]).all() and len(set(paint[0])) == config.batch_size  # one paint a sequence
        assert (np.asarray(again) != obs).any()
        action = np.where(mirrored, -1, 1) * np.sign(batch.prev_action[..., 0])
        np.testing.assert_array_equal(action[1:] > 0, batch.obs[1:] > 0.5)  # the echo of the action, in either world
        sides |= set(mirrored)
    assert sides == {True, False}


def test_a_training_that_redraws_learns_goes_on_after_a_stop_and_repeats_itself(tmp_path):
    env = with_redraw(corridor_env(4))
    config = tiny_config(redraw=True, pretrain_steps=48, pretrain_updates=4)
    whole = train(env, config, tmp_path / "whole", 160, 3, QUIET)
    train(env, config, tmp_path / "parts", 80, 3, QUIET)
    parts = train(env, config, tmp_path / "parts", 160, 3, QUIET)
    assert whole.updates > 0
    jax.tree.map(np.testing.assert_array_equal, whole.agent.params, parts.agent.params)
    first = jax.jit(lambda: iteration.init_state(env, config, 3))().agent.params["enc"]
    moved = jax.tree.map(lambda a, b: float(np.abs(np.asarray(a) - b).max()), whole.agent.params["enc"], first)
    assert max(jax.tree.leaves(moved)) > 1e-4


@pytest.mark.parametrize("env, changes, said", [
    (corridor_env(2), dict(redraw=True), "cannot be drawn anew.*Give one, or set it to false"),
    (with_redraw(corridor_env(2)), dict(redraw=True, mirror=2), "mirror = 2: with redraw.*Set mirror to 1"),
    (with_redraw(corridor_env(2)), dict(redraw=True, replay_memory="host"), "'host': with redraw.*Leave it at 'auto'"),
])  # fmt: skip
def test_what_cannot_be_redrawn_is_refused(env, changes, said):
    with pytest.raises(ValueError, match=said):
        iteration.check_fit(env, tiny_config(**changes))


def test_what_would_fill_the_device_is_refused(monkeypatch):
    env, config = with_redraw(corridor_env(2)), tiny_config(redraw=True)
    asked = []
    monkeypatch.setattr(redraw.host_replay, "fits", lambda size, device: asked.append(size) or False)
    with pytest.raises(ValueError, match="4 bytes of each step.*Lower replay_capacity"):
        iteration.init_state(env, config, 0)
    assert asked == [4 * config.replay_capacity // jax.device_count()]
    by_hand = iteration.init_state(env, dataclasses.replace(config, replay_memory="device"), 0)
    assert by_hand.replay.obs.dtype == jnp.float32 and len(asked) == 1
