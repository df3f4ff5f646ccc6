"""Observations of the replay in the host's memory, for a device that is too small for them.

Only the observations are moved: they are three quarters of a step's bytes at size12m and more in smaller sizes, and are
written once, while the latents are refreshed by every update. The training program stays one program; it calls the host
to put a row away and to fetch the frames of a batch. What is drawn and what is fetched is bit for bit that of a replay
on the device. JAX's own memory on the host (`pinned_host`) does not serve: a device's program cannot index it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.experimental import io_callback

from dreamer import spaces
from dreamer.spaces import ObsShape


class Store:
    """The arrays (L, N, ...) of one run."""

    def __init__(self, obs_shape: ObsShape, shape: tuple[int, int]) -> None:
        self.shapes = jax.eval_shape(lambda: spaces.zeros(obs_shape, shape))
        self.frames = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), self.shapes)
        """As the environment names them. Memory is taken when a row is first written."""

    def put(self, order: Any, row: Any, obs: Any) -> np.ndarray:
        """Write one row of all streams; the next order."""
        jax.tree.map(lambda memory, value: memory.__setitem__(int(row), np.asarray(value)), self.frames, obs)
        return _next(order)

    def take(self, order: Any, row: Any, stream: Any) -> tuple[np.ndarray, Any]:
        """The next order, and the frames (T, B, ...) at rows (T, B) of streams (B,)."""
        place = (np.asarray(row), np.asarray(stream))
        return _next(order), jax.tree.map(lambda memory: memory[place], self.frames)

    def load(self, frames: Any) -> None:
        """Replace all rows."""
        jax.tree.map(np.copyto, self.frames, frames)


def _next(order: Any) -> np.ndarray:
    return np.asarray((int(order) + 1) % 2**31, np.int32)


@struct.dataclass
class HostFrames:
    """What the training state holds of a store: nothing but the order of the calls."""

    order: jax.Array
    """() int32 calls made so far. Each call needs the one before it, which keeps them in order."""
    store: Store = struct.field(pytree_node=False)


def init(obs_shape: ObsShape, shape: tuple[int, int]) -> HostFrames:
    """An empty store of this many rows and streams."""
    return HostFrames(jnp.zeros((), jnp.int32), Store(obs_shape, shape))


def write(frames: HostFrames, row: jax.Array, obs: Any) -> HostFrames:
    """Put observations (N, ...) into a row ()."""
    order = jax.ShapeDtypeStruct((), jnp.int32)
    return dataclasses.replace(frames, order=io_callback(frames.store.put, order, frames.order, row, obs))


def read(frames: HostFrames, row: jax.Array, stream: jax.Array) -> tuple[HostFrames, Any]:
    """Observations (T, B, ...) at rows (T, B) of streams (B,)."""

    def fetched(memory: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*row.shape, *memory.shape[2:]), memory.dtype)

    shapes = (jax.ShapeDtypeStruct((), jnp.int32), jax.tree.map(fetched, frames.store.shapes))
    order, obs = io_callback(frames.store.take, shapes, frames.order, row, stream)
    return dataclasses.replace(frames, order=order), obs


def revealed(state: Any) -> Any:
    """A training state whose observations are numpy's arrays, as a checkpoint holds them; waits for the device."""
    frames = state.replay.obs
    if not isinstance(frames, HostFrames):
        return state
    jax.block_until_ready(state)
    return dataclasses.replace(state, replay=dataclasses.replace(state.replay, obs=frames.store.frames))


def hidden(state: Any, template: Any) -> Any:
    """A `revealed` state with its observations moved into the store of `template`, the state it is like."""
    frames = template.replay.obs
    if not isinstance(frames, HostFrames):
        return state
    frames.store.load(state.replay.obs)
    return dataclasses.replace(state, replay=dataclasses.replace(state.replay, obs=frames))


def fits(obs_bytes: int, device: jax.Device) -> bool:
    """Whether the device has room for the observations: half of its memory is left to everything else."""
    stats = device.memory_stats() or {}
    return 2 * obs_bytes <= stats.get("bytes_limit", float("inf"))
