"""What is reported of a drive: odometry from encoders, an outside pose, and a gyro."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.plant.base import FRAME, TICK, Effect
from benchmarks.plant.trial import ENCODER, REPORT, Drive, Noise

GYRO_PERIOD = 0.01  # s


def odometry(drive: Drive, effects: list[Effect], noise: Noise, random: np.random.Generator) -> np.ndarray:
    """Rows (M, 6) t, x, y, yaw, v, omega every 50 ms of an odometry that is computed every 20 ms.

    Encoder ticks of both wheels add up along arcs of the nominal geometry. Speeds come from the timing of the ticks, so
    they are not quantised; they pass a first-order low-pass and carry white noise.
    """
    every = round(FRAME / TICK)
    turned = drive.encoder[::every] / ENCODER + random.uniform(size=2)
    nominal = drive.chair.nominal
    radius = nominal.radius
    for effect in effects:
        radius *= effect.scale()
    step, turn = arcs(radius * ENCODER * np.floor(turned), nominal.track)
    yaw = np.cumsum(turn)
    middle = yaw - turn / 2
    pose = np.column_stack([np.cumsum(step * np.cos(middle)), np.cumsum(step * np.sin(middle)), yaw])
    speed = low_pass(np.column_stack(arcs(radius * ENCODER * turned, nominal.track)) / FRAME, noise.low_pass)
    due = np.arange(math.floor(drive.t[-1] / REPORT + 1e-6) + 1) * REPORT
    true, written = due, due
    for effect in effects:
        shifted, stamped = effect.stamps(due)
        true, written = true + (shifted - due), written + (stamped - due)
    frame = np.clip(np.floor(true / FRAME + 1e-6).astype(int), 0, len(pose) - 1)  # the newest frame that is ready
    speed = speed[frame] + random.standard_normal((len(due), 2)) * [noise.v, noise.omega]
    return np.column_stack([written, pose[frame], speed])[written >= 0]


def arcs(path: np.ndarray, track: float) -> tuple[np.ndarray, np.ndarray]:
    """Step [m] and turn [rad] (F,) per frame, from both wheels' paths (F, 2) and the track [m]."""
    moved = np.diff(path, axis=0, prepend=path[:1])
    return moved.mean(axis=1), (moved[:, 1] - moved[:, 0]) / track


def low_pass(values: np.ndarray, time_constant: float) -> np.ndarray:
    """First-order low-pass (F, C) at the odometry's frames."""
    from scipy.signal import lfilter

    keep = math.exp(-FRAME / time_constant)
    return lfilter([1 - keep], [1.0, -keep], values, axis=0)


def outside_pose(drive: Drive, noise: Noise, random: np.random.Generator) -> np.ndarray:
    """Rows (M, 4) t, x, y, yaw of the drive-axle centre every 50 ms, yaw in (-pi, pi]."""
    due = np.arange(math.floor(drive.t[-1] / REPORT + 1e-6) + 1) * REPORT
    pose = np.column_stack([np.interp(due, drive.t, column) for column in drive.pose.T])
    pose += random.standard_normal(pose.shape) * [noise.position, noise.position, noise.yaw]
    pose[:, 2] = np.pi - np.mod(np.pi - pose[:, 2], 2 * np.pi)
    return np.column_stack([due, pose])


@dataclass(frozen=True)
class Gyro:
    """A yaw rate measured on the chassis."""

    bias: float = 0.0
    """Reading at rest [rad/s]."""
    scale: float = 1.0
    """Negative where it is mounted upside down."""
    noise: float = 0.004
    """Of a sample [rad/s]."""

    def rows(self, drive: Drive, random: np.random.Generator) -> np.ndarray:
        """Rows (M, 2) t, rate every 10 ms: the mean since the sample before."""
        due = np.arange(math.floor(drive.t[-1] / GYRO_PERIOD + 1e-6) + 1) * GYRO_PERIOD
        yaw = np.interp(due, drive.t, np.unwrap(drive.pose[:, 2]))
        rate = np.diff(yaw, prepend=yaw[:1]) / GYRO_PERIOD
        return np.column_stack([due, self.scale * rate + self.bias + self.noise * random.standard_normal(len(due))])
