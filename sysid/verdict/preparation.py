"""A vehicle ready for verdicts: its reference days, the catalogue, and what effects seem to be on days without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.errors.features import CHANNELS
from sysid.errors.noise import repeated
from sysid.errors.space import FIXED
from sysid.logs.records import CHANNEL_NAMES, Log
from sysid.missing.catalogue import PARAMETER, base_values, hypotheses, outside_hypotheses, with_catalogue
from sysid.missing.days import Reference
from sysid.missing.drives import make_drives
from sysid.missing.fit_statistics import FittedVehicle
from sysid.missing.reference import BLOCK, make_reference, of_vehicle
from sysid.missing.signatures import PARTS
from sysid.missing.wander import estimate
from sysid.replay.models import gyro_effects, with_effects
from sysid.replay.records import FreeVehicle, Plant
from sysid.replay.rollout import PathReplay, vehicle_plant
from sysid.search.result import Progress
from sysid.verdict.result import LoopConfig, Prepared
from sysid.verdict.search_record import ROUNDS
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import VehicleSpec

BLOCKS = 8  # of a long reference run, as of a log that stands alone (`sysid.missing.signatures.manoeuvre_groups`)
LEAST_WINDOWS = 3  # of a block, so that a fit to it is not that of one window's noise


def prepare(
    reference: Reference, spec: VehicleSpec, config: LoopConfig | None = None, progress: Progress | None = None
) -> Prepared:
    """A vehicle with the catalogue, ready for `find_missing` on one log after the other."""
    config = config or LoopConfig()
    plant = _plant(spec, config)
    found = hypotheses(spec, reference.params)
    if config.pose_delay and PARAMETER not in config.held:
        found += outside_hypotheses(spec, reference.params, reference.space.names)
    full = with_catalogue(reference.params, found)
    base = base_values(full)
    paths = PathReplay(plant, lambda values: set_values(full, tuple(base), values))
    drives = make_drives(FreeVehicle(plant, full, tuple(base)), tuple(one.trial for one in reference.leftovers),
                         reference.width, paths, reference.gyro)
    drives = replace(drives, weight=np.stack([one.mask for one in reference.leftovers]))
    wander = estimate(drives, reference, found, full, spec, progress)
    return Prepared(reference, plant, found, full, tuple(base), paths, wander)


def as_shown(log: Log, ready: Prepared) -> tuple[Log, Prepared]:
    """The log without what none of the reference drives measured, since nothing shows how far off that usually is, and
    the vehicle with a remark on it. Held-out trials keep it: they are scored without any noise.

    ValueError where training trials measured nothing else.
    """
    shown = np.any([(one.mask > 0).any(axis=0) for one in ready.reference.leftovers], axis=0)
    streams = {name: [c for c, channel in enumerate(CHANNELS) if channel.startswith(prefix)]
               for name, prefix in (("odometry", "odometry."), ("ground_truth", "pose."))}
    unknown: dict[str, Any] = {name: None for name, columns in streams.items() if not shown[columns].any()
                               and any(getattr(trial, name) is not None for trial in log.training)}
    if not unknown:
        return log, ready
    kept = log.select(lambda trial: trial.held_out or any(getattr(trial, name) is not None for name in
                                                          streams if name not in unknown))
    what = " and ".join(CHANNEL_NAMES[name] for name in unknown)
    if not kept.training:
        raise ValueError(f"log {log.name!r}: its training trials have {what} alone, which no reference drive has: "
                         "nothing shows its noise. Record the same on other days, or leave --reference out.")
    trials = tuple(trial if trial.held_out else replace(trial, **unknown) for trial in kept.trials)
    remark = f"{ready.reference.remark}; no reference drive has {what}, so that of these drives is left out"
    return replace(kept, trials=trials), replace(ready, reference=replace(ready.reference, remark=remark))


def _free(vehicle: Any, config: LoopConfig) -> list[str]:
    """Parameters of the base model that are fitted: limits that are not there stay away."""
    names = [name for name in describe(vehicle) if name not in FIXED and name not in config.held]
    return [name for name, value in zip(names, get_values(vehicle, names), strict=True) if np.isfinite(float(value))]


def _plant(spec: VehicleSpec, config: LoopConfig) -> Plant:
    return vehicle_plant(spec, VehicleConfig(physics_dt=config.physics_dt))


def expected_steps(config: LoopConfig, days: int, fitted: bool = False) -> int:
    """How far the progress bar goes at most, with so many reference days."""
    base = 0 if fitted else config.base_iterations + max(config.base_iterations // 2, 3)
    return base + 6 * days + 2 * PARTS + 4 + 3 * (2 * ROUNDS + 1) + config.refit_nulls


def days_of(references: Sequence[Log]) -> tuple[Log, ...]:
    """Reference logs as days. Windows of one long run, in which nothing is driven twice, are put into blocks of
    consecutive ones that count as a day each: they show how far parameters and apparent effects wander."""
    days: list[Log] = []
    for log in references:
        trials = log.training
        if repeated(trials) or len(trials) < BLOCKS * LEAST_WINDOWS:
            days.append(log)
            continue
        days += [replace(log, name=f"{log.name}, block {number}", fields={**log.fields, BLOCK: number},
                         trials=tuple(trials[i] for i in part))
                 for number, part in enumerate(np.array_split(np.arange(len(trials)), BLOCKS), start=1)]
    return tuple(days)


def reference_for(
    log: Log, references: Sequence[Log], config: LoopConfig, vehicle: Any = None, progress: Progress | None = None
) -> Reference:
    """The vehicle as its reference drives or its file show it; of the log itself where there is neither.

    Args:
        vehicle: `VehicleParams`, kept as they are, or `FittedVehicle`.
    """
    plant = _plant(log.spec, config)
    fitted = vehicle if isinstance(vehicle, FittedVehicle | None) else FittedVehicle(vehicle)
    if fitted is not None and fitted.kept:
        shown = [trial for one in references or (log,) for trial in one.training]
        fitted = replace(fitted, params=with_effects(fitted.params, gyro_effects(shown)))
        free = _free(fitted.params, config)
        if not references:
            return of_vehicle(plant, fitted, log, free, progress)
        return make_reference(FreeVehicle(plant, fitted.params, tuple(free)), days_of(references), True, 0, progress)
    start = preset_params(log.spec, config.preset) if fitted is None else fitted.params
    start = with_effects(start, (*config.with_effects, *gyro_effects(
        [trial for one in references or (log,) for trial in one.training])))
    return make_reference(FreeVehicle(plant, start, tuple(_free(start, config))), days_of(references) or (log,),
                          bool(references), config.base_iterations, progress)
