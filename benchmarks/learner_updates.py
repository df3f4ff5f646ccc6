"""The program that the learner's benchmarks time: a block of updates on a full memory of noise."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer.config import DreamerConfig
from dreamer.experience import replay
from dreamer.experience.host_replay import HostFrames
from dreamer.experience.replay import Replay
from dreamer.model import agent as agents
from dreamer.training import seeds
from dreamer.training.programs import compile_lowered

OBS_SHAPE = (64, 64, 3)
ACTION_DIM = 2
STREAMS = 16
ROWS = 1024
Learner = dict[str, Any]
"""`agent` and `replay`, named as in the training state."""


def random_replay(config: DreamerConfig, key: jax.Array) -> Replay:
    """A full memory of noise, with an episode start every 100 rows."""
    memory = replay.init(config, STREAMS, OBS_SHAPE, ACTION_DIM)
    keys = jax.random.split(key, 4)
    rows = memory.reward.shape[0]
    starts = jnp.broadcast_to((jnp.arange(rows) % 100 == 0)[:, None], (rows, STREAMS))
    if isinstance(memory.obs, HostFrames):
        noise = np.random.default_rng(0).integers(0, 256, (rows, STREAMS, *OBS_SHAPE), np.uint8)
        memory.obs.store.load(noise)
        obs: Any = memory.obs
    else:
        obs = jax.random.bits(keys[0], memory.obs.shape, jnp.uint8)
    return dataclasses.replace(
        memory,
        obs=obs,
        reward=jax.random.normal(keys[1], memory.reward.shape),
        is_first=starts,
        is_last=jnp.roll(starts, -1, 0),
        action=jax.random.normal(keys[2], memory.action.shape),
        stoch=jax.random.randint(keys[3], memory.stoch.shape, 0, config.classes).astype(jnp.uint8),
        written=jnp.asarray(rows, jnp.int32),
        online_next=jnp.asarray(rows * STREAMS, jnp.int32),  # no fresh sequences: all draws are uniform
    )


def begin(config: DreamerConfig, key: jax.Array) -> Learner:
    """A new agent and its memory."""
    return {"agent": agents.init_agent(config, OBS_SHAPE, ACTION_DIM, key), "replay": random_replay(config, key)}


def advance(config: DreamerConfig, count: int, learner: Learner, key: jax.Array) -> Learner:
    """`count` updates: draw from the replay, gradient step, latents written back."""

    def one(i: jax.Array, learner: Learner) -> Learner:
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        memory, batch, window = replay.sample(config, learner["replay"], sample_key)
        agent, latent, _ = agents.update(config, learner["agent"], batch, update_key)
        return {"agent": agent, "replay": replay.write_back(config, memory, window, latent)}

    return jax.lax.fori_loop(0, count, one, learner)


class Updates:
    """`per_block` updates as one program: traced on making, compiled by `compile`, timed by `run`."""

    def __init__(self, config: DreamerConfig, per_block: int, runs: int = 0) -> None:
        """`runs` agents side by side, as `dreamer.training.seeds` has them; 0 is one agent without a seed axis."""
        self._per_block = per_block
        self._keys = jax.random.split(jax.random.PRNGKey(0), runs) if runs else jax.random.PRNGKey(0)

        def first(key: jax.Array) -> Learner:
            return begin(config, key)

        def block(learner: Learner, key: jax.Array) -> Learner:
            return advance(config, per_block, learner, key)

        if runs:
            where = seeds.axes(jax.eval_shape(first, self._keys[0]))  # type: ignore[arg-type]
            first = jax.vmap(first, out_axes=where)
            block = jax.vmap(block, in_axes=(where, 0), out_axes=where)
        self._first = jax.jit(first)
        shapes = jax.eval_shape(self._first, self._keys)  # of the same trace: a store on the host belongs to one
        self._lowered = jax.jit(block, donate_argnums=0).lower(shapes, self._keys)
        self._learner: Learner | None = None
        self.program: Any = None
        """The compiled block, (learner, key) -> learner."""

    def compile(self) -> float:
        """Seconds it took."""
        start = time.perf_counter()
        self.program = compile_lowered(self._lowered)
        return time.perf_counter() - start

    def run(self) -> tuple[float, float]:
        """Make the updates of a block; seconds for each of them, by the clock and of all the host's cores."""
        learner = self._first(self._keys) if self._learner is None else self._learner
        jax.block_until_ready(learner)
        start, processor_start = time.perf_counter(), time.process_time()
        self._learner = self.program(learner, self._keys)
        jax.block_until_ready(self._learner)
        processor = time.process_time() - processor_start
        return (time.perf_counter() - start) / self._per_block, processor / self._per_block

    def time(self, blocks: int) -> tuple[list[float], list[float]]:
        """`run` so many times after one that does not count, and forget the agent."""
        self.run()
        measured = [self.run() for _ in range(blocks)]
        self._learner = None
        return [one for one, _ in measured], [one for _, one in measured]


def time_updates(config: DreamerConfig, blocks: int, per_block: int) -> tuple[list[float], list[float], float]:
    """Seconds per update of each block, seconds of all the host's cores in it, and seconds to compile."""
    updates = Updates(config, per_block)
    compile_s = updates.compile()
    return *updates.time(blocks), compile_s
