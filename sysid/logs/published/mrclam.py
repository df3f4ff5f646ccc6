"""The MRCLAM set, five iRobot Create and motion capture: UTIAS Multi-Robot Cooperative Localization and Mapping (Leung
et al., IJRR 2011, asrl.utias.utoronto.ca/datasets/mrclam)."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sysid.logs.published.poses import HELD, LARGEST, MAX_GAP, only_changes
from sysid.logs.records import Command, Log, PoseStream, Start, Trial, hash_files, spaced
from whill_mjx.io.reading import ARRAY_BYTES, LONGEST_REASON, read_gzip, read_text
from whill_mjx.vehicle.specs import CREATE

ORIGINAL = "Use the original file."
ROBOTS = ("robot1", "robot2", "robot3", "robot4", "robot5")
MRCLAM_WINDOW = 15.0  # s
MRCLAM_SPACING = 0.1  # s between scored poses; the motion capture runs at 65 Hz, its errors are correlated
START_SPAN = 0.15
"""Time before and after the start of an MRCLAM window [s] over which the speeds there are measured: its robots follow
their commands later than that."""


def mrclam_files(folder: Path, robot: str, kind: str) -> list[Path]:
    """Files of MRCLAM robots in a folder: as in its archives, or with the data set in front, packed or not."""
    return sorted(path for end in ("", ".gz") for path in folder.glob(f"*Robot{robot}_{kind}.dat{end}"))


def mrclam_robots(keys: Sequence[str]) -> tuple[int, ...]:
    """Numbers of the robots that selections name: robot1 or one of its trials; ValueError where one names none."""
    robots = [key.split("/")[0] for key in keys]
    for key, robot in zip(keys, robots, strict=True):
        if robot not in ROBOTS:
            raise ValueError(f"selection {key!r}: MRCLAM has robot1 to robot5. Give one of them.")
    return tuple(dict.fromkeys(ROBOTS.index(robot) + 1 for robot in robots))


def load_mrclam(folder: str | Path, robots: tuple[int, ...] = (1, 2, 3, 4, 5)) -> Log:
    """Load MRCLAM robots as consecutive windows in which the robot was commanded to move."""
    folder = Path(folder)
    found = [_mrclam_robot(folder, robot, MRCLAM_WINDOW) for robot in robots]
    return Log("mrclam", CREATE, tuple(trial for trials, _ in found for trial in trials), hash_files(folder),
               tuple(note for _, note in found))


def _mrclam_robot(folder: Path, robot: int, window: float) -> tuple[list[Trial], str]:
    command = _read_table(folder, robot, "Odometry", 3)
    truth = _read_table(folder, robot, "Groundtruth", 4)
    path = np.column_stack([truth[:, :3], np.unwrap(truth[:, 3])])
    begin, end = max(command[0, 0], truth[0, 0]), min(command[-1, 0], truth[-1, 0])
    trials = []
    for number, start_time in enumerate(np.arange(begin, end - window, window)):
        inside = np.flatnonzero((truth[:, 0] >= start_time) & (truth[:, 0] < start_time + window))
        if len(inside) < 10 or np.diff(truth[inside, 0]).max() > MAX_GAP:
            continue
        first = inside[0]
        t0 = truth[first, 0]
        held = max(int(np.searchsorted(command[:, 0], t0, side="right")) - 1, 0)
        last = int(np.searchsorted(command[:, 0], truth[inside[-1], 0], side="right"))
        t = np.maximum(command[held:last, 0] - t0, 0.0)
        v, omega = command[held:last, 1], command[held:last, 2]
        keep = np.append(np.diff(t) > 0, True)
        if not (np.abs(v) > 0.005).any() and not (np.abs(omega) > 0.02).any():
            continue
        pose = only_changes(path[inside, 0] - t0, *path[inside, 1:].T)
        some = spaced(pose.t, MRCLAM_SPACING)
        start = replace(_speeds(path, t0), x=float(path[first, 1]), y=float(path[first, 2]), yaw=float(path[first, 3]))
        trials.append(Trial(f"robot{robot}/{number:03d}", f"robot{robot}", Command(t[keep], v[keep], omega[keep]), None,
                            PoseStream(*(one[some] for one in vars(pose).values())), start, group=f"robot{robot}"))
    return trials, f"robot {robot}: {len(trials)} windows of {window:g} s; start speeds are those of the outside pose"


def _speeds(path: np.ndarray, at: float) -> Start:
    """A start with the speeds that a path (T, 4) of time, x, y and yaw shows around a time: its slopes."""
    near = path[np.abs(path[:, 0] - at) <= START_SPAN]
    t = near[:, 0] - near[:, 0].mean()
    vx, vy, omega = t @ near[:, 1:] / max(float(t @ t), HELD)
    yaw = near[:, 3].mean()
    return Start(v=float(vx * np.cos(yaw) + vy * np.sin(yaw)), omega=float(omega), measured=True)


def _read_table(folder: Path, robot: int, kind: str, columns: int) -> np.ndarray:
    """The table (T, columns) of a robot as published, packed or not, whatever the number of the data set."""
    found = mrclam_files(folder, str(robot), kind)
    path = found[0] if found else folder / f"Robot{robot}_{kind}.dat"
    if len(found) > 1:
        raise ValueError(f"{path}: there is another one, {found[1].name}. Give a folder with one data set.")
    missing = "missing. Robots are 1 to 5; get the files from asrl.utias.utoronto.ca/datasets/mrclam."
    packed = path.suffix == ".gz"
    text = read_gzip(path, missing, ORIGINAL) if packed else read_text(path, ARRAY_BYTES, missing)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty file, which is refused below
            table = np.loadtxt(io.StringIO(text), ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path}: {str(error)[:LONGEST_REASON]}. {ORIGINAL}") from None
    if table.shape[1] != columns or not len(table):
        raise ValueError(f"{path}: {table.shape} values; {columns} columns are needed. {ORIGINAL}")
    if not np.isfinite(table).all() or (np.abs(table[:, 1:]) >= LARGEST).any() or np.ptp(table[:, 0]) > LARGEST:
        raise ValueError(f"{path}: values must be finite and below {LARGEST:g}. {ORIGINAL}")
    if (np.diff(table[:, 0]) < 0).any():
        raise ValueError(f"{path}: time runs backwards. {ORIGINAL}")
    return table
