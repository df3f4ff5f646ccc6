"""Small environments with known answers, and a tiny agent for them."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from dreamer.config import DreamerConfig, preset
from dreamer.spaces import Discrete
from dreamer.train import TrainingOptions, train
from dreamer.types import FunctionalEnv, Redraw, Transition

SHAPE = (16, 16, 3)


def tiny_config(**overrides: Any) -> DreamerConfig:
    """A configuration that compiles in seconds."""
    sizes = dict(
        deter=32, hidden=16, units=16, stoch=4, classes=4, blocks=4, patch_units=8, depth=2, batch_size=4,
        batch_length=8, imag_horizon=5, learning_starts=32, replay_capacity=800, train_ratio=16.0, warmup=20,
        value_layers=1, policy_layers=1,
    )
    return preset("cpu", **{**sizes, **overrides})


def train_without_end(config: DreamerConfig, out: Path, last: int) -> None:
    """Train in the corridor with a checkpoint after every iteration, and from `last` steps on wait to be killed."""

    def wait(line: dict[str, float]) -> None:
        while line["env_steps"] >= last:
            time.sleep(60)

    options = TrainingOptions(progress=False, log_every_s=0.0, checkpoint_every_s=0.0, on_metrics=wait)
    train(corridor_env(4), config, out, 10**6, 0, options)


@struct.dataclass
class ToyState:
    """Position of each instance, step within the episode, and whether the next step resets."""

    key: jax.Array
    place: jax.Array
    count: jax.Array
    reset_next: jax.Array


def shade(level: jax.Array) -> jax.Array:
    """(N,) in [0, 1] -> uniformly grey images (N, 16, 16, 3) uint8."""
    pixel = jnp.round(255 * level).astype(jnp.uint8)
    return jnp.broadcast_to(pixel[:, None, None, None], (level.shape[0], *SHAPE))


def corridor_env(num_envs: int, length: int = 4, limit: int = 12) -> FunctionalEnv:
    """A corridor: a positive action moves one cell on, a negative one back; the last cell pays 1 and ends the task.

    Each step costs 0.05, so the best return is 1 - 0.05 * (length - 1). Episodes are cut off after `limit` steps.
    """

    def emit(state: ToyState, moved: jax.Array, first: jax.Array) -> Transition:
        goal = (state.place == length) & ~first
        timeout = (state.count >= limit) & ~goal & ~first
        reward = jnp.where(goal, 1.0, jnp.where(first, 0.0, -0.05))
        return Transition(
            obs=shade(state.place / length), reward=reward.astype(jnp.float32), is_first=first, is_last=goal | timeout,
            is_terminal=goal, metrics={"success": goal.astype(jnp.float32)},
        )

    def reset(key: jax.Array) -> tuple[ToyState, Transition]:
        zeros = jnp.zeros((num_envs,), jnp.int32)
        state = ToyState(key, zeros, zeros, zeros.astype(bool))
        return state, emit(state, zeros, jnp.ones((num_envs,), bool))

    def step(state: ToyState, action: jax.Array) -> tuple[ToyState, Transition]:
        first = state.reset_next
        move = jnp.where(action[:, 0] > 0, 1, -1)
        place = jnp.where(first, 0, jnp.clip(state.place + move, 0, length))
        count = jnp.where(first, 0, state.count + 1)
        new = ToyState(state.key, place, count, first)
        transition = emit(new, move, first)
        return ToyState(state.key, place, count, transition.is_last), transition

    return FunctionalEnv(num_envs, SHAPE, 1, reset, step)


def with_redraw(env: FunctionalEnv) -> FunctionalEnv:
    """The environment, whose images in the replay are redrawn: dark or light as they were, in a shade by the key."""

    def keep(state: Any, obs: jax.Array) -> jax.Array:
        return obs[:, 0, 0, 0] / 255.0

    def draw(level: jax.Array, key: jax.Array) -> jax.Array:
        tone = jax.random.randint(key, (), 0, 128)
        return jnp.full(SHAPE, jnp.where(level > 0.5, 128, 0) + tone, jnp.uint8)

    return dataclasses.replace(env, redraw=Redraw(keep, draw))


def echo_env(num_envs: int) -> FunctionalEnv:
    """Shows the sign of the previous action, black or white: only a model fed the right action can foresee it."""

    def emit(state: ToyState, level: jax.Array, first: jax.Array) -> Transition:
        return Transition(
            obs=shade(level), reward=jnp.zeros((num_envs,)), is_first=first, is_last=jnp.zeros_like(first),
            is_terminal=jnp.zeros_like(first), metrics={},
        )

    def reset(key: jax.Array) -> tuple[ToyState, Transition]:
        zeros = jnp.zeros((num_envs,), jnp.int32)
        state = ToyState(key, zeros, zeros, zeros.astype(bool))
        return state, emit(state, jnp.zeros((num_envs,)), jnp.ones((num_envs,), bool))

    def step(state: ToyState, action: jax.Array) -> tuple[ToyState, Transition]:
        level = (action[:, 0] > 0).astype(jnp.float32)
        return state, emit(state, level, jnp.zeros((num_envs,), bool))

    return FunctionalEnv(num_envs, SHAPE, 1, reset, step)


def counting_env(num_envs: int, limits: tuple[int, ...]) -> FunctionalEnv:
    """Instance n ends (by time-out) after limits[n] steps and pays 1 per step: length and return are limits[n]."""
    limit = jnp.array(limits)

    def emit(state: ToyState, first: jax.Array) -> Transition:
        last = (state.count >= limit) & ~first
        reward = jnp.where(first, 0.0, 1.0)
        return Transition(
            obs=shade((state.count % 2).astype(jnp.float32)), reward=reward, is_first=first, is_last=last,
            is_terminal=jnp.zeros_like(last), metrics={"mark": state.count.astype(jnp.float32)},
        )

    def reset(key: jax.Array) -> tuple[ToyState, Transition]:
        zeros = jnp.zeros((num_envs,), jnp.int32)
        state = ToyState(key, zeros, zeros, zeros.astype(bool))
        return state, emit(state, jnp.ones((num_envs,), bool))

    def step(state: ToyState, action: jax.Array) -> tuple[ToyState, Transition]:
        first = state.reset_next
        new = ToyState(state.key, state.place, jnp.where(first, 0, state.count + 1), first)
        transition = emit(new, first)
        return ToyState(new.key, new.place, new.count, transition.is_last), transition

    return FunctionalEnv(num_envs, SHAPE, 2, reset, step)


def choice_env(num_envs: int, length: int = 3, limit: int = 10) -> FunctionalEnv:
    """The corridor with three classes (back, stay, on), seen as an image, its own place and a distance at once."""
    plain = corridor_env(num_envs, length, limit)

    def dressed(state: ToyState, transition: Transition) -> Transition:
        place = state.place.astype(jnp.float32)
        senses = {"place": jax.nn.one_hot(state.place, length + 1), "range": 50.0 * place[:, None]}
        return dataclasses.replace(transition, obs={"camera": transition.obs, **senses})

    def reset(key: jax.Array) -> tuple[ToyState, Transition]:
        state, transition = plain.reset(key)
        return state, dressed(state, transition)

    def step(state: ToyState, action: jax.Array) -> tuple[ToyState, Transition]:
        here = state.place
        state, transition = plain.step(state, (action[:, None] - 1).astype(jnp.float32))
        moved = action != 1  # standing still is to the corridor a step back
        stays = ~moved & ~transition.is_first
        state = dataclasses.replace(state, place=jnp.where(stays, here, state.place))
        level = dataclasses.replace(transition, obs=shade(state.place / length))
        return state, dressed(state, level)

    shapes = {"camera": SHAPE, "place": (length + 1,), "range": (1,)}
    return FunctionalEnv(num_envs, shapes, Discrete(3), reset, step)
