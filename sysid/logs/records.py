"""What a driving log holds: commands, measured streams, starts and trials."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.folders import RUN_FILE
from whill_mjx.vehicle.specs import VehicleSpec

GYRO_SPACING = 0.05
"""Least time between samples of a gyro [s]: quicker ones are added up, which loses nothing of what they turn."""
FAR = 64.0
"""Distance from the origin of the room [m] beyond which single precision rounds the way of a physics step by 1 %."""
CHECK = "Check the log: "  # begins a note on a fault of a log
CHANNEL_NAMES = {"ground_truth": "outside pose", "odometry": "odometry"}  # what a person calls a channel of a trial


@dataclass(frozen=True)
class Command:
    """Commanded velocities; each holds until the next."""

    t: np.ndarray  # (T,) s
    v: np.ndarray  # (T,) m/s
    omega: np.ndarray  # (T,) rad/s

    @property
    def table(self) -> np.ndarray:
        """(T, 3) of t [s], v [m/s] and omega [rad/s]."""
        return np.column_stack([self.t, self.v, self.omega])

    def turned(self, t: np.ndarray) -> np.ndarray:
        """(T,) what the yaw rates add up to until times t (T,) [rad], from the first command."""
        ends = np.append(self.t, max(float(t[-1]), float(self.t[-1])) + 1.0)
        return np.asarray(np.interp(t, ends, np.append(0.0, np.cumsum(self.omega * np.diff(ends)))))

    def at(self, t: np.ndarray, before: tuple[float, float] | None = None) -> np.ndarray:
        """(2, T) v [m/s] and omega [rad/s] in force at times t (T,) [s]; `before` the first, by default the first's."""
        held = command_in_force(self, t)
        found = np.stack([self.v, self.omega])[:, np.maximum(held, 0)]
        return found if before is None else np.where(held >= 0, found, np.array(before)[:, None])


@dataclass(frozen=True)
class OdometryStream:
    """What the vehicle's own odometry reported; channels that were not logged are None."""

    t: np.ndarray  # (T,) s
    x: np.ndarray | None  # (T,) m, from the trial's start
    y: np.ndarray | None  # (T,) m
    yaw: np.ndarray | None  # (T,) rad, unwrapped
    v: np.ndarray  # (T,) m/s
    omega: np.ndarray  # (T,) rad/s

    @property
    def values(self) -> np.ndarray:
        """(T, 5) of x, y [m], yaw [rad], v [m/s] and omega [rad/s]; nan where not logged."""
        absent = np.full(len(self.t), np.nan)
        pose = [absent if one is None else one for one in (self.x, self.y, self.yaw)]
        return np.stack([*pose, self.v, self.omega], axis=-1)


@dataclass(frozen=True)
class PoseStream:
    """Outside measurement of the reference point in a fixed room frame."""

    t: np.ndarray  # (T,) s
    x: np.ndarray  # (T,) m
    y: np.ndarray  # (T,) m
    yaw: np.ndarray  # (T,) rad, unwrapped

    @property
    def values(self) -> np.ndarray:
        """(T, 3) of x, y [m] and yaw [rad]."""
        return np.stack([self.x, self.y, self.yaw], axis=-1)

    def seen_from(self, x: float, y: float, yaw: float) -> PoseStream:
        """The same poses in the frame of another one."""
        place = np.exp(-1j * yaw) * (self.x - x + 1j * (self.y - y))
        return PoseStream(self.t, place.real, place.imag, self.yaw - yaw)


def logged_pose(stream: OdometryStream | PoseStream | None, rows: int = 0) -> PoseStream | None:
    """The pose of a stream; None where it was not logged, or in fewer rows."""
    if stream is None or stream.x is None or stream.y is None or stream.yaw is None or len(stream.t) < rows:
        return None
    return PoseStream(stream.t, stream.x, stream.y, stream.yaw)


@dataclass(frozen=True)
class GyroStream:
    """The turn of the body, added up from a yaw rate that is measured on the vehicle."""

    t: np.ndarray  # (T,) s
    turn: np.ndarray  # (T,) rad, from the first sample

    @classmethod
    def of_rates(cls, t: np.ndarray, omega: np.ndarray) -> GyroStream:
        """That of yaw rates (T,) [rad/s], at samples that are at least `GYRO_SPACING` apart."""
        kept = spaced(t, GYRO_SPACING - 1e-9)
        return cls(t[kept], np.append(0.0, np.cumsum((omega[1:] + omega[:-1]) / 2 * np.diff(t)))[kept])

    @property
    def values(self) -> np.ndarray:
        """(T, 1) of the turn."""
        return self.turn[:, None]


@dataclass(frozen=True)
class Start:
    """Where and how fast the vehicle starts: room frame, reference point."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    v: float = 0.0
    omega: float = 0.0
    position_sigma: float = 0.0  # standard error of x and y [m]
    yaw_sigma: float = 0.0  # standard error of yaw [rad]
    odometry_position_sigma: float = 0.0  # standard error of the origin from which the odometry counts x and y [m]
    odometry_yaw_sigma: float = 0.0  # standard error of the heading from which it counts yaw, and along which x points
    measured: bool = False  # whether the pose is the outside measurement at t = 0 itself
    rest: float = 0.0  # until when poses were averaged for it [s]


@dataclass(frozen=True)
class Trial:
    """One drive (or one window of a longer one)."""

    name: str
    """Of its folder, or of the window."""
    manoeuvre: str
    """Trials of one manoeuvre with equal commands are replicates."""
    command: Command
    """Commanded speed and yaw rate."""
    odometry: OdometryStream | None
    """What it reported; None where that was not logged."""
    ground_truth: PoseStream | None
    """Its pose as measured from outside; None where that was not logged."""
    start: Start
    """Pose and speed at t = 0."""
    held_out: bool = False
    """Whether a fit must not look at it."""
    group: str = ""
    """Terrain or robot; part of a selection."""
    breaks: tuple[tuple[float, float], ...] = ()
    """Times between which the outside pose moved by an unknown amount [s]."""
    gyro: GyroStream | None = None
    """Turn of the body by a yaw rate measured on the vehicle, counter-clockwise."""

    @property
    def duration(self) -> float:
        """Time of the last measurement [s]; the trial starts at 0."""
        return max(float(s.t[-1]) for s in (self.odometry, self.ground_truth) if s is not None)

    def commanded(self, t: np.ndarray) -> np.ndarray:
        """(2, T) v [m/s] and omega [rad/s] in force at times t (T,) [s]; before the first command the start's."""
        return self.command.at(t, (self.start.v, self.start.omega))


