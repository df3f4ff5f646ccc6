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

from dreamer.refusals import whole
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
        ValueError: a space that the learner does not know, instances that are not alike, or the same one twice. In a
            training: what an environment returned, and the rule that it breaks; JAX shows it at the end of an error
            of its own.
    """
    instances = whole("instances", instances, 1)
    if isinstance(make, str):
        import gymnasium

        host = _Host([gymnasium.make(make) for _ in range(instances)])
    elif callable(make):
        host = _Host([make() for _ in range(instances)])
    else:
        raise ValueError(f"make is a {type(make).__name__}; it must be a name for gymnasium.make or a function that "
                         "returns a new environment. Give lambda: MyEnv().")
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
        _check_alike(envs)
        self.obs_shape, self._observe = read_observations(envs[0].observation_space)
        self.action, self._act = read_actions(envs[0].action_space)
        self._begun = [False] * len(envs)
        self._calls = -1

    def reset(self, seed: Any) -> tuple[np.int32, dict[str, Any]]:
        """First frames of new episodes."""
        first = [_begun(env, index, seed=int(seed) % 2**31 + index) for index, env in enumerate(self.envs)]
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
                rows.append((self._observe(_begun(env, index)), 0.0, True, False, False))
                self._begun[index] = True
                continue
            after = env.step(self._act(np.asarray(action)[index]))
            obs, reward, terminated, truncated, _ = _parts(after, 5, f"step of instance {index}")
            ended = bool(terminated or truncated)
            self._begun[index] = not ended
            rows.append((self._observe(obs), _reward(reward, index), False, ended, bool(terminated)))
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


def _check_alike(envs: list[Any]) -> None:
    """Raise ValueError where instances are one and the same, are no environments, or have other spaces."""
    if len({id(env) for env in envs}) < len(envs):
        raise ValueError("make returned the same environment twice: its instances would move each other. Let it return "
                         "a new one at each call.")
    for index, env in enumerate(envs):
        for name in ("observation_space", "action_space"):
            if getattr(env, name, None) is None:
                raise ValueError(f"make returned a {type(env).__name__} without {name}; it must be a Gymnasium "
                                 "environment. Correct it.")
            if getattr(env, name) != getattr(envs[0], name):
                raise ValueError(f"{name} of instance {index} is {getattr(env, name)}, and {getattr(envs[0], name)} of "
                                 "instance 0: all must have the same. Correct make.")


def _begun(env: Any, index: int, **seed: int) -> Any:
    """The first observation of a new episode."""
    return _parts(env.reset(**seed), 2, f"reset of instance {index}")[0]


def _parts(returned: Any, count: int, what: str) -> tuple:
    """What reset or step has returned, with as many parts as in Gymnasium, the last one a dict."""
    if not isinstance(returned, tuple) or len(returned) != count or not isinstance(returned[-1], dict):
        wanted = "(obs, info)" if count == 2 else "(obs, reward, terminated, truncated, info)"
        size = f" of {len(returned)}" if isinstance(returned, tuple) else ""
        raise ValueError(f"{what} returned a {type(returned).__name__}{size}; it must be {wanted}, as in Gymnasium. An "
                         "environment of the older Gym needs a wrapper, such as shimmy's.")
    return returned


def _reward(reward: Any, index: int) -> float:
    """A reward as a number of Python."""
    value = np.asarray(reward)
    if value.size != 1 or value.dtype.kind not in "biuf" or not np.isfinite(value).all():
        raise ValueError(f"step of instance {index}: the reward is {reward!r}; it must be one finite number. Correct "
                         "the environment.")
    return float(value.item())


def read_observations(space: Any) -> tuple[ObsShape, Convert]:
    """Shape of a Gymnasium space for the learner, and the function that brings its samples into that shape."""
    kind = type(space).__name__
    if kind == "Dict":
        parts = {str(name): _read_one(part, f"observation '{name}'") for name, part in space.spaces.items()}
        shapes = {name: shape for name, (shape, _) in parts.items()}
        return shapes, lambda obs: {name: convert(_entry(obs, name)) for name, (_, convert) in parts.items()}
    return _read_one(space, "the observation")


def _read_one(space: Any, what: str) -> tuple[Shape, Convert]:
    kind, shape = type(space).__name__, space.shape
    if kind == "Box" and space.dtype == np.uint8 and len(shape) in (2, 3):
        image = (*shape, 1) if len(shape) == 2 else tuple(shape)
        return image, lambda obs: _array(what, obs, shape, np.uint8).reshape(image)
    if kind in ("Box", "MultiBinary"):
        return (int(np.prod(shape)),), lambda obs: _array(what, obs, shape, np.float32).reshape(-1)
    if kind == "Discrete":
        start, classes = int(space.start), int(space.n)
        return (classes,), lambda obs: _one_hot(what, obs, start, classes)
    raise ValueError(
        f"{what} has the space {space}: known are boxes, classes, MultiBinary and one level of Dict. Wrap the "
        "environment, for instance in gymnasium.wrappers.FlattenObservation."
    )


def _entry(obs: Any, name: str) -> Any:
    if not hasattr(obs, "keys") or name not in obs:
        there = sorted(map(str, obs)) if hasattr(obs, "keys") else f"a {type(obs).__name__}"
        raise ValueError(f"the observation has no '{name}', which its space has (it is or has: {there}). Correct the "
                         "environment.")
    return obs[name]


def _array(what: str, obs: Any, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An observation as its space says: of this shape, finite, and the same numbers in this type if they are bytes."""
    value = np.asarray(obs)
    if value.shape != shape or value.dtype.kind not in "biuf":
        raise ValueError(f"{what} is {value.dtype} of shape {value.shape}; its space says numbers of shape {shape}. "
                         "Correct the environment or its space.")
    if value.dtype == dtype == np.uint8:
        return value
    with np.errstate(over="ignore", invalid="ignore"):
        cast = value.astype(dtype)
    if not np.isfinite(cast).all() or (dtype == np.uint8 and not np.array_equal(cast, value)):
        rule = "whole numbers from 0 to 255" if dtype == np.uint8 else "finite numbers"
        raise ValueError(f"{what} has values from {value.min()} to {value.max()}; they must be {rule}. Correct the "
                         "environment.")
    return cast


def _one_hot(what: str, obs: Any, start: int, classes: int) -> np.ndarray:
    vector = (np.arange(classes) == np.asarray(obs) - start).astype(np.float32)
    if vector.sum() != 1:
        raise ValueError(f"{what} is {obs!r}; its space has the classes {start} to {start + classes - 1}. Correct the "
                         "environment or its space.")
    return vector


def read_actions(space: Any) -> tuple[Box | Discrete, Convert]:
    """Kind of action for a Gymnasium space, and the function that makes its samples of the learner's actions."""
    kind = type(space).__name__
    if kind == "Discrete":
        start = int(space.start)
        return Discrete(int(space.n)), lambda action: start + int(action)
    if kind == "Box" and np.all(np.isfinite(space.low)) and np.all(np.isfinite(space.high)):
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        middle, half = high / 2.0 + low / 2.0, high / 2.0 - low / 2.0

        def scale(action: np.ndarray) -> np.ndarray:
            value = np.clip(middle + half * action.reshape(space.shape), low, high)
            return (np.rint(value) if space.dtype.kind in "iu" else value).astype(space.dtype)

        return Box(int(np.prod(space.shape))), scale
    raise ValueError(
        f"the action has the space {space}: known are classes and boxes with finite bounds. Wrap the environment, for "
        "instance in gymnasium.wrappers.RescaleAction or TransformAction."
    )
