"""Drives cut out of recordings: whole, or between standstills, each on a clock of its own."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from sysid.logs.bags.recording import OPTIONS
from sysid.logs.planar import integrate_speeds, turned_by
from sysid.logs.records import Command, PoseStream, Trial, logged_pose
from whill_mjx.io.command_line import Range, With

STILL = 1e-3  # m/s, rad/s of commands that a vehicle does not follow
MOVING = {"v": 0.02, "omega": 0.03}  # m/s, rad/s of the odometry above which the vehicle counts as moving
LEAD = 2.0  # s of standstill kept before and after a drive
SHORTEST = 1.0  # s of motion below which a drive is left out
LEFT_OUT = 0.1  # share of what was measured that a short stream costs, above which a note says so


@dataclass(frozen=True)
class ConvertConfig:
    source: Path
    """ROS bag, CSV or TUM file, folder of one of them, LeRobotDataset, or a measured set."""
    out: Path = Path("runs/dataset")
    """Dataset folder; made where it does not exist, else the trials are added."""
    to: Literal["dataset", "lerobot"] = "dataset"
    """What is written: a driving-log dataset, or a LeRobotDataset v3 of a driving-log dataset."""
    fps: Annotated[int | None, Range(1, 1000), With("to", ("lerobot",))] = None
    """Frames per second of a LeRobotDataset that is written; by default the rate of the measurements."""
    vehicle: str = "whill_cr"
    """Built-in vehicle whose nominal geometry is noted, or any name with --wheel-radius and --track; measured sets know
    their own."""
    wheel_radius: Annotated[float | None, Range(0.001, 2)] = None
    """Nominal wheel radius [m], where it is not the vehicle's."""
    track: Annotated[float | None, Range(0.01, 5)] = None
    """Nominal track [m], where it is not the vehicle's."""
    mass: Annotated[float | None, Range(0.01, 1e4)] = None
    """Mass [kg], where it is not the vehicle's."""
    command_topic: str | None = None
    """Twist or TwistStamped sent to the vehicle."""
    odometry_topic: str | None = None
    """The vehicle's own Odometry; '' goes without."""
    truth_topic: str | None = None
    """Outside measurement of the drive-axle centre: Odometry, PoseStamped, TransformStamped; '' goes without."""
    imu_topic: str | None = None
    """Imu with the yaw rate of the body about its z axis; '' goes without."""
    truth_ahead: Annotated[float, Range(-10, 10)] = 0.0
    """How far the tracked point lies ahead of the drive-axle centre [m]."""
    truth_left: Annotated[float, Range(-10, 10)] = 0.0
    """How far it lies to the left of it [m]."""
    truth_turned: Annotated[float, Range(-360, 360)] = 0.0
    """How far the tracked body's x axis is turned to the left of the vehicle's [deg]."""
    input: Literal["auto", "commands", "wheels"] = "auto"
    """What drives the model: commands, or measured wheel speeds (of joint states or odometry); auto takes the latter
    where no recording has commands."""
    stamp: Literal["receive", "header"] = "receive"
    """Time of receipt (one clock for all), or the header's (when measured)."""
    split: Literal["bag", "standstill"] = "bag"
    """One trial per bag, or one per drive between standstills."""
    pause: Annotated[float, Range(0, 3600), With("split", ("standstill",))] = 2.0
    """Least standstill between two drives [s]."""
    held_out: tuple[str, ...] = ()
    """Trials that are never to be fitted."""
    select: tuple[str, ...] = ()
    """Part of a measured set: RUN, GROUP or robotN."""
    columns: tuple[str, ...] = ()
    """What columns of CSV files hold, each as ROLE=[FILE/]COLUMN[:UNIT], e.g. command.v=speed_set:km/h; the rest is
    guessed."""
    command_timeout: Annotated[float | None, Range(0.01, 60)] = None
    """How long the base drives on where no command comes [s]; by default a command holds until the next."""


@dataclass(frozen=True)
class Drive:
    """One trial to be written: tables with t [s] from its own origin in the first column."""

    name: str
    command: np.ndarray  # (T, 3)
    odometry: np.ndarray | None  # (T, 6)
    ground_truth: np.ndarray | None  # (T, 4)
    imu: np.ndarray | None = None  # (T, 2)


@dataclass(frozen=True)
class Source:
    """What a recording says of itself: where it is, and its streams by their own names."""

    path: Path
    streams: dict[str, str]


def cut_drives(
    stem: str, tables: dict[str, np.ndarray], source: Source, config: ConvertConfig
) -> tuple[list[Drive], list[str]]:
    """The trials of one recording, whole or cut at standstill, and notes."""
    if "ground_truth" in tables:
        tables["ground_truth"] = at_axle(tables["ground_truth"], config)
    notes, spans = _short_stream(tables, source), [_shared(tables)]
    if config.split == "standstill":
        spans = drive_spans(tables, config.pause)
        notes.append(f"{len(spans)} drives between standstills of {config.pause:g} s")
    names = [stem] if len(spans) == 1 else [f"{stem}-{number:02d}" for number in range(1, len(spans) + 1)]
    return [cut(name, tables, span, source) for name, span in zip(names, spans, strict=True)], notes


