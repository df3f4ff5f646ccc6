"""A replay in the host's memory gives what one on the device gives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import corridor_env, tiny_config

from dreamer.experience import host_replay, replay
from dreamer.model.rssm import Latent
from dreamer.train import TrainingOptions, train
from dreamer.types import Transition

ENV = corridor_env(4)
CONFIG = tiny_config(replay_capacity=200)  # 50 rows: the ring turns over
QUIET = TrainingOptions(progress=False, log_every_s=0.0, checkpoint_every_s=1e9)
SHAPE = {"camera": (64, 64, 3), "speeds": (5,)}


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def batches(config, count):
    """A memory after `count` rows, and the batch drawn after each of them, whose latents are written back."""
    streams = 3

    def step(memory, i):
        keys = jax.random.split(jax.random.fold_in(jax.random.PRNGKey(0), i), 6)
        flag = jax.random.bernoulli(keys[0], 0.2, (streams,))
        seen = Transition(
            obs={"camera": jax.random.bits(keys[1], (streams, *SHAPE["camera"]), jnp.uint8),
                 "speeds": jax.random.normal(keys[2], (streams, *SHAPE["speeds"]))},
            reward=jax.random.normal(keys[3], (streams,)), is_first=flag, is_last=~flag, is_terminal=flag, metrics={},
        )  # fmt: skip
        latent = Latent(jnp.full((streams, config.deter), i, jnp.float32), jnp.ones((streams, config.stoch_size)))
        memory = replay.write(config, memory, seen, jnp.full((streams, 2), i, jnp.float32), latent)
        memory, batch, window = replay.sample(config, memory, keys[4])
        refreshed = Latent(
            jax.random.normal(keys[5], (*batch.reward.shape, config.deter)),
            jnp.ones((*batch.reward.shape, config.stoch_size)),
        )
        return replay.write_back(config, memory, window, refreshed), (batch, window)

    memory = replay.init(config, streams, SHAPE, 2)
    return jax.jit(lambda memory: jax.lax.scan(step, memory, jnp.arange(count)))(memory)


@pytest.mark.parametrize("online", [True, False])
def test_batches_queues_and_latents_are_those_of_a_memory_on_the_device_bit_for_bit(online):
    config = dataclasses.replace(CONFIG, replay_capacity=60, online=online)  # 20 rows, written 2.5 times over
    there, drawn_there = batches(dataclasses.replace(config, replay_memory="host"), 50)
    here, drawn_here = batches(dataclasses.replace(config, replay_memory="device"), 50)
    assert_equal(drawn_there, drawn_here)
    assert_equal(there.obs.store.frames, here.obs)
    assert_equal(dataclasses.replace(there, obs=None), dataclasses.replace(here, obs=None))
    assert int(there.obs.order) == 100  # one call to write and one to read for each row


@pytest.fixture
def small_device(monkeypatch):
    monkeypatch.setattr(host_replay, "fits", lambda obs_bytes, device: obs_bytes < 50 * 4 * 16 * 16 * 3)


@pytest.mark.long
def test_a_run_on_too_small_a_device_goes_on_from_its_checkpoint_bit_for_bit(small_device, tmp_path, capsys):
    straight = train(ENV, CONFIG, tmp_path / "straight", 300, 0, QUIET)
    assert "kept in the host's" in capsys.readouterr().err
    train(ENV, CONFIG, tmp_path / "cut", 240, 0, QUIET)
    resumed = train(ENV, CONFIG, tmp_path / "cut", 300, 0, QUIET)
    assert resumed.updates == straight.updates > 100
    assert_equal(resumed.agent, straight.agent)


def test_half_of_the_device_is_left_to_everything_else():
    class Small:
        def memory_stats(self):
            return {"bytes_limit": 1000}

    assert host_replay.fits(500, Small()) and not host_replay.fits(501, Small())


def test_several_seeds_keep_their_memory_on_the_device(tmp_path):
    with pytest.raises(ValueError, match="belongs to one seed on one device"):
        train(ENV, dataclasses.replace(CONFIG, replay_memory="host"), tmp_path, 8, (0, 1), QUIET)
