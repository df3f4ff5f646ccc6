"""Writes driving-log datasets (docs/log_format.md), whole or not at all."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from whill_mjx.io.folders import write_whole
from whill_mjx.logs.simulated_sensors import SensorNoise, encoder_table, wrapped
from whill_mjx.vehicle.specs import VehicleSpec

COMMAND_HEADER, ODOMETRY_HEADER, POSE_HEADER = "t,v,omega", "t,x,y,yaw,v,omega", "t,x,y,yaw"
IMU_HEADER, ENCODER_HEADER = "t,gyro", "t,left,right,counter"


class Noise(NamedTuple):
    """White noise that is added to measurements."""

    levels: SensorNoise | None = None
    """None adds none."""
    random: np.random.Generator = np.random.default_rng(0)

    def on(self, values: np.ndarray, *names: str) -> np.ndarray:
        """Values (M, C) with the noise of those names, one a column or one for all."""
        values = np.array(values, float)
        if self.levels is not None:
            values += self.random.normal(size=values.shape) * [getattr(self.levels, name) for name in names]
        return values


EXACT = Noise()


def write_trial(
    folder: Path, t: np.ndarray, command: np.ndarray, pose: np.ndarray, odometry: np.ndarray, noise: Noise = EXACT
) -> None:
    """Write the three streams of one trial.

    Args:
        folder: of the trial; its name is the trial's.
        t: (M,) times of the measurements [s].
        command: (T, 3) t, v, omega.
        pose: (M, 3) x, y, yaw of the reference point in the room; yaw is wrapped to (-pi, pi].
        odometry: (M, 5) x, y, yaw, v, omega.
        noise: on both measurements.
    """
    write_csv(folder / "command.csv", COMMAND_HEADER, command)
    write_ground_truth(folder, t, pose, noise)
    write_odometry(folder, t, odometry, noise)


def write_ground_truth(folder: Path, t: np.ndarray, pose: np.ndarray, noise: Noise) -> None:
    """Write the outside pose (M, 3)."""
    pose = noise.on(pose, "position", "position", "yaw")
    pose[:, 2] = wrapped(pose[:, 2])
    write_csv(folder / "ground_truth.csv", POSE_HEADER, np.column_stack([t, pose]))


def write_odometry(folder: Path, t: np.ndarray, odometry: np.ndarray, noise: Noise) -> None:
    """Write the odometry (M, 5)."""
    odometry = noise.on(odometry, "odometry_position", "odometry_position", "odometry_yaw", "v", "omega")
    write_csv(folder / "odometry.csv", ODOMETRY_HEADER, np.column_stack([t, odometry]))


def write_imu(folder: Path, t: np.ndarray, gyro: np.ndarray, noise: Noise) -> None:
    """Write the gyro's yaw rate (M, 1)."""
    write_csv(folder / "imu.csv", IMU_HEADER, np.column_stack([t, noise.on(gyro, "gyro")]))


def write_encoder(folder: Path, t: np.ndarray, latency: float, angles: np.ndarray, noise: Noise) -> None:
    """Write the wheel angles (M, 2) and the vehicle's counter."""
    write_csv(folder / "encoder.csv", ENCODER_HEADER, encoder_table(t, latency, noise.on(angles, "encoder")))


def write_fields(
    folder: Path, spec: VehicleSpec, held_out: Iterable[str] = (), more: Mapping[str, Any] | None = None,
    stated: Container[str] | None = None,
) -> None:
    """Write dataset.toml: the vehicle's nominal geometry, and the trials that are never fitted.

    Args:
        more: further fields: numbers, texts or lists of texts.
        stated: fields of the vehicle that are known; the loader assumes and notes the others. None: all are.
    """
    names = ", ".join(json.dumps(name) for name in held_out)  # a JSON string is a TOML string
    of_vehicle = {
        "drive": f'"{spec.drive}"', "driven_axle": f'"{spec.driven_axle}"',
        **{key: getattr(spec, key) for key in ("wheel_radius", "track", "wheelbase", "mass")},
        "command_limits": f"[{max(abs(spec.v_min), spec.v_max)}, {spec.omega_max}]",
    }
    lines = [
        "schema = 1",
        f"vehicle = {json.dumps(spec.name)}",
        *(f"{key} = {value}" for key, value in of_vehicle.items() if stated is None or key in stated),
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
