"""Gymnasium environments on the host as an environment of the learner.

The training program stays one program: at every step it calls back to the host, which moves the instances one after the
other. That is slow beside an environment that runs on the device, but nothing else changes. The state of the instances
lies on the host and is not part of a checkpoint: a resumed run goes on with new episodes. So does whoever comes back to
instances that were moved on meanwhile, by an evaluation say.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from dreamer.spaces import Box, Discrete, ObsShape, Shape, zeros
from dreamer.types import FunctionalEnv, Transition

Convert = Callable[[Any], Any]


def from_gym(make: str | Callable[[], Any], instances: int = 1) -> FunctionalEnv:
    """`instances` Gymnasium environments as one vector environment.

    Images are uint8 boxes (H, W) or (H, W, C); other boxes become vectors, classes one-hot vectors, a dict a dict of
    these. Actions are a bounded box, scaled from [-1, 1], or classes. Episodes end by `terminated` or `truncated`.

    Args:
        make: name for `gymnasium.make`, or a function that returns an environment.
        instances: N.

    Raises:
        ValueError: a space that the learner does not know; names it and the remedy.
    """
    if isinstance(make, str):
        import gymnasium

        host = _Host([gymnasium.make(make) for _ in range(instances)])
    else:
        host = _Host([make() for _ in range(instances)])
    shape = {
        "obs": jax.eval_shape(lambda: zeros(host.obs_shape, (instances,))),
        "reward": jax.ShapeDtypeStruct((instances,), jnp.float32),
        **{name: jax.ShapeDtypeStruct((instances,), bool) for name in ("is_first", "is_last", "is_terminal")},
    }
    count = jax.ShapeDtypeStruct((), jnp.int32)

    def reset(key: jax.Array) -> tuple[jax.Array, Transition]:
        state, parts = io_callback(host.reset, (count, shape), jax.random.bits(key, (), jnp.uint32))
        return state, Transition(**parts, metrics={})

    def step(state: jax.Array, action: jax.Array) -> tuple[jax.Array, Transition]:
        # The state is the number of the last call. Each call needs the one before it, which keeps them in order.
        state, parts = io_callback(host.step, (count, shape), state, action)
        return state, Transition(**parts, metrics={})

    return FunctionalEnv(instances, host.obs_shape, host.action, reset, step)


class _Host:
    """The instances, and what they are asked by the training program."""

    def __init__(self, envs: list[Any]) -> None:
        self.envs = envs
        self.obs_shape, self._observe = read_observations(envs[0].observation_space)
        self.action, self._act = read_actions(envs[0].action_space)
        self._begun = [False] * len(envs)
        self._calls = -1

    def reset(self, seed: Any) -> tuple[np.int32, dict[str, Any]]:
        """First frames of new episodes."""
        first = [env.reset(seed=int(seed) % 2**31 + index)[0] for index, env in enumerate(self.envs)]
        self._begun = [True] * len(self.envs)
        self._calls += 1
        return np.int32(self._calls), self._stack([(self._observe(obs), 0.0, True, False, False) for obs in first])

    def step(self, count: Any, action: Any) -> tuple[np.int32, dict[str, Any]]:
        """Next frames. An episode begins anew where the last one has ended, or where the instances do not stand where
        the caller has left them: a run was resumed, or somebody else has moved them."""
        if int(count) != self._calls:
            self._begun = [False] * len(self.envs)
        self._calls += 1
        rows = []
        for index, env in enumerate(self.envs):
            if not self._begun[index]:
                rows.append((self._observe(env.reset()[0]), 0.0, True, False, False))
                self._begun[index] = True
                continue
            obs, reward, terminated, truncated, _ = env.step(self._act(np.asarray(action)[index]))
            ended = bool(terminated or truncated)
            self._begun[index] = not ended
            rows.append((self._observe(obs), float(reward), False, ended, bool(terminated)))
        return np.int32(self._calls), self._stack(rows)

    def _stack(self, rows: list[tuple]) -> dict[str, Any]:
        obs, reward, first, last, terminal = zip(*rows, strict=True)
        return {
            "obs": jax.tree.map(lambda *leaves: np.stack(leaves), *obs),
            "reward": np.asarray(reward, np.float32),
            "is_first": np.asarray(first),
            "is_last": np.asarray(last),
            "is_terminal": np.asarray(terminal),
        }


def read_observations(space: Any) -> tuple[ObsShape, Convert]:
    """Shape of a Gymnasium space for the learner, and the function that brings its samples into that shape."""
    kind = type(space).__name__
    if kind == "Dict":
        parts = {str(name): _read_one(part, f"observation '{name}'") for name, part in space.spaces.items()}
        shapes = {name: shape for name, (shape, _) in parts.items()}
        return shapes, lambda obs: {name: convert(obs[name]) for name, (_, convert) in parts.items()}
    return _read_one(space, "the observation")


def _read_one(space: Any, what: str) -> tuple[Shape, Convert]:
    kind, shape = type(space).__name__, space.shape
    if kind == "Box" and space.dtype == np.uint8 and len(shape) in (2, 3):
        image = (*shape, 1) if len(shape) == 2 else tuple(shape)
        return image, lambda obs: np.asarray(obs, np.uint8).reshape(image)
    if kind in ("Box", "MultiBinary"):
        return (int(np.prod(shape)),), lambda obs: np.asarray(obs, np.float32).reshape(-1)
    if kind == "Discrete":
        start, classes = int(space.start), int(space.n)
        return (classes,), lambda obs: (np.arange(classes) == obs - start).astype(np.float32)
    raise ValueError(
        f"{what} has the space {space}: known are boxes, classes, MultiBinary and one level of Dict. Wrap the "
        "environment, for instance in gymnasium.wrappers.FlattenObservation."
    )


def read_actions(space: Any) -> tuple[Box | Discrete, Convert]:
    """Kind of action for a Gymnasium space, and the function that makes its samples of the learner's actions."""
    kind = type(space).__name__
    if kind == "Discrete":
        start = int(space.start)
        return Discrete(int(space.n)), lambda action: start + int(action)
    if kind == "Box" and np.all(np.isfinite(space.low)) and np.all(np.isfinite(space.high)):
        middle, half = (space.high + space.low) / 2.0, (space.high - space.low) / 2.0

        def scale(action: np.ndarray) -> np.ndarray:
            return (middle + half * action.reshape(space.shape)).astype(space.dtype)

        return Box(int(np.prod(space.shape))), scale
    raise ValueError(
        f"the action has the space {space}: known are classes and boxes with finite bounds. Wrap the environment, for "
        "instance in gymnasium.wrappers.RescaleAction or TransformAction."
    )
