"""What all Gymnasium environments of one kind in a process share: the static environment, spaces, compiled programs.

A kind is a task with its fields, a vehicle with its parameters, what is observed, and how worlds and vehicles vary. The
first environment of a kind compiles, every other one is ready at once.
"""

from __future__ import annotations

import copy
import dataclasses
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.batch import BatchEnv, BatchState, make_batch
from whill_mjx.devices import find_device, held_to
from whill_mjx.env import EVENT_METRICS, POSE_METRICS, make_env, observe
from whill_mjx.evaluation.conditions import NAMES, Condition, arranged, begin_under, nominal
from whill_mjx.io.fields import CONDITION, check, shown
from whill_mjx.io.garbage import undisturbed
from whill_mjx.sensors.base import as_sensors
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.tasks.tasks import find_task
from whill_mjx.vehicle.types import TimeStep, VehicleParams

OPTIONS = tuple(name for name in NAMES if name != "latency" and not name.startswith("camera_"))
"""What `reset(options=...)` may change of an episode; docs/evaluate.md says what each means."""
COUNTED = ("timeout", "time_s", "episode_return")
"""Metrics of an end that are in no `info`: Gymnasium reports them otherwise."""
FORKED = (
    "JAX was started before this process was forked, and its threads do not survive a fork: the environment would "
    'hang. Use gymnasium.vector.AsyncVectorEnv(..., context="spawn"), or WhillVectorEnv, which computes all '
    "instances in one program."
)


@dataclass(frozen=True, eq=False)
class Kind:
    """Compiled once per process and number of instances."""

    batch: BatchEnv
    device: jax.Device | None
    """Where all of it is computed; None takes JAX's own choice."""
    observation_space: gymnasium.Space
    action_space: gymnasium.spaces.Box

    @property
    def steps_per_second(self) -> float:
        """Environment steps in a second of the simulated time: the frame rate of a video."""
        env = self.batch.env
        return round(1.0 / (env.model.config.control_dt * env.task.action_repeat), 6)

    @cached_property
    def reset(self) -> Any:
        """(number () of the episode, condition or None) -> state and first time step of one instance."""

        def begin(number: jax.Array, condition: Condition | None) -> tuple[BatchState, TimeStep]:
            return strong(self._begin_one(jax.random.key(number), condition))

        return self._program(begin)

    @cached_property
    def step(self) -> Any:
        """(state, action) -> state and time step of one instance."""
        return self._program(lambda state, action: strong(self.batch.step_one(state, action)))

    @cached_property
    def reset_all(self) -> Any:
        """(numbers (N,) of the episodes, condition or None) -> state and first time steps."""

        def begin(numbers: jax.Array, condition: Condition | None) -> tuple[BatchState, TimeStep]:
            return strong(jax.vmap(lambda number: self._begin_one(jax.random.key(number), condition))(numbers))

        return self._program(begin)

    @cached_property
    def step_all(self) -> Any:
        """(state, actions (N, 2)) -> state and time steps; nothing begins anew."""
        return self._program(lambda state, actions: strong(jax.vmap(self.batch.step_one)(state, actions)))

    @cached_property
    def step_or_reset(self) -> Any:
        """(state, actions (N, 2)) -> state and time steps; instances that have ended begin a new episode instead."""
        return self._program(lambda state, actions: strong(self.batch.step(state, actions)))

    @cached_property
    def restart(self) -> Any:
        """(state, time steps, mask (N,), numbers (N,)) -> the same with new episodes where the mask is set."""

        def begin(state: BatchState, steps: TimeStep, mask: jax.Array, numbers: jax.Array):
            fresh = jax.vmap(lambda number: self.batch.begin_one(jax.random.key(number)))(numbers)

            def choose(new: jax.Array, old: jax.Array) -> jax.Array:
                return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            return strong(jax.tree.map(choose, fresh, (state, steps)))

        return self._program(begin)

    @cached_property
    def picture(self) -> Any:
        """State -> camera image (H, W, 3) uint8 of one instance."""
        return self._program(lambda state: observe(self.batch.env, state.env))

    def _begin_one(self, origin: jax.Array, condition: Condition | None) -> tuple[BatchState, TimeStep]:
        if condition is None:
            return self.batch.begin_one(origin)
        env = arranged(condition, self.batch.env)
        return dataclasses.replace(self.batch, env=env).begin_one(
            origin, lambda params, state: begin_under(condition, env, params, state)
        )

    def _program(self, function: Callable[..., Any]) -> Any:
        """`function` compiled; Python collects no garbage while JAX traces it."""
        return held_to(self.device, jax.jit(undisturbed(function)))


def strong(tree: Any) -> Any:
    """The arrays with types that do not give way: a state from a reset and one from a step are then of one program."""
    return jax.tree.map(lambda leaf: leaf if _is_key(leaf) else jnp.asarray(leaf, jnp.asarray(leaf).dtype), tree)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class Carried:
    """An environment that can be pickled and copied: its arrays travel, its compiled programs stay."""

    _arguments: dict[str, Any]
    """Of `find_kind`."""

    def _take(self, kind: Kind) -> None:
        """Use the programs and spaces of a kind."""
        raise NotImplementedError

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in self.__dict__.items()
                if name not in ("_kind", "env", "params") and not name.endswith("_space")}
        return {name: jax.tree.map(_to_host, value) if name in CARRIED else value for name, value in kept.items()}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        self._take(find_kind(self._arguments))
        for name in CARRIED & kept.keys():
            setattr(self, name, jax.tree.map(_from_host, kept[name], is_leaf=lambda leaf: isinstance(leaf, _Key)))

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        other = type(self).__new__(type(self))
        other.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        return other


