"""Check a task of a user's own before anything is compiled: trace its methods, and look at what they return."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.io.fields import shown
from whill_mjx.io.registry import failed
from whill_mjx.sensors.base import as_sensors
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.tasks.base import Budget, Task, World
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.world.people.contact import scene_with_people
from whill_mjx.world.scene import Footprint

METHODS = ("sample_world", "populate", "for_vehicle", "goal", "rewards", "endings", "observations")
"""What a task may define itself."""
NAME = re.compile("[A-Za-z][A-Za-z0-9_]{0,63}")
"""Of a task: part of file names, of Gymnasium's ids and of run.json."""
ALIKE = 0.85
"""Similarity (`difflib`) from which the name of a method is taken for a misspelling of one of METHODS."""


@lru_cache(maxsize=64)
def check_task(task: Task) -> None:
    """Raise ValueError, in one line, where a method of a task fails or does not return what its step needs.

    Nothing is computed: the methods are traced for shapes and types. The tasks of this package are passed over; their
    tests hold them to the same.
    """
    if type(task).__module__.startswith("whill_mjx."):
        return
    _check_names(type(task))
    _check_tables(task)
    world = check_world(task)
    if not isinstance(world, World):
        raise _wrong(task, "sample_world", f"returns {type(world).__name__}", "a World(scene, start)")
    if jnp.shape(world.start) != (3,):
        raise _wrong(task, "sample_world", f"start has shape {jnp.shape(world.start)}", "(3,): x, y [m], yaw [rad]")
    if task.people:
        world = _peopled(task, world)
    goal = _traced(task, "goal", world.scene)
    if getattr(goal, "shape", None) != (2,):
        raise _wrong(task, "goal", f"returns {_named(goal)}", "an array (2,): x, y [m]")
    moment = _moment(world)
    _check_scalars(task, "rewards", moment, "numbers", lambda dtype: not jnp.issubdtype(dtype, jnp.complexfloating))
    _check_scalars(task, "endings", moment, "flags (True or False)", lambda dtype: jnp.issubdtype(dtype, jnp.bool_))
    _check_observations(task)


def fitted_task(task: Task, spec: VehicleSpec) -> Task:
    """The task as a vehicle needs it; ValueError where its method fails or returns something else."""
    try:
        fitting = task.for_vehicle(spec)
    except (Exception, SystemExit) as error:
        raise _failed(task, "for_vehicle", error) from error
    if not isinstance(fitting, Task):
        raise _wrong(task, "for_vehicle", f"returns {_named(fitting)}", "a Task")
    return fitting


def check_name(task: Task) -> None:
    """Raise ValueError for a name that could be no part of a file's name or of Gymnasium's ids."""
    if not isinstance(task.name, str) or not NAME.fullmatch(task.name):
        raise ValueError(f"task {type(task).__name__}: its name is {shown(task.name)}; it must be letters, digits "
                         "and _, a letter first. Correct it, or leave it out for the name of the class.")


def _check_tables(task: Task) -> None:
    """Refuse budgets or sweeps of another kind than the library asks for."""
    for name, holds, wanted in (
        ("budgets", _is_table(task.budgets), "a dict of Budgets by the name of a preset"),
        ("sweeps", _is_texts(task.sweeps), "a tuple of texts such as 'light=0.5,1'"),
        ("per_period", _is_texts(task.per_period), "a tuple of names of reward terms"),
    ):
        if not holds:
            raise ValueError(f"task {task.name!r}: {name} is {shown(getattr(task, name))}; it must be {wanted}. "
                             "Correct it.")


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping) and all(isinstance(one, Budget) for one in value.values())


def _is_texts(value: Any) -> bool:
    return isinstance(value, (tuple, list)) and all(isinstance(one, str) for one in value)


def _check_observations(task: Task) -> None:
    """Refuse observations that are no sensors."""
    try:
        as_sensors(task.observations(), known_sensors())
    except (Exception, SystemExit) as error:
        raise _failed(task, "observations", error) from error


def check_world(task: Task) -> Any:
    """What `sample_world` returns, as shapes; ValueError where it fails, as with a map that cannot be read."""
    key = _abstract((), jax.dtypes.prng_key)
    if type(task).__module__.startswith("whill_mjx."):
        return jax.eval_shape(task.sample_world, key)
    return _traced(task, "sample_world", key)


def _check_names(kind: type) -> None:
    """Refuse a method whose name is nearly one of METHODS: the default would be used without a word."""
    for name, value in vars(kind).items():
        if isinstance(value, FunctionType) and name not in METHODS and not name.startswith("_"):
            meant = difflib.get_close_matches(name, METHODS, 1, ALIKE)
            if meant and meant[0] not in vars(kind):
                raise ValueError(f"task {kind.__name__}: its method {name!r} is never called; {meant[0]!r} would be. "
                                 f"Call it so, or _{name} if it is another.")


def _check_scalars(task: Task, method: str, moment: Any, what: str, fits: Any) -> None:
    terms = _traced(task, method, moment)
    if not isinstance(terms, Mapping) or not terms:
        there = "an empty dict" if isinstance(terms, Mapping) else _named(terms)
        raise _wrong(task, method, f"returns {there}", f"a dict of {what} by name")
    for name, value in terms.items():
        if not isinstance(name, str):
            raise _wrong(task, method, f"has the name {shown(name)}", "a text")
        if getattr(value, "shape", None) != () or not fits(value.dtype):
            raise _wrong(task, method, f"{name!r} is {_named(value)}", f"one of the {what}, of shape ()")


def _traced(task: Task, method: str, argument: Any) -> Any:
    """What a method returns for an argument, as shapes."""
    try:
        return jax.eval_shape(getattr(task, method), argument)
    except (Exception, SystemExit) as error:
        raise _failed(task, method, error) from error


def _failed(task: Task, method: str, error: BaseException) -> ValueError:
    return failed(f"task {task.name!r}", type(task), method, error)


def _wrong(task: Task, method: str, found: str, needed: str) -> ValueError:
    return ValueError(f"task {task.name!r}: {method}: {found}; it must be {needed}. Correct the method.")


def _named(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype} of shape {value.shape}"
    return type(value).__name__


def _abstract(shape: tuple[int, ...], dtype: Any) -> Any:
    if dtype is jax.dtypes.prng_key:
        return jax.eval_shape(jax.random.key, 0)
    return jax.ShapeDtypeStruct(shape, dtype)


def _peopled(task: Task, world: World) -> World:
    """The world with its people, as shapes."""
    key = _abstract((), jax.dtypes.prng_key)

    def fill(key: jax.Array, world: World) -> World:
        return replace(world, scene=scene_with_people(world.scene, task.populate(key, world), key))

    try:
        return jax.eval_shape(fill, key, world)
    except (Exception, SystemExit) as error:
        raise _failed(task, "populate", error) from error


def _moment(world: World) -> Moment:
    """A moment of a world, as shapes."""
    number, flag, pair = (_abstract(shape, kind) for shape, kind in (((), float), ((), bool), ((2,), float)))
    body = Footprint(*[number] * len(Footprint.__dataclass_fields__))
    return Moment(
        scene=world.scene, pose=_abstract((3,), float), twist=pair, body=body, command=pair, previous_command=pair,
        goal_distance=number, previous_goal_distance=number, collided=flag, reached=flag, diverged=flag, time_s=number,
    )  # fmt: skip
