"""Driving logs of a simulated vehicle with known parameters, in the dataset format: planted truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from sysid.replay.records import Plant
from sysid.replay.rollout import make_batch, simulate, vehicle_plant
from sysid.search.settings import FitConfig
from whill_mjx.logs.dataset import Noise, SensorNoise, write_fields, write_trial
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES, Scenario, command_table
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.specs import VehicleSpec

MEASUREMENT_DT = 0.05  # s


@dataclass(frozen=True)
class Schedule:
    """What is driven."""

    manoeuvres: tuple[str, ...] = tuple(PAPER_MANOEUVRES)
    held_out: tuple[str, ...] = ("figure_eight",)
    """Manoeuvres of which all replicates are held out."""
    replicates: int = 3
    """Drives per manoeuvre: same commands, other noise and start pose."""
    scenario: Scenario | None = None
    """Sizes of the manoeuvres."""
    seed: int = 0
    """Of start poses and noise."""


def fitted_plant(spec: VehicleSpec) -> Plant:
    """The simulator's vehicle with a fit's default physics step, which is part of a model."""
    return vehicle_plant(spec, VehicleConfig(physics_dt=FitConfig.physics_dt))


def write_dataset(
    folder: str | Path, spec: VehicleSpec, params: Any, schedule: Schedule = Schedule(), *,  # noqa: B008
    noise: SensorNoise | None = None, plant: Plant | None = None,
) -> Path:
    """Drive the manoeuvres with the vehicle `spec`, `params` (the planted truth), or `plant`, and write a dataset."""
    folder, noise = Path(folder), noise or SensorNoise()
    random = np.random.default_rng(schedule.seed)
    plant = plant or vehicle_plant(spec)
    trials = []
    for manoeuvre in schedule.manoeuvres:
        command = Command(*command_table(manoeuvre, schedule.scenario).T)
        t = np.arange(0.0, command.t[-1], MEASUREMENT_DT)
        for replicate in range(1, schedule.replicates + 1):
            x, y = random.uniform(-1.0, 1.0, 2)
            start = Start(float(x), float(y), float(random.uniform(-np.pi, np.pi)))
            blank = np.zeros_like(t)
            trials.append(Trial(f"{manoeuvre}_{replicate}", manoeuvre, command,
                                OdometryStream(t, blank, blank, blank, blank, blank),
                                PoseStream(t, blank, blank, blank), start))
    batch, _ = make_batch(tuple(trials), plant.dt)
    run = jax.jit(lambda p: simulate(plant, p, batch))
    simulated = jax.tree.map(np.asarray, run(jax.tree.map(jnp.asarray, params)))
    for i, trial in enumerate(trials):
        assert trial.ground_truth is not None
        count = len(trial.ground_truth.t)
        write_trial(folder / "trials" / trial.name, trial.ground_truth.t, trial.command.table,
                    simulated.pose[i, :count], simulated.odometry[i, :count], Noise(noise, random))
    write_fields(folder, spec, [trial.name for trial in trials if trial.manoeuvre in schedule.held_out])
    return folder
