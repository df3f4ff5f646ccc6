"""Evaluation without bias: exactly one episode per instance and round, however long it takes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.model import agent as agents
from dreamer.refusals import INT32, whole
from dreamer.training import seeds
from dreamer.training.programs import Kept, Programs
from dreamer.types import FunctionalEnv, Params


@dataclass(frozen=True)
class Rounds:
    """How episodes are played."""

    max_steps: int = 100_000
    """A round ends here even if an instance has not finished."""
    kept: Programs | None = None
    """Where the compiled program is kept; not for several seeds."""


def evaluate(
    env: FunctionalEnv,
    config: DreamerConfig,
    params: Params,
    key: jax.Array,
    episodes: int,
    rounds: Rounds = Rounds(),  # noqa: B008
) -> dict[str, np.ndarray]:
    """Results of `episodes` episodes.

    The agent acts deterministically, as on the vehicle.
    Each instance plays one episode per round and is then ignored, so that short episodes do not count more often.

    Args:
        env: vector environment.
        config: sizes.
        params: of the agent, or of several with a seed axis in front.
        key: consumed; all seeds meet the same starts.
        episodes: how many; rounds of `env.num_envs`, the last one cut to its first instances.
        rounds: how long one lasts at most, and where its program is kept.

    Returns:
        Arrays (episodes,), or (S, episodes) of S seeds: return, length [steps], finished, and every metric of the
        environment on the last frame.

    Raises:
        ValueError: episodes is no whole number of at least 1.
    """
    episodes = whole("episodes", episodes, 1, INT32)
    several = bool(seeds.count(params))
    play = _compiled(env, config, rounds, several)
    keys = jax.random.split(key, -(-episodes // env.num_envs))
    results = [jax.device_get(play(params, round_key)) for round_key in keys]
    return {name: np.concatenate([result[name] for result in results], -1)[..., :episodes] for name in results[0]}


@lru_cache(maxsize=8)
def _compiled(env: FunctionalEnv, config: DreamerConfig, rounds: Rounds, several: bool) -> Any:
    def play(params: Params, key: jax.Array) -> dict[str, jax.Array]:
        return play_round(env, config, params, key, rounds.max_steps)

    if several:
        return jax.jit(jax.vmap(play, in_axes=(0, None)))
    return Kept(f"evaluate_{rounds.max_steps}", jax.jit(play), rounds.kept)


def play_round(
    env: FunctionalEnv, config: DreamerConfig, params: Params, key: jax.Array, max_steps: int
) -> dict[str, jax.Array]:
    """The first episode of every instance: arrays (N,) as in `evaluate`."""
    reset_key, _ = jax.random.split(key)
    env_state, transition = env.begin(reset_key)
    zeros = jnp.zeros((env.num_envs,), jnp.float32)
    start = {
        "return": zeros,
        "length": jnp.zeros((env.num_envs,), jnp.int32),
        "finished": zeros.astype(bool),
        **{name: zeros for name in transition.metrics},
    }
    carry, actions = agents.init_carry(config, env.num_envs, env.action_dim), spaces.actions(env.action_dim)

    def running(loop: tuple) -> jax.Array:
        return (loop[0] < max_steps) & ~jnp.all(loop[-1]["finished"])

    def advance(loop: tuple) -> tuple:
        step, env_state, transition, carry, result = loop
        carry, action = agents.act(config, params, carry, transition.obs, transition.is_first, agents.Choice())
        env_state, transition = env.advance(env_state, actions.to_env(action))
        active = ~result["finished"]
        ends = active & transition.is_last
        new = {
            "return": result["return"] + active * transition.reward,
            "length": result["length"] + active,
            "finished": result["finished"] | transition.is_last,
            **{
                name: jnp.where(ends, value.astype(jnp.float32), result[name])
                for name, value in transition.metrics.items()
            },
        }
        return step + 1, env_state, transition, carry, new

    return jax.lax.while_loop(running, advance, (jnp.zeros((), jnp.int32), env_state, transition, carry, start))[-1]