def _measured(tables: dict[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """Begin and end [s] of each stream that a trial must have throughout."""
    return {name: (float(table[0, 0]), float(table[-1, 0])) for name, table in tables.items()
            if name not in ("command", "imu")}


def _shared(tables: dict[str, np.ndarray]) -> tuple[float, float]:
    """Begin and end [s] of what all measured streams cover."""
    begins, ends = zip(*_measured(tables).values(), strict=True)
    return max(begins), min(ends)


def _short_stream(tables: dict[str, np.ndarray], source: Source) -> list[str]:
    """A note on the measured stream that covers least, where the others lose much by it."""
    spans = _measured(tables)
    begin, end = min(first for first, _ in spans.values()), max(last for _, last in spans.values())
    first, last = _shared(tables)
    if last - first >= (1 - LEFT_OUT) * (end - begin):
        return []
    name = min(spans, key=lambda one: spans[one][1] - spans[one][0])
    stream, origin = source.streams.get(name, name), _origin(tables)
    remedy = f"leave it out ({OPTIONS[name]} '')" if stream.startswith("/") else "convert without it"
    covers = f"{spans[name][0] - origin:.1f} to {spans[name][1] - origin:.1f} s of {end - origin:.1f} s"
    return [f"{stream} covers {covers}: what was measured outside of that is left out. To keep it, {remedy}"]


def cut(name: str, tables: dict[str, np.ndarray], span: tuple[float, float], source: Source) -> Drive:
    """The part of a recording between two times [s] as a trial on a clock of its own, with the command then in force.

    Odometry is moved to start at the origin with heading 0.
    """
    begin, end = span
    found: dict[str, np.ndarray] = {}
    for stream, table in tables.items():
        inside = table[(table[:, 0] >= begin - 1e-9) & (table[:, 0] <= end + 1e-9)].copy()
        if stream == "command":
            before = table[table[:, 0] <= begin + 1e-6]
            first = before[-1, 1:] if len(before) else np.zeros(2)
            inside = np.vstack([[begin, *first], inside[inside[:, 0] > begin + 1e-6]])
        if len(inside) < 2 and stream == "imu":
            continue
        if len(inside) < 2:
            raise ValueError(f"{source.path}: {source.streams[stream]} has {len(inside)} messages in the drive "
                             f"from {begin - _origin(tables):.1f} to {end - _origin(tables):.1f} s; at least 2 are "
                             "needed. Use --split bag, or leave the topic out.")
        inside[:, 0] -= begin
        found[stream] = inside
    if "odometry" in found:
        found["odometry"][:, 3] = np.unwrap(found["odometry"][:, 3])
        pose = PoseStream(*found["odometry"][:, :4].T)
        found["odometry"][:, 1:4] = pose.seen_from(*found["odometry"][0, 1:4]).values
    return Drive(name, found["command"], found.get("odometry"), found.get("ground_truth"), found.get("imu"))


def drive_spans(tables: dict[str, np.ndarray], pause: float) -> list[tuple[float, float]]:
    """Begin and end [s] of each drive: commanded or measured motion, with up to LEAD s of standstill around it."""
    t, moving = _motion(tables)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(int)))
    runs = [(t[a], t[min(b, len(t) - 1)]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    merged: list[tuple[float, float]] = []
    for begin, end in runs:
        if merged and begin - merged[-1][1] < pause:
            merged[-1] = merged[-1][0], end
        else:
            merged.append((begin, end))
    merged = [(begin, end) for begin, end in merged if end - begin >= SHORTEST]
    first, last = _shared(tables)
    spans = []
    for k, (begin, end) in enumerate(merged):
        low = (merged[k - 1][1] + begin) / 2 if k else first
        high = (end + merged[k + 1][0]) / 2 if k + 1 < len(merged) else last
        span = max(begin - LEAD, low, first), min(end + LEAD, high, last)
        if span[1] - span[0] >= SHORTEST:
            spans.append(span)
    return spans


def _motion(tables: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Times (G,) [s] every 20 ms, and where the command or the odometry moves (G,) bool."""
    begin, end = min(table[0, 0] for table in tables.values()), max(table[-1, 0] for table in tables.values())
    t = np.arange(begin, end, 0.02)
    moving = (np.abs(Command(*tables["command"].T).at(t, (0.0, 0.0))) > STILL).any(axis=0)
    if "odometry" in tables:
        v, omega = (np.interp(t, tables["odometry"][:, 0], tables["odometry"][:, k]) for k in (4, 5))
        moving |= (np.abs(v) > MOVING["v"]) | (np.abs(omega) > MOVING["omega"])
    return t, moving


def trial_drive(trial: Trial) -> Drive:
    """A trial in memory as tables; a window that starts in motion keeps its start pose as its first pose."""
    odometry = pose = imu = None
    if (source := trial.odometry) is not None:
        logged = logged_pose(source)
        poses = np.array(integrate_speeds(source.t, source.v, source.omega)) if logged is None else logged.values.T
        odometry = np.column_stack([source.t, *poses, source.v, source.omega])
    if (truth := trial.ground_truth) is not None:
        pose = np.column_stack([truth.t, truth.values])
        if pose[0, 0] > 1e-6:
            pose = np.vstack([[0.0, trial.start.x, trial.start.y, trial.start.yaw], pose])
        pose[:, 3] = np.angle(np.exp(1j * pose[:, 3]))
    if trial.gyro is not None and len(trial.gyro.t) > 1:
        imu = np.column_stack([trial.gyro.t, np.gradient(trial.gyro.turn, trial.gyro.t)])
    return Drive(re.sub(r"[^\w.-]+", "-", trial.name), trial.command.table, odometry, pose, imu)


def at_axle(truth: np.ndarray, config: ConvertConfig) -> np.ndarray:
    """Rows (T, 4) of an outside pose at the drive-axle centre and along the vehicle."""
    t, x, y, yaw = truth.T
    yaw = yaw - np.deg2rad(config.truth_turned)
    ahead, left = turned_by(config.truth_ahead, config.truth_left, yaw)
    return np.column_stack([t, x - ahead, y - left, np.angle(np.exp(1j * yaw))])


def _origin(tables: dict[str, np.ndarray]) -> float:
    return min(float(table[0, 0]) for table in tables.values())
