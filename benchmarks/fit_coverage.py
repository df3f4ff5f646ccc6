"""Coverage of the fit's 90 % intervals: logs of vehicles with known parameters, each fitted from the preset's values.

Synthetic logs are driven by the model that is fitted, with values drawn around the preset's; logs of the contact plant
by another physics, of which the values that both have in common are known. Each log has six replicates of a few short
manoeuvres (10 s, 11 s); the search and the intervals are those of `sysid.fit` without options. What each search ends
with is kept, so that figures are collected with intervals by the present code: another rule needs no other search.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.fit_jobs import compile_once, reporter
from benchmarks.fit_searches import compile_replay
from benchmarks.harness import figure
from benchmarks.planted_logs import Schedule, fitted_plant, write_dataset
from sysid.errors.space import NUISANCE, Space, make_space, searched
from sysid.intervals.independence import Information
from sysid.intervals.uncertainty import Estimate, estimate, uncertainty_of
from sysid.logs.log import load_log
from sysid.logs.records import Log
from sysid.replay.models import with_effects
from sysid.search.fitting import choose, fit_log, make_problem
from sysid.search.settings import FitConfig
from whill_mjx.vehicle.parameters import get_values, set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec

MANOEUVRES = ("straight", "turn", "circle", "s_curve")
PLANT_MANOEUVRES = ("straight", "turn", "s_curve", "stop_and_go", "random")
PLANT_LENGTH = 11.0  # s that are driven of each of them
REPLICATES = 6
"""With fewer, there are no more trials than parameters, and the intervals come from pieces of the trials alone."""
MORE = ("axle_pivot", "lateral_damping", "sensor_delay", "suspension", "wheel_damping", "wheel_inertia")
USUAL = {"body.com_z": 0.1, "torque_drive.kff": 0.05, "torque_drive.period": 0.004, "axle_pivot.freedom": 0.5,
         "lateral_damping.c_front": 0.5, "sensor_delay.delay": 0.01, "sensor_delay.speed": 0.005,
         "wheel_damping.damping": 0.1, "wheel_inertia.ratio": 2.0, "wheel_inertia.reaction": 0.5}
SPREAD = 0.15  # of the logarithm of a value from log to log
SHIFT = 0.02  # of the range, where a value may be zero or negative
PER_PARAMETER = ("coverage_90_", "half_width_90_", "bias_", "identifiable_")
TOLD = 0.5  # share of the logs in which a parameter must be identifiable to be counted


def draw_truth(space: Space, random: np.random.Generator) -> np.ndarray:
    """Values (P,) around the initial ones, off the bounds."""
    signed = (space.low < 0) | (space.initial == 0)
    scaled = space.initial * np.exp(SPREAD * random.standard_normal(space.size))
    moved = space.initial + SHIFT * (space.high - space.low) * random.standard_normal(space.size)
    return space.to_values(np.clip(space.to_unit(np.where(signed, moved, scaled)), 1e-3, 0.97))


def typical_vehicle() -> Any:
    """The physical model with all that a fit gives it, at usual values: at most bounds no log determines them."""
    start = with_effects(preset_params(WHILL_CR, "physical"), MORE)
    return set_values(start, tuple(USUAL), jnp.asarray(list(USUAL.values())))


def synthetic_log(folder: Path, seed: int) -> tuple[Log, dict[str, float]]:
    """A log of the physical model and its values."""
    start = typical_vehicle()
    space = make_space(start, WHILL_CR, searched(start))
    values = draw_truth(space, np.random.default_rng([seed, 90]))
    truth = set_values(start, space.names, jnp.asarray(values))
    path = write_dataset(folder / "log", WHILL_CR, truth,
                         Schedule(manoeuvres=MANOEUVRES, held_out=(), replicates=REPLICATES, seed=seed),
                         plant=fitted_plant(WHILL_CR))
    return load_log(path), dict(zip(space.names, np.asarray(get_values(truth, space.names), float).tolist(),
                                    strict=True))


def plant_log(folder: Path, seed: int, vehicle: str = "chair") -> tuple[Log, dict[str, float]]:
    """A log of a day of one of the contact plant's vehicles, and the values of the physical model that are known."""
    from benchmarks.plant.chair import COULOMB, VEHICLES
    from benchmarks.plant.commands import nine
    from benchmarks.plant.make import Experiment, make_log

    tables = {name: table[table[:, 0] < PLANT_LENGTH] for name, table in nine(seed).items() if name in PLANT_MANOEUVRES}
    make_log(folder / "log", Experiment(seed=seed, manoeuvres=tables, replicates=REPLICATES, contact=COULOMB,
             vehicle=vehicle))
    log = load_log(folder / "log")
    log = replace(log, trials=tuple(replace(trial, held_out=False) for trial in log.trials))
    return log, plant_values(VEHICLES[vehicle].on_day(np.random.default_rng([seed, 1])), log.spec)