@dataclass(frozen=True)
class Prediction:
    """A simulated trial at the times of the measurements."""

    ground_truth: PoseStream | None
    odometry: OdometryStream | None
    gyro: GyroStream | None = None


def cell_of(start: Start) -> tuple[float, float]:
    """Whole multiples of `FAR` that are nearest to x and y of a start [m]; 0 where that is near the origin."""
    if np.hypot(start.x, start.y) <= FAR:
        return 0.0, 0.0
    return FAR * round(start.x / FAR), FAR * round(start.y / FAR)


def seen_from(trial: Trial, place: tuple[float, float]) -> Trial:
    """The same trial in a room whose origin is at a place x, y [m] of the former one."""
    pose, (x, y) = trial.ground_truth, place
    if pose is None or not (x or y):
        return trial
    return replace(trial, ground_truth=replace(pose, x=pose.x - x, y=pose.y - y),
                   start=replace(trial.start, x=trial.start.x - x, y=trial.start.y - y))


def command_in_force(command: Command, t: np.ndarray) -> np.ndarray:
    """Index of the command that holds at times t (T,); -1 before the first."""
    return np.searchsorted(command.t, t + 1e-9, side="right") - 1


@dataclass(frozen=True)
class Log:
    """All trials of one vehicle."""

    name: str
    """Of its folder."""
    spec: VehicleSpec
    """Nominal vehicle that was driven."""
    trials: tuple[Trial, ...]
    """All drives, training and held out."""
    sha256: str
    """Over names and contents of its files."""
    notes: tuple[str, ...] = ()
    """What its reader found worth saying."""
    fields: dict[str, Any] = field(default_factory=dict)
    """Content of dataset.toml."""

    @property
    def training(self) -> tuple[Trial, ...]:
        """The trials that are fitted."""
        return tuple(trial for trial in self.trials if not trial.held_out)

    @property
    def held_out(self) -> tuple[Trial, ...]:
        """The trials that are kept aside."""
        return tuple(trial for trial in self.trials if trial.held_out)

    def select(self, keep: Callable[[Trial], bool]) -> Log:
        """The same log with only the trials that `keep` accepts."""
        return replace(self, trials=tuple(trial for trial in self.trials if keep(trial)))


def hash_files(folder: Path) -> str:
    """SHA-256 over names and contents of all data files of a dataset."""
    digest = hashlib.sha256()
    results = {path.parent for path in folder.rglob(RUN_FILE)}  # of commands that were given a place in here
    for path in sorted(folder.rglob("*")):
        unfinished = any(part.startswith(".") for part in path.relative_to(folder).parts)  # of a killed conversion
        if unfinished or not results.isdisjoint(path.parents):
            continue
        if path.suffix in (".toml", ".csv", ".npz", ".gz") and path.is_file():
            digest.update(str(path.relative_to(folder)).encode() + b"\0")
            with path.open("rb") as file:
                while part := file.read(1 << 20):
                    digest.update(part)
    return digest.hexdigest()


def name_of(path: Path) -> str:
    """Name of a file or folder, also of one that is given as `.` or `..`."""
    return Path(os.path.abspath(path)).name


def spaced(t: np.ndarray, least: float) -> np.ndarray:
    """Indices of times (T,), the first one and each that is at least so much later than the last one taken [s]."""
    kept, latest = [], -np.inf
    for i, now in enumerate(t):
        if now >= latest + least:
            kept.append(i)
            latest = now
    return np.array(kept, int)


def held_from_middle(rates: Command) -> Command:
    """Measured speeds as commands: each holds from half an interval before its time to half an interval after."""
    middle = (rates.t[1:] + rates.t[:-1]) / 2
    return Command(np.concatenate([rates.t[:1], middle]), rates.v, rates.omega)


def with_timeout(command: Command, timeout: float) -> Command:
    """The commands that a base takes which stops where none has come for a time [s]."""
    pauses = np.diff(np.append(command.t, np.inf)) > timeout + 1e-6
    stop = pauses & ((command.v != 0) | (command.omega != 0))
    t = np.concatenate([command.t, command.t[stop] + timeout])
    order = np.argsort(t, kind="stable")
    zero = np.zeros(int(stop.sum()))
    return Command(t[order], np.append(command.v, zero)[order], np.append(command.omega, zero)[order])


def manoeuvre_of(trial_name: str) -> str:
    """Name without its replicate, drive number or date: circle_2, circle_2-03, circle_2024_05_31-10_20_30 -> circle."""
    recording = re.sub(r"(?<=\w)-\d{2,3}$", "", trial_name)
    undated = re.sub(r"(?<=\w)_\d{4}_\d\d_\d\d-\d\d_\d\d_\d\d(_\d+)?$", "", recording)
    return re.sub(r"_\d+$", "", recording) if undated == recording else undated
