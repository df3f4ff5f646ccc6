"""Observations drawn anew for each update, from what the replay holds of the steps (`dreamer.types.Redraw`).

A network that sees the same pictures again and again learns them by heart. Where drawing is cheap, none needs to be
seen twice: one drive is learned in as many rooms as there are updates on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dreamer.config import DreamerConfig
from dreamer.experience import host_replay
from dreamer.experience.replay import Batch
from dreamer.training import parallel
from dreamer.types import EnvState, FunctionalEnv, Transition


def check(env: FunctionalEnv, config: DreamerConfig) -> None:
    """Raise ValueError where the configuration asks for what the environment cannot draw."""
    if not config.redraw:
        return
    if env.redraw is None:
        raise ValueError("DreamerConfig.redraw is true, but this environment's observations cannot be drawn anew: it "
                         "has no FunctionalEnv.redraw (whill_mjx has one where looks are drawn at random, and no "
                         "sensors observe). Give one, or set it to false.")
    if config.mirror > 1:
        raise ValueError(f"DreamerConfig.mirror = {config.mirror}: with redraw, every update sees other looks, and the "
                         "mirror shows one other world. Set mirror to 1 or 0.")
    if config.replay_memory == "host":
        raise ValueError("DreamerConfig.replay_memory = 'host': with redraw the replay holds no images, and stays on "
                         "the device. Leave it at 'auto'.")


def kept(env: FunctionalEnv, config: DreamerConfig, env_state: EnvState, transition: Transition) -> Any:
    """What the replay holds of a step in place of its observations, (N, ...); None: the observations themselves."""
    if not config.redraw:
        return None
    assert env.redraw is not None
    return env.redraw.keep(env_state, transition.obs)


def check_memory(env: FunctionalEnv, config: DreamerConfig, held: Any) -> None:
    """Raise ValueError where what is `held` of each step, (N, ...), would take more than half of the device's memory.

    A lower bound: it counts one seed, split over all devices. `replay_memory="device"` asks nothing.
    """
    if held is None or config.replay_memory != "auto":
        return
    each = sum(leaf.size // env.num_envs * leaf.dtype.itemsize for leaf in jax.tree.leaves(held))
    needed = each * (1 + config.mirror) * config.replay_capacity // jax.device_count()
    if not host_replay.fits(needed, jax.devices()[0]):
        raise ValueError(f"DreamerConfig.redraw holds {each:,} bytes of each step, {needed / 1e9:.1f} GB in all, which "
                         "is more than half of the device's memory. Lower replay_capacity, or set redraw to false.")


def on_redrawn(env: FunctionalEnv, config: DreamerConfig, update: Callable[..., Any]) -> Callable[..., Any]:
    """The update (configuration, agent, batch, key) that first draws the observations of its batch."""
    if not config.redraw:
        return update

    def redrawn(config: DreamerConfig, agent: Any, batch: Batch, key: jax.Array) -> Any:
        draw_key, key = jax.random.split(key)
        return update(config, agent, dataclasses.replace(batch, obs=drawn(env, config, batch, draw_key)), key)

    return redrawn


def drawn(env: FunctionalEnv, config: DreamerConfig, batch: Batch, key: jax.Array) -> Any:
    """Observations (T, B, ...) of a batch; each sequence looks alike throughout, and like no other."""
    assert env.redraw is not None and batch.stream is not None
    length, count = batch.reward.shape
    keys = parallel.own_rows(lambda rows: jax.random.split(key, rows)[None], (count,))  # (1, B, 2)
    keys = jnp.broadcast_to(keys, (length, *keys.shape[1:])).reshape(length * count, -1)
    steps = jax.tree.map(lambda leaf: leaf.reshape(length * count, *leaf.shape[2:]), batch.obs)
    obs = jax.vmap(env.redraw.draw)(steps, keys)
    if config.mirror:
        assert env.mirror is not None
        mirrored = jnp.tile(batch.stream >= env.num_envs, length)

        def choose(plain: jax.Array, other: jax.Array) -> jax.Array:
            return jnp.where(mirrored.reshape(-1, *[1] * (plain.ndim - 1)), other[0], plain)

        obs = jax.tree.map(choose, obs, env.mirror.obs(None, obs, 1))
    return jax.tree.map(lambda leaf: leaf.reshape(length, count, *leaf.shape[1:]), obs)
