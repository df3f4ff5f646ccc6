"""Pretraining of the world model on random drives, before the counted steps.

First the instances drive with random actions until the replay holds `pretrain_steps`, then the world model alone is
updated `pretrain_updates` times. Environment, carry and replay go on into the counted steps as they are; the optimiser
begins anew there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from dreamer.config import DreamerConfig
from dreamer.experience import redraw
from dreamer.experience.iteration import Metrics, TrainState, collect, replayed_updates, sum_over
from dreamer.model import agent as agents
from dreamer.types import FunctionalEnv

UPDATES_PER_DISPATCH = 8
"""Updates in one dispatch: enough to hide it, few enough for a clock and a killed run."""


def pretrain_iteration(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, mesh: Mesh | None = None
) -> tuple[TrainState, Metrics]:
    """The next `steps_per_iter` random steps of every instance, or, after the last of them, the next few updates.

    Args and results are those of `train_iteration`. `env_steps` stays 0; the optimiser's count is 0 again at the end.
    """
    assert state.pretrained is not None
    key, drive_key, update_key = jax.random.split(state.key, 3)
    missing = -(-(config.pretrain_steps - state.pretrained.steps) // env.num_envs)
    steps = jnp.clip(missing, 0, config.steps_per_iter)
    left = jnp.clip(config.pretrain_updates - state.pretrained.updates, 0, UPDATES_PER_DISPATCH)
    updates = jnp.where(missing > 0, 0, left)
    state, driven = sum_over(steps, partial(_drive, env, config, drive_key), dataclasses.replace(state, key=key))
    plain = dataclasses.replace(config, lr_decay=0)  # the decay belongs to the counted updates
    update = redraw.on_redrawn(env, config, agents.update_model)
    state, learned = replayed_updates(plain, state, updates, update_key, update, mesh)
    assert state.pretrained is not None
    done = dataclasses.replace(state.pretrained, updates=state.pretrained.updates + updates)
    over = done.updates >= config.pretrain_updates
    agent = jax.tree.map(lambda new, old: jnp.where(over, new, old), agents.restart(state.agent), state.agent)
    return dataclasses.replace(state, agent=agent, pretrained=done), {**driven, **learned}


def _drive(
    env: FunctionalEnv, config: DreamerConfig, key: jax.Array, i: jax.Array, state: TrainState
) -> tuple[TrainState, Metrics]:
    """One random step of every instance, which is not counted as an environment step."""
    assert state.pretrained is not None
    driven, metrics = collect(env, config, state, jax.random.fold_in(key, i), always_random=True)
    done = dataclasses.replace(state.pretrained, steps=state.pretrained.steps + env.num_envs)
    return dataclasses.replace(driven, env_steps=state.env_steps, pretrained=done), metrics


def counters(state: TrainState) -> dict[str, int]:
    """What is done, as it is logged; empty where there is no pretraining."""
    if state.pretrained is None:
        return {}
    return {"pretrain_steps": int(state.pretrained.steps), "pretrain_updates": int(state.pretrained.updates)}


def position(config: DreamerConfig, line: Mapping[str, float]) -> int:
    """Place of a logged line in its run: the counted steps, or, before the first of them, what is left to pretrain,
    steps and updates together, as a negative number."""
    steps = min(int(line.get("pretrain_steps", config.pretrain_steps)), config.pretrain_steps)
    updates = int(line.get("pretrain_updates", config.pretrain_updates))
    return int(line["env_steps"]) + steps + updates - config.pretrain_steps - config.pretrain_updates