def plant_values(chair: Any, spec: VehicleSpec) -> dict[str, float]:
    """The values of the physical model that a chair of the contact plant has.

    Speeds and poses fix forces only per mass: the model's mass is nominal, so that its torques and its inertias are
    the chair's times the ratio of the masses. The chair's controller is sampled: its integral counts every jump of the
    wanted speed half a tick too long, which is a feed-forward of that speed (Euler and Maclaurin).
    """
    from benchmarks.plant.base import TICK
    from benchmarks.plant.chair import build

    model = build(chair)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = model.body_mass[1:]
    middle = (mass[:, None] * data.xipos[1:]).sum(0) / mass.sum() - data.xpos[model.body("chassis").id]
    apart = data.xipos[1:, :2] - data.xpos[model.body("chassis").id, :2] - middle[:2]
    upright = np.array([matrix.reshape(3, 3)[2] ** 2 @ inertia
                        for matrix, inertia in zip(data.ximat[1:], model.body_inertia[1:], strict=True)])
    yaw = float(upright.sum() + (mass * np.square(apart).sum(1)).sum())
    wheel = model.body("wheel_left").id
    spin = float(model.body_inertia[wheel].max() + chair.armature)  # of one wheel
    ratio = spec.mass / mass.sum()
    return {"torque_drive.kp": chair.kp * ratio, "torque_drive.ki": chair.ki * ratio, "torque_drive.period": TICK,
            "torque_drive.kff": chair.ki * TICK / 2 * ratio, "wheel_damping.damping": chair.damping * ratio,
            "torque_drive.limit": chair.torque_limit * ratio, "body.yaw_inertia": yaw * ratio,
            "wheel_inertia.ratio": spin * ratio / spec.wheel_inertia,
            "wheel_inertia.reaction": float(model.body_inertia[wheel].max()) / spin,
            "body.com_x": spec.rear_x + float(middle[0]), "body.com_y": float(middle[1]),
            "body.com_z": float(middle[2]), "command_delay.delay": chair.delay, "slip_traction.mu": chair.friction}


KINDS: dict[str, Callable[[Path, int], tuple[Log, dict[str, float]]]] = {
    "synthetic": synthetic_log, "plant": plant_log, "scooter": partial(plant_log, vehicle="scooter"),
    "robot": partial(plant_log, vehicle="robot"),
}
"""Logs by the kind in their label. Figures of all but the synthetic ones begin with it."""


def _drawn(label: str, compiled: Path) -> tuple[Log, dict[str, float]]:
    """The log of a label and its known values, with what a search for them needs compiled."""
    kind, _, number = label.partition("_")
    with tempfile.TemporaryDirectory() as scratch:
        log, truth = KINDS[kind](Path(scratch), 50000 + int(number))
    compile_once(compiled, f"coverage_{kind}", lambda: compile_replay(make_problem(log, FitConfig()).objective))
    return log, truth


def job(label: str, iterations: int, folder: Path, compiled: Path) -> dict[str, Any]:
    """Fit one log, KIND_NNN with a kind of `KINDS`, and note each known value with its estimate.

    Args:
        folder: keeps what the intervals are made of, as evidence/LABEL.npz.
        compiled: folder of what the processes share.
    """
    log, truth = _drawn(label, compiled)
    fit = fit_log(log, FitConfig(iterations=iterations), reporter(label))
    save_evidence(folder / "evidence" / f"{label}.npz", fit.uncertainty.evidence, fit.space)
    values = dict(zip(fit.space.names, fit.space.to_values(fit.u).tolist(), strict=True))
    return {"parameters": _rows(fit.uncertainty.estimates, truth), "values": values, "cost": fit.cost,
            "seconds": fit.seconds}


