"""Several runs that differ in their seed as one program: every array gets a seed axis in front, counters do not.

All runs take the same number of steps and updates, so the counters that decide about them are shared. That keeps loops
loops: with a count of its own for each run, `vmap` would have to copy the replay at every update.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from dreamer.config import DreamerConfig
from dreamer.experience.iteration import Metrics, TrainState, init_state, train_iteration
from dreamer.training.programs import compile_lowered
from dreamer.types import FunctionalEnv, Params

SHARED = (
    "env_steps", "credit", "replay.written", "replay.online_next", "agent.opt.count", "pretrained.steps",
    "pretrained.updates",
)  # fmt: skip


def axes(state: TrainState) -> Any:
    """The seed axis of each leaf: 0, or None where the runs share it."""

    def one(path: tuple, leaf: Any) -> int | None:
        return None if jax.tree_util.keystr(path, simple=True, separator=".") in SHARED else 0

    return jax.tree_util.tree_map_with_path(one, state)


def count(params: Params) -> int:
    """Seeds that parameters hold side by side; 0 for those of a single agent."""
    bias = params["policy"]["out"]["b"]
    return bias.shape[0] if bias.ndim == 2 else 0


def pick(tree: Any, index: int) -> Any:
    """What belongs to one seed, of a tree whose leaves all have a seed axis, such as the parameters."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def init_states(env: FunctionalEnv, config: DreamerConfig, seeds: Sequence[int]) -> TrainState:
    """First state of each seed, the same as `init_state` gives it alone."""

    def begin(seed: jax.Array) -> TrainState:
        return init_state(env, config, seed)

    shape = jax.eval_shape(begin, jnp.zeros((), jnp.int32))
    return jax.vmap(begin, out_axes=axes(shape))(jnp.asarray(seeds, jnp.int32))


def train_iterations(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, step: Any = train_iteration
) -> tuple[TrainState, Metrics]:
    """One `train_iteration`, or another `step`, of every seed; metrics (S,) by name."""

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        return step(env, config, state)

    where = axes(state)
    return jax.vmap(iterate, in_axes=(where,), out_axes=(where, 0))(state)


def compile_iterations(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, step: Any = train_iteration
) -> Callable[[TrainState], Any]:
    """The compiled `train_iterations`, with the state donated."""
    return compile_lowered(_iterations(env, config, step).lower(state))


@lru_cache(maxsize=8)
def _iterations(env: FunctionalEnv, config: DreamerConfig, step: Any) -> Any:
    return jax.jit(lambda state: train_iterations(env, config, state, step), donate_argnums=0)
