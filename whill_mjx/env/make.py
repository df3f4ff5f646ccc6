"""Environments by the names of their tasks, vehicles, looks and sensors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from whill_mjx.env.episode import reset
from whill_mjx.env.moments import view_of
from whill_mjx.env.records import Env
from whill_mjx.io.fields import check, parameter_field, shown
from whill_mjx.sensors.base import Sensor, as_sensors, check_sensor
from whill_mjx.sensors.registry import known_sensors
from whill_mjx.tasks.check import check_is_task, check_task, fitted_task
from whill_mjx.tasks.tasks import Task, make_task
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams, parameters_of
from whill_mjx.vehicle.vehicle_file import load_vehicle
from whill_mjx.world.maps.places import farthest_move
from whill_mjx.world.scene import MapWalls

LOOKS = ("plain", "paper", "rich")
"""What changes the picture from episode to episode: nothing, what the paper randomises, a furnished room."""
DEFAULT_VEHICLE = "whill_cr_ramp"
"""The paper's identified WHILL with its ramp."""


def make_env(
    task: str | Task = "obstacle_course",
    vehicle: str | Path | VehicleSpec | tuple[VehicleSpec, VehicleParams] | None = None,
    layout: str | None = None,
    random_looks: bool | None = None,
    photometric: bool | None = None,
    height: int = 64,
    width: int = 64,
    exploring_starts: float = 0.0,
    looks: str | None = None,
    observations: Mapping[str, Sensor] | Sequence[str] | None = None,
) -> tuple[Env, VehicleParams]:
    """Environment, and the nominal parameters of its vehicle.

    Args:
        task: a task with its fields set, the name of a known one, package.module:TASK or path/to/file.py:TASK.
        vehicle: path of a vehicle file, the name of a preset, a spec (with the physical base model), or a spec and its
            parameters; None takes the built-in WHILL Model CR.
        layout: "randomised" or "fixed"; None keeps the task's own.
        random_looks, photometric: see `Env`; None takes those of the task's looks, and none where all worlds
            are the same.
        height, width: image size [pixels].
        exploring_starts: see `Env`.
        looks: one of LOOKS, which sets `random_looks`, `photometric` and `rich`: "plain" draws nothing, "paper" what
            the paper randomises, "rich" a furnished room. None takes those of the task, and none where all worlds are
            the same; the two arguments count more than the task's.
        observations: sensors by name, or names of the package's sensors (`whill_mjx.sensors`); observations are then a
            dict. None takes those of the task, and the camera image alone, as an array, where it names none.

    Raises:
        ValueError: unknown task, layout, vehicle, looks or sensor; a parameter of the vehicle out of its range; a
            method of the task that fails or returns something else than it must; a share that is none; rich looks of a
            task without a lane.
    """
    task = make_task(task) if isinstance(task, str) else task
    check_is_task(task)
    if layout is not None:
        task = dataclasses.replace(task, layout=layout)
    spec, params = as_vehicle(vehicle)
    task = fitted_task(task, spec)
    check_task(task)
    chosen = task.observations() if observations is None else observations
    if looks is not None:
        random_looks = photometric = None
    looks = _looks_of(task, looks)
    env = Env(
        build_model(spec),
        task,
        height,
        width,
        looks == "paper" if random_looks is None else random_looks,
        looks == "paper" if photometric is None else photometric,
        exploring_starts,
        looks == "rich",
        as_sensors(chosen, known_sensors()),
    )
    _check_own(env, params)
    return env, params


def _check_own(env: Env, params: VehicleParams) -> None:
    """Trace the first frame with a task or sensors from outside this package; ValueError says what is wrong in them."""
    own = {name: sensor for name, sensor in env.sensors if not type(sensor).__module__.startswith("whill_mjx.")}
    if own or not type(env.task).__module__.startswith("whill_mjx."):
        bare = dataclasses.replace(env, sensors=())
        state, _ = jax.eval_shape(lambda seed: reset(bare, params, jax.random.key(seed)), 0)
        _check_walls(env, state.scene.walls)
        for name, sensor in own.items():
            check_sensor(name, sensor, lambda state: view_of(env, params, state), state)


def _check_walls(env: Env, walls: MapWalls | None) -> None:
    """Refuse walls of a map that are listed too near for the vehicle: it would drive into them before it meets them."""
    task, spec = env.task, env.model.spec
    speed = max(abs(task.v_min), abs(task.v_max))
    moves = farthest_move(spec, speed, task.omega_max, env.model.config.control_dt)
    needed = math.hypot(spec.body_length, spec.body_width) / 2 + moves
    if walls is not None and walls.within < needed:
        raise ValueError(f"task {task.name!r}: sample_world: the walls of its map are listed within "
                         f"{walls.within:g} m, and the vehicle {spec.name!r}, with body_length {spec.body_length:g} m "
                         f"and body_width {spec.body_width:g} m, needs {needed:.2f} m. Make them with map_walls(..., "
                         "near=...), or with make_map_scene(grid, reach_of(spec)) in for_vehicle.")


def _looks_of(task: Task, looks: str | None) -> str:
    """The looks asked for, or the task's own; raises ValueError where there are none such."""
    if looks is None:
        looks = task.looks if task.randomised else "plain"
    if looks not in LOOKS:
        raise ValueError(f"looks is {looks!r}; use one of {LOOKS}.")
    if looks == "rich" and not task.lane:
        raise ValueError(f"task {task.name!r} has no lane of three walls that could be furnished; use other looks than "
                         "'rich'.")
    return looks


def _check_values(spec: VehicleSpec, params: VehicleParams) -> None:
    """Raise ValueError for a parameter beyond what the vehicle's file may have; values of a trace are not known yet."""
    sizes = spec.mass, spec.wheel_radius
    for holder, owner in (("body", params.body), *((effect.name, effect) for effect in params.effects)):
        for name, about in parameters_of(owner).items():
            value, dotted = getattr(owner, name), f"{holder}.{name}"
            allowed = parameter_field(dotted, about.unit, about.low, about.high, about.neutral, sizes)
            low, high = (float(np.float32(end)) for end in (allowed.low, allowed.high))  # as the value was rounded
            allowed = dataclasses.replace(allowed, low=min(low, allowed.low), high=max(high, allowed.high))
            for number in () if isinstance(value, jax.core.Tracer) else np.unique(np.asarray(value)):
                check(f"vehicle {spec.name!r}", allowed, number)


def as_vehicle(
    vehicle: str | Path | VehicleSpec | tuple[VehicleSpec, VehicleParams] | None,
) -> tuple[VehicleSpec, VehicleParams]:
    """Spec and parameters of a vehicle as `make_env` takes it."""
    if isinstance(vehicle, VehicleSpec):
        return vehicle, preset_params(vehicle, "physical")
    if isinstance(vehicle, tuple):
        if [type(one) for one in vehicle] != [VehicleSpec, VehicleParams]:
            there = ", ".join(type(one).__name__ for one in vehicle)
            raise ValueError(f"vehicle is ({there}); a pair is a VehicleSpec and its VehicleParams. Give both.")
        _check_values(*vehicle)
        return vehicle
    if not isinstance(vehicle, str | Path | None):
        raise ValueError(f"vehicle is {shown(vehicle)}; it must be a vehicle file, the name of a built-in vehicle, a "
                         "VehicleSpec, or a spec with its parameters. Give one of them.")
    spec, params, _ = load_vehicle(DEFAULT_VEHICLE if vehicle is None else vehicle)
    return spec, params