CARRIED = {"_state", "_step"}
"""Attributes that hold arrays of the device."""


class _Key:
    """A random key on its way to another process."""

    def __init__(self, data: np.ndarray):
        self.data = data


def _to_host(leaf: Any) -> Any:
    return _Key(np.asarray(jax.random.key_data(leaf))) if _is_key(leaf) else np.asarray(leaf)


def _from_host(leaf: Any) -> Any:
    return jax.random.wrap_key_data(jnp.asarray(leaf.data)) if isinstance(leaf, _Key) else jnp.asarray(leaf)


_KINDS: dict[Any, Kind] = {}
_forked = False


def find_kind(arguments: Mapping[str, Any]) -> Kind:
    """The kind of environment that these arguments of `make_env`, and `spread`, give.

    Raises:
        ValueError: of `make_env`.
        RuntimeError: this process was forked from one in which JAX runs, and the kind is new.
    """
    key = _key_of(arguments)
    if key not in _KINDS:
        if _forked:
            raise RuntimeError(FORKED)
        _KINDS[key] = _make_kind(dict(arguments))
    return _KINDS[key]


def check_process() -> None:
    """Raise RuntimeError in a process that was forked from one in which JAX runs."""
    if _forked:
        raise RuntimeError(FORKED)


def _make_kind(arguments: dict[str, Any]) -> Kind:
    spread, device = arguments.pop("spread", 0.0), find_device(arguments.pop("device", None))
    env, params = held_to(device, make_env)(**arguments)
    same = (device, *_static(env, params, spread))
    if same in _KINDS:
        return _KINDS[same]
    actions = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    batch = held_to(device, make_batch)(env, params, 1, spread)
    _KINDS[same] = Kind(batch, device, space_of(env), actions)
    return _KINDS[same]


def _static(env: Any, params: Any, spread: float) -> Any:
    """What makes two environments the same program."""
    parts = [getattr(env, field.name) for field in dataclasses.fields(env) if field.name != "model"]
    leaves, tree = jax.tree.flatten(params)
    return (env.model.spec, env.model.config, *parts, tree, tuple(float(leaf) for leaf in leaves), spread)


def _key_of(arguments: Mapping[str, Any]) -> Any:
    """Arguments as they were given; files of a vehicle or a task count by their content."""
    values = []
    for name in sorted(arguments):
        value = arguments[name]
        if name == "vehicle" and isinstance(value, str | os.PathLike) and os.path.isfile(value):
            value = (os.path.abspath(value), os.stat(value).st_mtime_ns)
        if name == "task" and isinstance(value, str):
            value = find_task(value)  # its file may have been edited
        elif name == "observations" and value is not None:
            value = as_sensors(value, known_sensors())
        elif isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], VehicleParams):
            leaves, tree = jax.tree.flatten(value[1])
            value = (value[0], tree, tuple(float(leaf) for leaf in leaves))
        values.append((name, value if _hashes(value) else repr(value)))  # `make_env` says what is wrong with it
    return tuple(values)


def _hashes(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True


def space_of(env: Any) -> gymnasium.Space:
    """Observation space of an environment: a box of bytes, or a dict of the sensors' boxes."""
    if not env.sensors:
        return gymnasium.spaces.Box(0, 255, (env.height, env.width, 3), np.uint8)
    boxes: dict[str, gymnasium.Space] = {}
    for name, sensor in env.sensors:
        reading = sensor.reading(env)
        boxes[name] = gymnasium.spaces.Box(reading.low, reading.high, reading.shape, reading.dtype)
    return gymnasium.spaces.Dict(boxes)


def condition_of(options: Mapping[str, Any] | None) -> Condition | None:
    """The condition that `reset(options=...)` asks for; None where it asks for nothing.

    Raises:
        ValueError: an unknown option, or a value that is no number or out of its range.
    """
    if not options:
        return None
    if not isinstance(options, Mapping):
        raise ValueError(f'options is {options!r}; it must be a dict such as {{"start_y": 0.2}}. Correct it.')
    for name, value in options.items():
        if name not in OPTIONS:
            raise ValueError(f"reset has no option {name!r} (known: {', '.join(OPTIONS)}). Correct the name, or leave "
                             "it out.")
        check("reset", CONDITION[name], value, f"option {name}")
    return dataclasses.replace(nominal(), **{name: jnp.asarray(value, float) for name, value in options.items()})


def as_actions(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Actions as numbers of a shape; NaN and infinities pass: they stand still and end the episode.

    Raises:
        ValueError: another shape, or no numbers.
    """
    try:
        found = np.asarray(actions)
    except ValueError:  # rows of several lengths
        found = np.empty((), object)
    if found.dtype.name == "bfloat16":  # of JAX; NumPy has no kind for it
        found = found.astype(np.float32)
    if found.dtype.kind not in "biuf" or found.shape != shape:
        there = f"has shape {found.shape}" if found.dtype.kind in "biuf" else f"is {shown(actions)}"
        raise ValueError(f"the action {there}; it must be numbers of shape {shape}: speed and yaw rate in [-1, 1].")
    return found.astype(np.float32)


def info_names(metrics: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Names of the numbers and of the flags of an `info`."""
    numbers = [*POSE_METRICS, *(name for name in EVENT_METRICS if name in metrics)]
    return numbers, [name for name in metrics if name not in (*numbers, *COUNTED)]


def _after_fork() -> None:
    global _forked
    from jax._src import xla_bridge

    started = getattr(xla_bridge, "backends_are_initialized", None)
    _forked = started() if started else True


os.register_at_fork(after_in_child=_after_fork)
