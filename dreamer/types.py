"""Data that crosses the border between an environment and the learner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dreamer.refusals import INT32, check_same, kind_of, whole
from dreamer.spaces import ActionSpec, ObsShape, actions, check, image_shape

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
    """The environment's state, the observations (N, ...) of its last step, K -> those of K worlds (K, N, ...). With
    `DreamerConfig.redraw` there is no state any more: it gets None, redrawn observations, and K = 1."""
    action: Callable[[jax.Array, int], jax.Array]
    """Actions (N, A), one-hot where they are classes, and K -> those of the same K worlds (K, N, A)."""
    worlds: int = 1
    """How many different ones there are: the largest K."""


@dataclass(frozen=True, eq=False)
class Redraw:
    """Observations drawn anew each time the replay is read: the same moment in other colours, light and noise."""

    keep: Callable[[EnvState, Any], Any]
    """The environment's state and the observations (N, ...) of its last step -> what the replay holds of them, arrays
    (N, ...)."""
    draw: Callable[[Any, jax.Array], Any]
    """What is held of one step, and a random key -> its observation. All steps of a sequence get the same key."""


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
    redraw: Redraw | None = None
    """How `DreamerConfig.redraw` draws observations anew; None: it cannot."""

    def __post_init__(self) -> None:
        """Raise ValueError for instances, observations, actions or functions of another kind."""
        object.__setattr__(self, "num_envs", whole("FunctionalEnv.num_envs", self.num_envs, 1, INT32))
        image_shape(self.obs_shape)
        actions(self.action_dim)
        for name in ("reset", "step"):
            if not callable(getattr(self, name)):
                raise ValueError(f"FunctionalEnv.{name} = {getattr(self, name)!r}: it must be a function. Correct it.")

    def begin(self, key: jax.Array) -> tuple[EnvState, Transition]:
        """`reset`.

        Raises:
            ValueError: it returns something else than the learner reads.
        """
        state, transition = self._pair("reset", self.reset(key))
        return state, transition

    def advance(self, state: EnvState, action: jax.Array) -> tuple[EnvState, Transition]:
        """`step`, for actions (N, A) in [-1, 1] or classes (N,).

        Raises:
            ValueError: it returns something else than the learner reads, or another kind of state than it got.
        """
        after, transition = self._pair("step", self.step(state, action))
        check_same("the state of the environment: ", state, after)
        return after, transition

    def _pair(self, name: str, returned: Any) -> tuple[EnvState, Transition]:
        """What `reset` or `step` has returned, checked for what is known while it is traced: shapes and types."""
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Transition)):
            raise ValueError(f"FunctionalEnv.{name} returns a {type(returned).__name__}; it must return the state and "
                             "a Transition. Correct it.")
        state, transition = returned
        check(self.obs_shape, transition.obs, self.num_envs)
        if not isinstance(transition.metrics, dict):
            raise ValueError(f"FunctionalEnv.{name}: metrics is {transition.metrics!r}; it must be a dict of arrays "
                             f"({self.num_envs},) by name, {{}} for none. Correct it.")
        flags = {flag: getattr(transition, flag) for flag in ("is_first", "is_last", "is_terminal")}
        for part, value in {"reward": transition.reward, **flags, **transition.metrics}.items():
            kinds = (np.bool_,) if part in flags else (np.bool_, np.integer, np.floating)
            found = getattr(value, "dtype", np.dtype(object))
            if np.shape(value) != (self.num_envs,) or not any(jnp.issubdtype(found, kind) for kind in kinds):
                raise ValueError(f"FunctionalEnv.{name}: {part} is {kind_of(value)}; it must be an array of "
                                 f"{'bool' if part in flags else 'numbers'}, shape ({self.num_envs},). Correct it.")
        return state, transition
