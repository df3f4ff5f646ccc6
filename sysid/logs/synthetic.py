"""Driving logs from a simulated vehicle with known parameters, in the dataset format: planted truth for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from sysid.replay.records import Plant
from sysid.replay.rollout import make_batch, simulate, vehicle_plant
from whill_mjx.logs.dataset import SensorNoise, write_fields, write_trial
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES, Scenario, command_table
from whill_mjx.vehicle.specs import VehicleSpec

MEASUREMENT_DT = 0.05  # s


def write_dataset(
    folder: str | Path, spec: VehicleSpec, params: Any, *, manoeuvres: tuple[str, ...] = tuple(PAPER_MANOEUVRES),
    held_out: tuple[str, ...] = ("figure_eight",), replicates: int = 3, scenario: Scenario | None = None,
    noise: SensorNoise | None = None, seed: int = 0, plant: Plant | None = None,
) -> Path:
    """Drive the manoeuvres with a vehicle and write the log.

    Args:
        folder: dataset folder to create.
        spec, params: the vehicle; `params` holds the planted truth.
        held_out: manoeuvres of which all replicates are held out.
        replicates: drives per manoeuvre: same commands, other noise and start pose.
        plant: by default the simulator's vehicle of `spec`.
    """
    folder, noise = Path(folder), noise or SensorNoise()
    random = np.random.default_rng(seed)
    plant = plant or vehicle_plant(spec)
    trials = []
    for manoeuvre in manoeuvres:
        command = Command(*command_table(manoeuvre, scenario).T)
        t = np.arange(0.0, command.t[-1], MEASUREMENT_DT)
        for replicate in range(1, replicates + 1):
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
                    simulated.pose[i, :count], simulated.odometry[i, :count], noise, random)
    write_fields(folder, spec, [trial.name for trial in trials if trial.manoeuvre in held_out])
    return folder