def told_again(kept: Mapping[str, Any], compiled: Path) -> dict[str, Any]:
    """A job's result with the evidence of its log where its search ended, by the present code; no search is done.

    Args:
        kept: result of `job`.
        compiled: folder of what the processes share.
    """
    log, truth = _drawn(kept["label"], compiled)
    config = FitConfig()
    problem = make_problem(log, config)
    space = problem.space
    u = space.to_unit(np.array([kept["values"][name] for name in space.names]))
    objective = choose(problem.objective, u, log.spec.track, config).renewed(u)
    estimates = estimate(objective, u, robust=config.robust).estimates
    return {**kept, "parameters": _rows(estimates, truth)}


def _rows(estimates: Sequence[Estimate], truth: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Each known value by its name, with its estimate."""
    return {one.name: {"truth": truth[one.name], "value": one.value, "low": one.low, "high": one.high,
                       "identifiable": one.identifiable} for one in estimates if one.name in truth}


def save_evidence(path: Path, evidence: Information, space: Space) -> None:
    """Keep the evidence of a log, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    np.savez_compressed(temporary, names=np.array(space.names), low=space.low, high=space.high, initial=space.initial,
                        log=space.log, **asdict(evidence))
    os.replace(temporary, path)


def judged_again(result: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A job's result with the intervals that the present code makes from its evidence.

    Raises:
        ValueError: that was not kept.
    """
    path = folder / "evidence" / f"{result['label']}.npz"
    if not path.exists():
        raise ValueError(f"{path}: missing, so that the intervals of {result['label']} cannot be made anew. Remove its "
                         f"result from {folder} and run the job again.")
    with np.load(path) as kept:
        arrays: dict[str, Any] = dict(kept)
    space = Space(tuple(map(str, arrays.pop("names"))),
                  *(arrays.pop(name) for name in ("low", "high", "initial", "log")))
    numbers: dict[str, Any] = {name: value if value.ndim else float(value) for name, value in arrays.items()}
    known = {name: row["truth"] for name, row in result["parameters"].items()}
    estimates = uncertainty_of(Information(**numbers), space).estimates
    return {**result, "parameters": _rows(estimates, known)}


def summarise(results: Sequence[Mapping[str, Any]], prefix: str = "") -> dict[str, dict[str, Any]]:
    """Figures of all logs of one kind: coverage and median half-width per parameter, lowest and highest coverage.

    An interval counts where the log determines the parameter: elsewhere it is the whole range.
    """
    figures, covered = {}, []
    names = list(dict.fromkeys(name for one in results for name in one["parameters"]))
    for name in names:
        rows = [one["parameters"][name] for one in results if name in one["parameters"]]
        known = [row for row in rows if row["identifiable"] and name not in NUISANCE]
        figures[f"{prefix}identifiable_{name}"] = figure([len(known) / len(rows)], "share")
        if not known:
            continue
        inside = float(np.mean([row["low"] <= row["truth"] <= row["high"] for row in known]))
        figures[f"{prefix}coverage_90_{name}"] = figure([inside], "share")
        figures[f"{prefix}half_width_90_{name}"] = figure(
            [float(np.median([(row["high"] - row["low"]) / 2 for row in known]))], "of the parameter")
        figures[f"{prefix}bias_{name}"] = figure(
            [float(np.median([row["value"] - row["truth"] for row in known]))], "of the parameter")
        if len(known) >= TOLD * len(rows):
            covered.append(inside)
    figures[f"{prefix}coverage_90_min"] = figure([min(covered)], "share")
    figures[f"{prefix}coverage_90_max"] = figure([max(covered)], "share")
    figures[f"{prefix}coverage_logs"] = figure([float(len(results))], "count")
    figures[f"{prefix}seconds_coverage_log"] = figure([float(one["seconds"]) for one in results], "s")
    return figures
