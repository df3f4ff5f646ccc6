"""Replay memory: one ring of rows, each row holding the same step of all N instance streams.

All of it lies on the device, or all but the observations (`dreamer.experience.host_replay`).

Row t, column n is one step of stream n: the frame, what came with it, the action taken AFTER it, and the latent state
inferred from it. A sampled window is consecutive rows of one column between the oldest and the newest row, so it
crosses neither the write head nor another stream. It may hold an episode's end and the next one's start; `is_first`
marks that.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.experience import host_replay
from dreamer.experience.host_replay import HostFrames
from dreamer.layers import distributions as dist
from dreamer.model.rssm import Latent
from dreamer.spaces import ObsShape
from dreamer.training import parallel
from dreamer.types import Transition


@struct.dataclass
class Replay:
    """The memory, with L rows."""

    obs: Any
    """(L, N, H, W, C) uint8 images, (L, N, D) float32 vectors, as the environment names them; or `HostFrames`; or what
    `dreamer.types.Redraw` keeps of them."""
    reward: jax.Array
    """(L, N) float32."""
    is_first: jax.Array
    """(L, N) bool; is_last and is_terminal alike."""
    is_last: jax.Array
    is_terminal: jax.Array
    action: jax.Array
    """(L, N, A) float32 taken after the frame; one-hot where it is a class."""
    deter: jax.Array
    """(L, N, D) in the compute type, refreshed by the updates."""
    stoch: jax.Array
    """(L, N, S) uint8 class indices, refreshed alike."""
    written: jax.Array
    """() int32 rows written since the start; row t lies at t modulo L."""
    online_next: jax.Array
    """() int32 next fresh sequence: generation * N + stream."""


@struct.dataclass
class Batch:
    """T steps of B sequences, T leading."""

    obs: Any
    """(T, B, H, W, C) uint8 images, (T, B, D) float32 vectors."""
    prev_action: jax.Array
    """(T, B, A) action taken before the frame."""
    reward: jax.Array
    """(T, B)."""
    is_first: jax.Array
    """(T, B) bool; is_last and is_terminal alike."""
    is_last: jax.Array
    is_terminal: jax.Array
    start: Latent
    """(B, ...) stored state of the step before the first."""
    stream: jax.Array | None = None
    """(B,) int32 column of the memory."""


@struct.dataclass
class Window:
    """Where a batch came from."""

    row: jax.Array
    """(T + 1, B) int32 physical rows, the context step first."""
    stream: jax.Array
    """(B,) int32."""


def rows_for(config: DreamerConfig, num_envs: int) -> int:
    """Rows L that hold `replay_capacity` steps of `num_envs` streams.

    Raises:
        ValueError: too few rows for one sequence.
    """
    rows = config.replay_capacity // num_envs
    if rows < 2 * config.batch_length + 1:
        raise ValueError(
            f"replay_capacity = {config.replay_capacity} gives {rows} steps to each of {num_envs} instances; at least "
            f"{2 * config.batch_length + 1} (2 * batch_length + 1) are needed. Raise it to "
            f"{num_envs * (2 * config.batch_length + 1)} or use fewer instances."
        )
    return rows


def init(
    config: DreamerConfig, num_envs: int, obs_shape: ObsShape, action_width: int, copies: int = 1, kept: Any = None
) -> Replay:
    """An empty memory for actions of this many numbers, with `copies` streams for each instance.

    It holds observations; or what is `kept` in their place, of which these are the arrays (N, ...) or their shapes.
    """
    shape = (rows_for(config, num_envs), copies * num_envs)
    if kept is not None:
        obs = jax.tree.map(lambda leaf: jnp.zeros((*shape, *leaf.shape[1:]), leaf.dtype), kept)
    elif config.replay_memory == "host":
        obs = host_replay.init(obs_shape, shape)
    else:
        obs = spaces.zeros(obs_shape, shape)
    return Replay(
        obs=obs,
        reward=jnp.zeros(shape, jnp.float32),
        is_first=jnp.zeros(shape, bool),
        is_last=jnp.zeros(shape, bool),
        is_terminal=jnp.zeros(shape, bool),
        action=jnp.zeros((*shape, action_width), jnp.float32),
        deter=jnp.zeros((*shape, config.deter), config.dtype),
        stoch=jnp.zeros((*shape, config.stoch), jnp.uint8),
        written=jnp.zeros((), jnp.int32),
        online_next=jnp.zeros((), jnp.int32),
    )


def size(replay: Replay) -> jax.Array:
    """() rows that hold data."""
    return jnp.minimum(replay.written, replay.reward.shape[0])


def write(config: DreamerConfig, replay: Replay, transition: Transition, action: jax.Array, latent: Latent) -> Replay:
    """Append one row.

    Args:
        config: sizes.
        replay: memory, best donated.
        transition: frames (N, ...).
        action: (N, A) taken after them.
        latent: (N, ...) inferred from them.
    """
    row = replay.written % replay.reward.shape[0]

    def put(memory: jax.Array, value: jax.Array) -> jax.Array:
        return jax.lax.dynamic_update_index_in_dim(memory, value.astype(memory.dtype), row, 0)

    if isinstance(replay.obs, HostFrames):
        obs: Any = host_replay.write(replay.obs, row, transition.obs)
    else:
        obs = jax.tree.map(put, replay.obs, transition.obs)
    return dataclasses.replace(
        replay,
        obs=obs,
        reward=put(replay.reward, transition.reward),
        is_first=put(replay.is_first, transition.is_first),
        is_last=put(replay.is_last, transition.is_last),
        is_terminal=put(replay.is_terminal, transition.is_terminal),
        action=put(replay.action, action),
        deter=put(replay.deter, latent.deter),
        stoch=put(replay.stoch, to_index(config, latent.stoch)),
        written=replay.written + 1,
    )


def sample(config: DreamerConfig, replay: Replay, key: jax.Array) -> tuple[Replay, Batch, Window]:
    """Draw a batch: fresh sequences as long as there are any, then uniformly over streams and positions.

    Fresh sequences do not overlap: generation c of a stream ends at its row (c + 1) * T. When more are produced than
    trained, only the newest generation waits; older ones stay within the uniform draw.

    Args:
        config: sizes.
        replay: at least batch_length + 1 rows.
        key: consumed.

    Returns:
        The memory with the queue advanced, the batch, and its place.
    """
    rows, streams = replay.reward.shape[0], replay.reward.shape[1] * parallel.devices()
    length = config.batch_length
    filled = size(replay)
    stream_key, start_key = jax.random.split(key)
    stream = jax.random.randint(stream_key, (config.batch_size,), 0, streams)
    oldest = replay.written - filled
    start = oldest + jax.random.randint(start_key, (config.batch_size,), 0, filled - length)
    online_next = replay.online_next
    if config.online:
        generations = (replay.written - 1) // length
        first = jnp.maximum(online_next, (generations - 1) * streams)
        ticket = first + jnp.arange(config.batch_size)
        fresh = ticket < generations * streams
        stream = jnp.where(fresh, ticket % streams, stream)
        start = jnp.where(fresh, ticket // streams * length, start)
        online_next = jnp.minimum(first + config.batch_size, jnp.maximum(first, generations * streams))
    row = (start + jnp.arange(length + 1)[:, None]) % rows
    window = Window(row, stream)
    replay, batch = gather(config, dataclasses.replace(replay, online_next=online_next), window)
    return replay, batch, window


def gather(config: DreamerConfig, replay: Replay, window: Window) -> tuple[Replay, Batch]:
    """The memory, and the batch that lies at a window; of several devices, each gets its own sequences."""
    column, mine = parallel.own_columns(window.stream, replay.reward.shape[1])

    def take(memory: jax.Array, row: jax.Array) -> jax.Array:
        mode = "promise_in_bounds" if parallel.devices() == 1 else "clip"
        return parallel.deal(memory.at[row, column].get(mode=mode), mine, row.ndim - 1)

    context, trained = window.row[0], window.row[1:]
    index = take(replay.stoch, context).astype(jnp.int32)
    stoch = dist.one_hot(index, config.classes).reshape(index.shape[0], -1).astype(replay.deter.dtype)
    if isinstance(replay.obs, HostFrames):
        frames, obs = host_replay.read(replay.obs, trained, window.stream)
        replay = dataclasses.replace(replay, obs=frames)
    else:
        obs = jax.tree.map(lambda memory: take(memory, trained), replay.obs)
    start = Latent(take(replay.deter, context), stoch)
    if not config.stored_latents:
        start = jax.tree.map(jnp.zeros_like, start)
    batch = Batch(
        obs=obs,
        prev_action=take(replay.action, window.row[:-1]),
        reward=take(replay.reward, trained),
        is_first=take(replay.is_first, trained),
        is_last=take(replay.is_last, trained),
        is_terminal=take(replay.is_terminal, trained),
        start=start,
        stream=parallel.deal(window.stream, mine, 0),
    )
    return replay, batch


def write_back(config: DreamerConfig, replay: Replay, window: Window, latent: Latent) -> Replay:
    """Replace the stored states of a window's trained steps by latent (T, B, ...), of which devices hold their share.

    Where sequences overlap, those of the last one are kept, as if they were written one after the other. Which of two
    writes to one place a GPU keeps is open: a state could be mixed of both.
    """
    outside = replay.reward.shape[0]  # a row that does not exist: what goes there is dropped
    column, _ = parallel.own_columns(window.stream, replay.reward.shape[1])
    place = (jnp.where(overwritten(window, outside), outside, window.row[1:]), column)
    deter = parallel.gather(latent.deter.astype(replay.deter.dtype), 1)
    stoch = parallel.gather(to_index(config, latent.stoch), 1)
    deter = replay.deter.at[place].set(deter, mode="drop")
    stoch = replay.stoch.at[place].set(stoch, mode="drop")
    return dataclasses.replace(replay, deter=deter, stoch=stoch)


def overwritten(window: Window, rows: int) -> jax.Array:
    """(T, B) bool: a later sequence of the batch trains this step too, in a ring of this many rows."""
    trained = window.row[1:]
    since = (trained[:, :, None] - trained[0]) % rows  # (T, B, B): steps after the start of each sequence
    order = jnp.arange(trained.shape[1])
    later = (window.stream[:, None] == window.stream) & (order[:, None] < order)
    return jnp.any((since < trained.shape[0]) & later, -1)


def to_index(config: DreamerConfig, stoch: jax.Array) -> jax.Array:
    """One-hot (..., S * C) -> class indices (..., S) uint8."""
    return jnp.argmax(stoch.reshape(*stoch.shape[:-1], config.stoch, config.classes), -1).astype(jnp.uint8)
