"""Writes driving-log datasets (docs/log_format.md), whole or not at all."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.folders import write_whole
from whill_mjx.logs.simulated_sensors import SensorNoise, encoder_table, wrapped
from whill_mjx.vehicle.specs import VehicleSpec

COMMAND_HEADER, ODOMETRY_HEADER, POSE_HEADER = "t,v,omega", "t,x,y,yaw,v,omega", "t,x,y,yaw"
IMU_HEADER, ENCODER_HEADER = "t,gyro", "t,left,right,counter"


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
    random = random or np.random.default_rng(0)
    write_csv(folder / "command.csv", COMMAND_HEADER, command)
    write_ground_truth(folder, t, pose, noise, random)
    write_odometry(folder, t, odometry, noise, random)


def write_ground_truth(
    folder: Path, t: np.ndarray, pose: np.ndarray, noise: SensorNoise | None, random: np.random.Generator
) -> None:
    """Write the outside pose (M, 3), with noise unless it is None."""
    pose = np.array(pose, float)
    if noise is not None:
        pose += random.normal(size=pose.shape) * [noise.position, noise.position, noise.yaw]
    pose[:, 2] = wrapped(pose[:, 2])
    write_csv(folder / "ground_truth.csv", POSE_HEADER, np.column_stack([t, pose]))


def write_odometry(
    folder: Path, t: np.ndarray, odometry: np.ndarray, noise: SensorNoise | None, random: np.random.Generator
) -> None:
    """Write the odometry (M, 5), with noise unless it is None."""
    odometry = np.array(odometry, float)
    if noise is not None:
        scales = [noise.odometry_position, noise.odometry_position, noise.odometry_yaw, noise.v, noise.omega]
        odometry += random.normal(size=odometry.shape) * scales
    write_csv(folder / "odometry.csv", ODOMETRY_HEADER, np.column_stack([t, odometry]))


def write_imu(
    folder: Path, t: np.ndarray, gyro: np.ndarray, noise: SensorNoise | None, random: np.random.Generator
) -> None:
    """Write the gyro's yaw rate (M, 1), with noise unless it is None."""
    gyro = np.array(gyro, float)
    if noise is not None:
        gyro += random.normal(size=gyro.shape) * noise.gyro
    write_csv(folder / "imu.csv", IMU_HEADER, np.column_stack([t, gyro]))


def write_encoder(
    folder: Path, t: np.ndarray, latency: float, angles: np.ndarray, noise: SensorNoise | None,
    random: np.random.Generator,
) -> None:  # fmt: skip
    """Write the wheel angles (M, 2) and the vehicle's counter, with noise unless it is None."""
    angles = np.array(angles, float)
    if noise is not None:
        angles += random.normal(size=angles.shape) * noise.encoder
    write_csv(folder / "encoder.csv", ENCODER_HEADER, encoder_table(t, latency, angles))


def write_fields(
    folder: Path, spec: VehicleSpec, held_out: Iterable[str] = (), more: Mapping[str, Any] | None = None
) -> None:
    """Write dataset.toml: the vehicle's nominal geometry, and the trials that are never fitted.

    Args:
        more: further fields: numbers, texts or lists of texts.
    """
    names = ", ".join(json.dumps(name) for name in held_out)  # a JSON string is a TOML string
    lines = [
        "schema = 1",
        f"vehicle = {json.dumps(spec.name)}",
        f'drive = "{spec.drive}"',
        f'driven_axle = "{spec.driven_axle}"',
        *(f"{key} = {getattr(spec, key)}" for key in ("wheel_radius", "track", "wheelbase", "mass")),
        f"command_limits = [{max(abs(spec.v_min), spec.v_max)}, {spec.omega_max}]",
        f"held_out = [{names}]",
        *(f"{key} = {_toml(value)}" for key, value in (more or {}).items()),
    ]
    write_text(folder / "dataset.toml", "\n".join(lines) + "\n")


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[\n" + "".join(f"    {json.dumps(one, ensure_ascii=False)},\n" for one in value) + "]"
    return json.dumps(value, ensure_ascii=False)


def write_csv(path: Path, header: str, table: np.ndarray) -> None:
    """Write a table (T, C) with six decimals, whole or not at all."""
    rows = [",".join(f"{value:.6f}".rstrip("0").rstrip(".") for value in row) for row in table]
    write_text(path, "\n".join([header, *rows]) + "\n")


def write_json(path: Path, content: Any, allow_nan: bool = True) -> None:
    """Write JSON, whole or not at all; ValueError for what is no finite number, if `allow_nan` is not set."""
    write_text(path, json.dumps(content, indent=1, allow_nan=allow_nan) + "\n")


def plain(value: Any) -> Any:
    """A dataclass as JSON data; what JSON does not know becomes its text."""
    return json.loads(json.dumps(dataclasses.asdict(value), default=str))


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_whole(path, text)
