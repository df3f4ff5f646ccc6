"""Writes driving-log datasets (docs/log_format.md), whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from whill_mjx.specs import VehicleSpec

COMMAND_HEADER, ODOMETRY_HEADER, POSE_HEADER = "t,v,omega", "t,x,y,yaw,v,omega", "t,x,y,yaw"


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


def write_trial(
    folder: Path, t: np.ndarray, command: np.ndarray, pose: np.ndarray, odometry: np.ndarray,
    noise: SensorNoise | None = None, random: np.random.Generator | None = None,
) -> None:
    """Write the three streams of one trial.

    Args:
        folder: of the trial; its name is the trial's.
        t: (M,) times of the measurements [s].
        command: (T, 3) t, v, omega.
        pose: (M, 3) x, y, yaw of the reference point in the room; yaw is wrapped to (-pi, pi].
        odometry: (M, 5) x, y, yaw, v, omega.
        noise, random: white noise to add to both measurements; none leaves them exact.
    """
    pose, odometry = np.array(pose, float), np.array(odometry, float)
    if noise is not None:
        random = random or np.random.default_rng(0)
        pose += random.normal(size=pose.shape) * [noise.position, noise.position, noise.yaw]
        scales = [noise.odometry_position, noise.odometry_position, noise.odometry_yaw, noise.v, noise.omega]
        odometry += random.normal(size=odometry.shape) * scales
    pose[:, 2] = np.pi - np.mod(np.pi - pose[:, 2], 2 * np.pi)
    write_csv(folder / "command.csv", COMMAND_HEADER, command)
    write_csv(folder / "ground_truth.csv", POSE_HEADER, np.column_stack([t, pose]))
    write_csv(folder / "odometry.csv", ODOMETRY_HEADER, np.column_stack([t, odometry]))


def write_fields(folder: Path, spec: VehicleSpec, held_out: Iterable[str] = ()) -> None:
    """Write dataset.toml: the vehicle's nominal geometry, and the trials that are never fitted."""
    names = ", ".join(json.dumps(name) for name in held_out)  # a JSON string is a TOML string
    lines = [
        "schema = 1",
        f"vehicle = {json.dumps(spec.name)}",
        f'drive = "{spec.drive}"',
        f'driven_axle = "{spec.driven_axle}"',
        *(f"{key} = {getattr(spec, key)}" for key in ("wheel_radius", "track", "wheelbase", "mass")),
        f"command_limits = [{max(abs(spec.v_min), spec.v_max)}, {spec.omega_max}]",
        f"held_out = [{names}]",
    ]
    write_text(folder / "dataset.toml", "\n".join(lines) + "\n")


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
