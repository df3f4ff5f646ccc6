"""Check a task of a user's own before anything is compiled: trace its methods, and look at what they return."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.dtypes import canonicalize_dtype as canonical
from jax.extend.core import Literal

from whill_mjx.io.fields import shown
from whill_mjx.io.own_class import ALIKE, check_fixed, check_own_class
from whill_mjx.io.registry import failed
from whill_mjx.sensors.base import as_sensors
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.tasks.base import Budget, Task, World
from whill_mjx.tasks.terms import Moment
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.world.people.contact import scene_with_people
from whill_mjx.world.scene import Footprint, Scene

COUNTED = ("success", "collision")
"""Endings that evaluations report of every task."""
NAME = re.compile("[A-Za-z][A-Za-z0-9_]{0,63}")
"""Of a task: part of file names, of Gymnasium's ids and of run.json."""


@lru_cache(maxsize=64)
def check_task(task: Task) -> None:
    """Raise ValueError, in one line, where a method of a task fails or does not return what its step needs.

    Nothing is computed: the methods are traced for shapes and types. The tasks of this package are passed over; their
    tests hold them to the same.
    """
    if type(task).__module__.startswith("whill_mjx."):
        return
    check_own_class(f"task {task.name!r}", type(task), Task)
    _check_tables(task)
    world = check_world(task)
    if not isinstance(world, World):
        raise _wrong(task, "sample_world", f"returns {type(world).__name__}", "a World(scene, start)")
    if not isinstance(world.scene, Scene):
        raise _wrong(task, "sample_world", f"the scene of its World is {_named(world.scene)}", "a Scene")
    if getattr(world.start, "shape", None) != (3,):
        shape = getattr(world.start, "shape", None)
        there = f"is {_named(world.start)}" if shape is None else f"has shape {shape}"
        raise _wrong(task, "sample_world", f"start {there}", "an array (3,): x, y [m], yaw [rad]")
    if task.people:
        world = _peopled(task, world)
    goal = _traced(task, "goal", world.scene)
    if getattr(goal, "shape", None) != (2,):
        raise _wrong(task, "goal", f"returns {_named(goal)}", "an array (2,): x, y [m]")
    moment = _moment(world)
    real = lambda dtype: not jnp.issubdtype(dtype, jnp.complexfloating)  # noqa: E731
    terms = _check_scalars(task, "rewards", moment, "numbers", real)
    _check_constants(task, moment, terms)
    ends = _check_scalars(task, "endings", moment, "flags (True or False)", lambda dtype: jnp.issubdtype(dtype, bool))
    _check_terms(task, terms, ends)
    _check_observations(task)


def check_is_task(task: Any) -> None:
    """Raise ValueError for anything else than a task, such as its class, and for one with a list or array in it."""
    if not isinstance(task, Task):
        raise ValueError(f"task is {task!r}; give a Task such as Corridor(), or the name of one.")
    check_fixed(f"task {task.name!r}", task)


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
    """Refuse tables of another kind than the library asks for, and ranges of no field."""
    names = {field.name for field in fields(task)}
    for name, holds, wanted in (
        ("budgets", _is_table(task.budgets), "a dict of Budgets by the name of a preset"),
        ("sweeps", _is_texts(task.sweeps), "a tuple of texts such as 'light=0.5,1'"),
        ("per_period", _is_texts(task.per_period), "a tuple of names of reward terms"),
        ("ranges", all(one.name in names for one in task.ranges), "a tuple of Fields with the names of its fields"),
        ("walls", isinstance(task.walls, int) and not isinstance(task.walls, bool), "a whole number"),
        ("lane", isinstance(task.lane, bool), "True or False"),
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


def why_no_world(task: Task) -> str:
    """What a world of a task cannot be drawn without, such as a map; nothing for most tasks."""
    try:
        check_world(task)
    except ValueError as error:
        return str(error)
    return ""


def ending_names(task: Task) -> tuple[str, ...]:
    """Names of a task's own endings; ValueError where a method of it fails."""
    world = check_world(task)
    return tuple(_traced(task, "endings", _moment(_peopled(task, world) if task.people else world)))


def _check_terms(task: Task, terms: Mapping[str, Any], ends: Mapping[str, Any]) -> None:
    """Refuse names that mean nothing: of terms that the rewards lack, and misspelt ones of endings that are counted."""
    if task.per_period is not Task.per_period:
        for name in set(task.per_period) - set(terms):
            raise ValueError(f"task {task.name!r}: per_period has {name!r}, which is no reward term (there are: "
                             f"{', '.join(terms)}). Correct it.")
    for name in ends:
        meant = difflib.get_close_matches(name, COUNTED, 1, ALIKE)
        if meant and meant[0] not in ends:
            raise ValueError(f"task {task.name!r}: endings: {name!r} is not counted as {meant[0]!r}. Call it so, or by "
                             "another name.")


def _check_scalars(task: Task, method: str, moment: Any, what: str, fits: Any) -> Mapping[str, Any]:
    terms = _traced(task, method, moment)
    if not isinstance(terms, Mapping) or not terms:
        there = "an empty dict" if isinstance(terms, Mapping) else _named(terms)
        raise _wrong(task, method, f"returns {there}", f"a dict of {what} by name")
    for name, value in terms.items():
        if not isinstance(name, str):
            raise _wrong(task, method, f"has the name {shown(name)}", "a text")
        if getattr(value, "shape", None) != () or not fits(value.dtype):
            raise _wrong(task, method, f"{name!r} is {_named(value)}", f"one of the {what}, of shape ()")
    return terms


def _check_constants(task: Task, moment: Any, terms: Mapping[str, Any]) -> None:
    """Refuse a reward term that is the same in every moment and no finite number: no step could ever earn it."""
    program = jax.make_jaxpr(task.rewards)(moment).jaxpr
    varying = set(program.invars)
    for line in program.eqns:
        if any(one in varying for one in line.invars if not isinstance(one, Literal)):
            varying |= set(line.outvars)
    names = jax.tree.leaves({name: name for name in terms})
    same = [name for name, out in zip(names, program.outvars, strict=True) if isinstance(out, Literal)
            or out not in varying]
    if not same:
        return

    def constants(moment: Any) -> list[Any]:
        terms = task.rewards(moment)
        return [terms[name] for name in same]

    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        values = jax.jit(constants)(_zeros(moment))  # an argument: what depends on it is left out of the program
    for name, value in zip(same, jax.device_get(values), strict=True):
        if not np.isfinite(value):
            raise _wrong(task, "rewards", f"{name!r} is always {value}", "a finite number")


def _zeros(tree: Any) -> Any:
    """Arrays of these shapes, for a program that reads none of their values."""
    key = jax.dtypes.prng_key

    def zero(one: Any) -> jax.Array:
        return jax.random.key(0) if jnp.issubdtype(one.dtype, key) else jnp.zeros(one.shape, canonical(one.dtype))

    return jax.tree.map(zero, tree)


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
