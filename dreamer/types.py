"""Data that crosses the border between an environment and the learner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
from flax import struct

from dreamer.spaces import ActionSpec, ObsShape

EnvState = Any
Params = dict[str, Any]
Carry = dict[str, jax.Array]
"""Recurrent state: deter (..., D), stoch (..., S * C) and the action (..., A) that led here."""


@struct.dataclass
class Transition:
    """What N environment instances emit at one control step."""

    obs: Any
    """(N, H, W, C) uint8 image, (N, D) float32 vector, or a dict of them."""
    reward: jax.Array
    """(N,) float32, earned by the action that led to this frame; 0 on the first frame."""
    is_first: jax.Array
    """(N,) bool, first frame of an episode: the incoming action is meaningless."""
    is_last: jax.Array
    """(N,) bool, terminated or truncated. The next step call resets the instance and ignores its action."""
    is_terminal: jax.Array
    """(N,) bool, terminated only: the one flag that zeroes the bootstrap value."""
    metrics: dict[str, jax.Array]
    """(N,) floats that are only watched, read on the last frame of an episode."""


@dataclass(frozen=True, eq=False)
class Mirror:
    """What is seen and done in other worlds, mirrored ones say, where rewards and ends are the same."""

    obs: Callable[[EnvState, Any, int], Any]
    """The environment's state, the observations (N, ...) of its last step, K -> those of K worlds (K, N, ...)."""
    action: Callable[[jax.Array, int], jax.Array]
    """Actions (N, A), one-hot where they are classes, and K -> those of the same K worlds (K, N, A)."""
    worlds: int = 1
    """How many different ones there are: the largest K."""


@dataclass(frozen=True, eq=False)
class FunctionalEnv:
    """A vector environment as two pure functions. Compared by identity, so it can be static."""

    num_envs: int
    """Instances N."""
    obs_shape: ObsShape
    """(H, W, C) of one image, (D,) of one vector, or a dict of them by name."""
    action_dim: ActionSpec
    """A, each component in [-1, 1]; or Discrete(n)."""
    reset: Callable[[jax.Array], tuple[EnvState, Transition]]
    """key -> state and first frames."""
    step: Callable[[EnvState, jax.Array], tuple[EnvState, Transition]]
    """state, action -> state and next frames; actions are (N, A) in [-1, 1], or classes (N,) int32."""
    mirror: Mirror | None = None
    """A symmetry that `DreamerConfig.mirror` learns from; None: there is none."""
