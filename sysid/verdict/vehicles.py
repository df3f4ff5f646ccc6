"""The vehicles of a result: the base refitted to the drives, and the same with the effects that were found."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.errors.space import make_space, searched
from sysid.logs.records import Trial
from sysid.missing.catalogue import base_values
from sysid.missing.drives import Drives, make_drives
from sysid.missing.pose_fit import fit_poses
from sysid.missing.refit import Refitter
from sysid.missing.signatures import base_columns
from sysid.replay.models import measured_effects, with_effects
from sysid.replay.records import FreeVehicle
from sysid.verdict.result import Result
from whill_mjx.effects import EFFECTS, make_effects
from whill_mjx.vehicle.parameters import describe, get_values, set_values


def vehicle_before(result: Result) -> Any:
    """The base model with its parameters refitted within their spread."""
    base = result.search.base
    names = result.reference.space.names
    return set_values(result.reference.params, names,
                      jnp.asarray(result.reference.space.to_values(base.u), jnp.result_type(float)))


def vehicle_after(result: Result) -> Any:
    """The vehicle with the effects of the last fit in it: those named, and one that only wheels would show."""
    if result.search.verdict != "named":
        return vehicle_before(result)
    final = result.search.final
    moved = set_values(result.full, result.names, jnp.asarray(final.values, jnp.result_type(float)))
    kept = {effect.name for effect in result.reference.params.effects}
    for one in final.hypotheses:
        kept |= {axis.parameter.partition(".")[0] for axis in one.axes}
    return type(moved)(moved.body, tuple(effect for effect in moved.effects if effect.name in kept))


def refit_poses(result: Result, vehicle: Any, iterations: int = 12) -> Any:
    """A vehicle refitted to whole poses and speeds, as `sysid.fit` does, from where the search left it.

    Base parameters may move and the accepted effects' own, and against a reference what every fit to poses has besides
    (`measured_effects` without the losses, which may be what is asked for): the search takes their part for the wander
    of days.
    """
    known, trials = result.reference.known, result.log.training
    extra = measured_effects(vehicle, result.log.spec, trials, losses=False) if known else ()
    vehicle = with_effects(vehicle, extra)
    have = describe(vehicle)
    names = list(result.reference.space.names)
    names += [name for name in searched(vehicle) if name not in names and name not in result.config.held
              and (name.partition(".")[0] in extra or extra and name == "body.com_z")]
    if result.search.verdict == "named":
        names += [name for name in named_parameters(result, vehicle) if name not in names and name in have]
    return _to_poses(result, vehicle, names, iterations)


def on_other_floor(result: Result) -> Any:
    """The reference vehicle on the floor of these drives: of all its parameters those alone are fitted that say what
    changed. The reference vehicle itself where the floor is the same."""
    vehicle, change = result.reference.params, result.floor
    if change is None or not change.named:
        return vehicle
    have = describe(vehicle)
    names = list(dict.fromkeys(one.quantity.parameter for one in change.members if one.quantity.parameter in have))
    return _to_poses(result, vehicle, names, 12) if names else vehicle


def named_parameters(result: Result, vehicle: Any) -> list[str]:
    """Those of the named effects that a vehicle has and that a fit may move."""
    have = describe(vehicle)
    moved = [axis.parameter for one in result.search.final.hypotheses for axis in one.axes]
    return [name for name in dict.fromkeys(moved) if name in have and name not in result.config.held
            and np.isfinite(float(get_values(vehicle, [name])[0]))]


def _to_poses(result: Result, vehicle: Any, names: list[str], iterations: int) -> Any:
    """A vehicle with some of its parameters fitted to whole poses and speeds."""
    trials = result.log.training
    space = make_space(vehicle, result.log.spec, names)
    reference = result.reference
    known = [reference.space.names.index(name) if name in reference.space.names else -1 for name in space.names]
    inside = np.array(known) >= 0
    spread = np.where(np.outer(inside, inside), reference.spread[np.ix_(known, known)], 0.0)
    drives, held = drives_of(result, trials, vehicle)
    u = fit_poses(drives, space, held, spread, iterations)
    return vehicle if u is None else set_values(
        vehicle, space.names, jnp.asarray(space.to_values(u), jnp.result_type(float)))


def drives_of(result: Result, trials: tuple[Trial, ...], vehicle: Any) -> tuple[Drives, np.ndarray]:
    """Trials as a vehicle replays them, and the values (all,) of its parameters there.

    They go through what was compiled for the search, where the catalogue has all effects of the vehicle, or else
    through one replay for all vehicles of a result.
    """
    ready, width, values = result.prepared, result.reference.width, base_values(vehicle)
    gyro = result.reference.gyro
    if set(values) <= set(ready.names):
        values = {**base_values(ready.full), **values}
        drives = make_drives(ready.vehicle, trials, width, ready.paths, gyro)
        return drives, np.array([values[name] for name in ready.names])
    vehicle = _with_named(result, vehicle)
    values, kind = base_values(vehicle), (ready.plant, jax.tree.structure(vehicle))
    drives = make_drives(FreeVehicle(ready.plant, vehicle, tuple(values)), trials, width, ready.others.get(kind), gyro)
    ready.others[kind] = drives.paths
    return drives, np.array(list(values.values()))


def _with_named(result: Result, vehicle: Any) -> Any:
    """The vehicle with the named effects, neutral where it had none, in one order for all vehicles of a result."""
    have = {effect.name: effect for effect in vehicle.effects}
    named = result.search.final.hypotheses if result.search.verdict == "named" else ()
    names = [*have, *(axis.parameter.partition(".")[0] for one in named for axis in one.axes)]
    first = [effect.name for effect in result.reference.params.effects]
    later = make_effects(name for name in names if name in EFFECTS and name not in first)
    order = dict.fromkeys([*first, *(effect.name for effect in later), *have])
    every = {effect.name: effect for effect in later} | have
    return type(vehicle)(vehicle.body, tuple(every[name] for name in order if name in every))


def refitter_of(result: Result) -> Refitter:
    """A refitter like that of the search, through the replay that it compiled."""
    values = result.prepared.values
    drives, _ = result.prepared.drives(result.log.training, result.log.spec.track)
    return Refitter(drives, result.reference, values, base_columns(drives, result.reference, values, result.names))


@lru_cache(maxsize=4)
def fitted_before(result: Result) -> Any:
    """The base model fitted to the drives of a result."""
    vehicle = vehicle_before(result)
    return refit_poses(result, vehicle) if result.config.poses else vehicle


@lru_cache(maxsize=4)
def fitted_alone(result: Result) -> Any:
    """The vehicle of `fitted_before` with what was named (`named_alone`)."""
    return named_alone(result, fitted_before(result))


def named_alone(result: Result, before: Any) -> Any:
    """A fitted base model with the named effects, of which alone the parameters are fitted: what they gain by
    themselves. What a fit of all gains beyond that is due to base parameters that moved beside them."""
    if result.search.verdict != "named":
        return before
    vehicle = vehicle_after(result)
    mine = named_parameters(result, vehicle)
    named = {axis.parameter for one in result.search.final.hypotheses for axis in one.axes}
    base = {name: value for name, value in base_values(before).items()
            if name in describe(vehicle) and name not in named}
    missing = tuple(effect for effect in before.effects if effect.name not in {one.name for one in vehicle.effects})
    vehicle = set_values(vehicle, list(base), jnp.asarray(list(base.values()), jnp.result_type(float)))
    vehicle = type(vehicle)(vehicle.body, (*vehicle.effects, *missing))
    return _to_poses(result, vehicle, mine, 12) if result.config.poses and mine else vehicle


@lru_cache(maxsize=4)
def fitted_after(result: Result) -> Any:
    """The vehicle with the accepted effects, fitted to the drives of a result."""
    if result.search.verdict != "named":
        return fitted_before(result)
    vehicle = vehicle_after(result)
    return refit_poses(result, vehicle) if result.config.poses else vehicle
