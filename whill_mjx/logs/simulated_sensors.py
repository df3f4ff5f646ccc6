"""Sensors of a simulated drive: rate, latency and noise of each, so that its log has the form of a measured one.

The motion is recorded at every physics step. A sensor reports at its own times what it saw `latency` before, stamped
with the time of the report, as a driver without hardware stamps does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from whill_mjx.io.command_line import Range, check_options

ENCODER_STEP = 0.001  # rad, of the chair's state message
LENGTH, ANGLE, SPEED = Range(0, 10), Range(0, 4), Range(0, 10)  # m, rad, m/s or rad/s
COUNTER_WRAP = 201  # ms: the chair's counter runs from 0 to 200


@dataclass(frozen=True)
class Sensors:
    """Rates and latencies; a rate of 0 leaves the sensor out."""

    ground_truth_rate: float = 20.0
    """Outside pose [Hz]."""
    ground_truth_latency: float = 0.0
    """[s]"""
    odometry_rate: float = 20.0
    """The vehicle's odometry [Hz]; the maker's driver asks the chair for 50."""
    odometry_latency: float = 0.0
    """[s]"""
    imu_rate: float = 0.0
    """Gyro, written as imu.csv [Hz]; the chair's has 104."""
    imu_latency: float = 0.0
    """[s]"""
    encoder_rate: float = 0.0
    """Wheel angles and the chair's time counter, written as encoder.csv [Hz]; the chair's state comes at 50."""
    encoder_latency: float = 0.0
    """[s]"""

    def __post_init__(self) -> None:
        for name in ("ground_truth", "odometry", "imu", "encoder"):
            rate, latency = getattr(self, f"{name}_rate"), getattr(self, f"{name}_latency")
            if not 0 <= rate <= 1000:
                raise ValueError(f"{name}_rate is {rate} Hz; it must lie within 0 (no such sensor) and 1000.")
            if not 0 <= latency <= 1:
                raise ValueError(f"{name}_latency is {latency} s; it must lie within 0 and 1. Check the unit.")
        if self.ground_truth_rate == 0 == self.odometry_rate:
            raise ValueError("ground_truth_rate and odometry_rate are both 0; a log needs one of them. Set a rate.")


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of white noise on every sample."""

    position: Annotated[float, LENGTH] = 0.003
    """Outside pose [m]."""
    yaw: Annotated[float, ANGLE] = 0.003
    """Outside pose [rad]."""
    odometry_position: Annotated[float, LENGTH] = 0.001
    odometry_yaw: Annotated[float, ANGLE] = 0.001
    v: Annotated[float, SPEED] = 0.005
    omega: Annotated[float, SPEED] = 0.01
    gyro: Annotated[float, SPEED] = 0.002
    """Rate of the gyro [rad/s]."""
    encoder: Annotated[float, ANGLE] = 0.0
    """Wheel angles [rad], before they are rounded to their step."""

    def __post_init__(self) -> None:
        check_options(self, "noise-levels.")


def times(duration: float, rate: float) -> np.ndarray:
    """Times (M,) of the reports within a drive of `duration` seconds [s]."""
    return np.arange(int(np.floor(duration * rate + 1e-6)) + 1) / rate


def seen(t: np.ndarray, latency: float, dt: float, table: np.ndarray) -> np.ndarray:
    """What a sensor reports at times t (M,) of a motion (T, C) recorded every dt from 0 on: (M, C).

    Between two physics steps it is interpolated; before the start of the record the vehicle stands.
    """
    place = np.clip((t - latency) / dt, 0.0, len(table) - 1)
    nearest = np.round(place)
    place = np.where(np.abs(place - nearest) < 1e-6, nearest, place)
    before = np.minimum(np.floor(place).astype(int), len(table) - 1)
    after = np.minimum(before + 1, len(table) - 1)
    weight = (place - before)[:, None]
    return table[before] + weight * (table[after] - table[before])


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def encoder_table(t: np.ndarray, latency: float, angles: np.ndarray) -> np.ndarray:
    """Rows (M, 4) of encoder.csv: t [s], wheel angles left and right [rad] in steps and wrapped, counter [ms].

    The counter is the vehicle's own clock at the measurement: it gives the time between two states whatever the
    latency, up to its wrap.
    """
    stepped = ENCODER_STEP * np.round(wrapped(angles) / ENCODER_STEP)
    counter = np.floor((t - latency) * 1000 + 1e-6) % COUNTER_WRAP
    return np.column_stack([t, stepped, counter])
