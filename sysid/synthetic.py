"""Driving logs from a simulated vehicle with known parameters, in the dataset format: planted truth for tests."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.log import Command, OdometryStream, PoseStream, Start, Trial
from sysid.rollout import Plant, make_batch, simulate, vehicle_plant
from sysid.scenarios import SCENARIOS, Scenario, command_sequence
from whill_mjx.specs import VehicleSpec

MEASUREMENT_DT = 0.05  # s


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of white noise on every sample."""

    position: float = 0.003
    """Outside pose [m]."""
    yaw: float = 0.003
    """Outside pose [rad]."""
    odometry_position: float = 0.001
    odometry_yaw: float = 0.001
    v: float = 0.005
    omega: float = 0.01


def write_dataset(
    folder: str | Path, spec: VehicleSpec, params: Any, *, manoeuvres: tuple[str, ...] = tuple(SCENARIOS),
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
        command = command_sequence(manoeuvre, scenario)
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
        pose = np.array(simulated.pose[i, :count], float)
        pose += random.normal(size=pose.shape) * [noise.position, noise.position, noise.yaw]
        pose[:, 2] = np.pi - np.mod(np.pi - pose[:, 2], 2 * np.pi)
        odometry = np.array(simulated.odometry[i, :count], float)
        odometry += random.normal(size=odometry.shape) * [noise.odometry_position, noise.odometry_position,
                                                          noise.odometry_yaw, noise.v, noise.omega]
        path = folder / "trials" / trial.name
        t = trial.ground_truth.t
        write_csv(path / "command.csv", "t,v,omega", _columns(trial.command))
        write_csv(path / "ground_truth.csv", "t,x,y,yaw", np.column_stack([t, pose]))
        write_csv(path / "odometry.csv", "t,x,y,yaw,v,omega", np.column_stack([t, odometry]))
    names = [trial.name for trial in trials if trial.manoeuvre in held_out]
    lines = ["schema = 1", f'vehicle = "{spec.name}"', f'drive = "{spec.drive}"', f'driven_axle = "{spec.driven_axle}"',
             *(f"{key} = {getattr(spec, key)}" for key in ("wheel_radius", "track", "wheelbase", "mass")),
             f"command_limits = [{max(abs(spec.v_min), spec.v_max)}, {spec.omega_max}]",
             f"held_out = [{', '.join(repr(name).replace(chr(39), chr(34)) for name in names)}]"]
    write_text(folder / "dataset.toml", "\n".join(lines) + "\n")
    return folder


def write_csv(path: Path, header: str, table: np.ndarray) -> None:
    """Write a table (T, C) with six decimals, whole or not at all."""
    rows = [",".join(f"{value:.6f}".rstrip("0").rstrip(".") for value in row) for row in table]
    write_text(path, "\n".join([header, *rows]) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def _columns(command: Command) -> np.ndarray:
    return np.column_stack([command.t, command.v, command.omega])
