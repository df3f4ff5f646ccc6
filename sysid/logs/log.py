"""Measured driving logs in memory, and the loader of the driving-log dataset (docs/log_format.md).

Every stream keeps its own clock, as real logs do. All quantities are SI, yaw is unwrapped on loading. Poses are of the
reference point: the centre of the driven axle (the vehicle's centre for skid drive).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.gyro import with_sign
from whill_mjx.io import fields as tables
from whill_mjx.io.folders import RUN_FILE
from whill_mjx.io.formats import upgraded
from whill_mjx.io.reading import read_csv as read_table
from whill_mjx.io.reading import read_toml
from whill_mjx.vehicle.specs import HUSKY, SPECS, WHILL_CR, VehicleSpec, in_proportion

SCHEMA = 1
STANDSTILL = 1.0
"""Longest part of a trial's start that is used to find its start pose [s]."""
START_NOISE = 0.03  # m/s, rad/s below which a trial that begins with a command to move begins at rest

SLOWEST = 4.0  # s between rows that no log has in all of its streams
LEAST_ROWS = 10  # of a stream to be asked for its rate
LONGER = 200.0  # times that one stream of a trial lasts as long as another, which no recording does
TIME_UNITS = (("nanoseconds", 1e9), ("microseconds", 1e6), ("milliseconds", 1e3))

COMMAND_COLUMNS = ("t", "v", "omega")
ODOMETRY_COLUMNS = ("t", "x", "y", "yaw", "v", "omega")
POSE_COLUMNS = ("t", "x", "y", "yaw")
GYRO_COLUMNS = ("t", "gyro")
GYRO_SPACING = 0.05
"""Least time between samples of a gyro [s]: quicker ones are added up, which loses nothing of what they turn."""


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


@dataclass(frozen=True)
class GyroStream:
    """The turn of the body, added up from a yaw rate that is measured on the vehicle."""

    t: np.ndarray  # (T,) s
    turn: np.ndarray  # (T,) rad, from the first sample

    @classmethod
    def of_rates(cls, t: np.ndarray, omega: np.ndarray) -> GyroStream:
        """That of yaw rates (T,) [rad/s], at samples that are at least `GYRO_SPACING` apart."""
        turn = np.concatenate([[0.0], np.cumsum(np.diff(t) * (omega[1:] + omega[:-1]) / 2)])
        kept, last = [], -np.inf
        for i, now in enumerate(t):
            if now - last >= GYRO_SPACING - 1e-9:
                kept.append(i)
                last = now
        return cls(t[kept], turn[kept])

    @property
    def values(self) -> np.ndarray:
        """(T, 1) of the turn."""
        return self.turn[:, None]

    def until(self, end: float) -> GyroStream:
        """The samples up to a time [s]."""
        inside = self.t <= end
        return GyroStream(self.t[inside], self.turn[inside])


@dataclass(frozen=True)
class Start:
    """Where and how fast the vehicle starts: room frame, reference point."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    v: float = 0.0
    omega: float = 0.0
    position_sigma: float = 0.0
    """Standard error of x and y [m]."""
    yaw_sigma: float = 0.0
    """Standard error of yaw [rad]."""
    odometry_position_sigma: float = 0.0
    """Standard error of the origin from which the odometry counts x and y [m]."""
    odometry_yaw_sigma: float = 0.0
    """Standard error of the heading from which it counts yaw, and along which x points [rad]."""
    measured: bool = False
    """Whether the pose is the outside measurement at t = 0 itself."""
    rest: float = 0.0
    """Until when poses were averaged for it [s]."""


@dataclass(frozen=True)
class Trial:
    """One drive (or one window of a longer one)."""

    name: str
    """Of its folder, or of the window."""
    manoeuvre: str
    """Trials of one manoeuvre with equal commands are replicates."""
    command: Command
    """What the vehicle was told."""
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


def load_log(folder: str | Path) -> Log:
    """Load a driving-log dataset.

    Raises:
        FileNotFoundError, ValueError: naming the file, the value, the rule and the remedy.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "a file" if folder.exists() else "no such folder"
        raise FileNotFoundError(f"{folder}: {what}. Give the folder that holds dataset.toml and trials/.")
    fields = read_fields(folder / "dataset.toml")
    spec, notes = spec_from_fields(folder / "dataset.toml", fields)
    held_out = fields.get("held_out", [])
    trial_folders = sorted(path for path in (folder / "trials").glob("*") if path.is_dir())
    if not trial_folders:
        raise ValueError(f"{folder / 'trials'}: no trial in it. Each trial is a folder trials/NAME with command.csv.")
    unknown = sorted(set(held_out) - {path.name for path in trial_folders})
    if unknown:
        raise ValueError(f"{folder / 'dataset.toml'}: held_out names {unknown}, which are not under trials/. "
                         "Correct the names, or nothing is really held out.")
    timeout = fields.get("command_timeout")
    trials = tuple(load_trial(path, path.name in held_out, timeout) for path in trial_folders)
    trials, said = with_sign(trials)
    notes += said
    if fields.get("input") == "wheels":
        trials = tuple(replace(trial, command=held_from_middle(trial.command)) for trial in trials)
        notes.append("the input is measured wheel speeds, not commands: delays, drive and limits do not show")
    return Log(folder.name, spec, trials, hash_files(folder), tuple(notes), fields)


def load_trial(folder: Path, held_out: bool = False, timeout: float | None = None) -> Trial:
    """Load and check one trial folder.

    Args:
        timeout: after which the base stops where no command comes [s]; None where a command holds until the next.
    """
    command_columns = read_csv(folder / "command.csv", COMMAND_COLUMNS)
    command = Command(**{name: command_columns[name] for name in COMMAND_COLUMNS})
    odometry = ground_truth = None
    if (folder / "odometry.csv").exists():
        columns = read_csv(folder / "odometry.csv", ODOMETRY_COLUMNS)
        odometry = OdometryStream(**{name: columns[name] for name in ODOMETRY_COLUMNS})
    if (folder / "ground_truth.csv").exists():
        columns = read_csv(folder / "ground_truth.csv", POSE_COLUMNS)
        ground_truth = PoseStream(**{name: columns[name] for name in POSE_COLUMNS})
    if odometry is None and ground_truth is None:
        raise ValueError(f"{folder}: neither odometry.csv nor ground_truth.csv. A trial needs at least one of them.")
    _check_seconds(folder, {name: one.t for name, one in (("command.csv", command), ("odometry.csv", odometry), (
        "ground_truth.csv", ground_truth)) if one is not None})
    for name, stream in (("odometry.csv", odometry), ("ground_truth.csv", ground_truth)):
        if stream is not None:
            _check_reach(folder / name, stream, command)  # before unwrapping, which would hide degrees
    if odometry is not None and odometry.yaw is not None:
        odometry = replace(odometry, yaw=np.unwrap(odometry.yaw))
    if ground_truth is not None:
        ground_truth = replace(ground_truth, yaw=np.unwrap(ground_truth.yaw))
    if timeout is not None:
        command = with_timeout(command, timeout)
    trial = make_trial(folder.name, command, odometry, ground_truth, held_out=held_out)
    return replace(trial, gyro=_read_gyro(folder / "imu.csv", trial.duration))


def _read_gyro(path: Path, end: float) -> GyroStream | None:
    """What a gyro turned until a time [s]; None where there is no file, or fewer than two samples in it."""
    if not path.exists():
        return None
    columns = read_csv(path, GYRO_COLUMNS)
    inside = (columns["t"] >= 0) & (columns["t"] <= end)
    if inside.sum() < 2:
        return None
    return GyroStream.of_rates(columns["t"][inside], columns["gyro"][inside])


def make_trial(
    name: str, command: Command, odometry: OdometryStream | None, ground_truth: PoseStream | None,
    held_out: bool = False,
) -> Trial:
    """A trial with its start: the pose is the mean over the standstill before the first command, at most one second;
    the odometry is counted from there.

    A trial whose first command already moves starts in motion, at the speeds that the odometry then reports, or at
    those commanded where there is no odometry. Such a start is known from its first sample alone.
    """
    still = standstill_end(command)
    v, omega = _start_speeds(command, odometry)
    start = Start(v=v, omega=omega, rest=still)
    if ground_truth is not None:
        rest = _rest(ground_truth.t, still)
        x, y, yaw = ground_truth.x[rest], ground_truth.y[rest], ground_truth.yaw[rest]
        position_sigma, yaw_sigma = _standard_errors(x, y, yaw)
        start = Start(float(x.mean()), float(y.mean()), float(yaw.mean()), v, omega, position_sigma, yaw_sigma,
                      rest=still)
    if odometry is not None and odometry.x is not None and odometry.y is not None and odometry.yaw is not None:
        rest = _rest(odometry.t, still)
        position_sigma, yaw_sigma = _standard_errors(odometry.x[rest], odometry.y[rest], odometry.yaw[rest])
        start = replace(start, odometry_position_sigma=position_sigma, odometry_yaw_sigma=yaw_sigma)
        x, y = odometry.x - odometry.x[rest].mean(), odometry.y - odometry.y[rest].mean()
        yaw0 = odometry.yaw[rest].mean()
        cos, sin = np.cos(yaw0), np.sin(yaw0)
        odometry = replace(odometry, x=cos * x + sin * y, y=-sin * x + cos * y, yaw=odometry.yaw - yaw0)
    return Trial(name, manoeuvre_of(name), command, odometry, ground_truth, start, held_out)


def held_from_middle(rates: Command) -> Command:
    """Measured speeds as commands: each holds from half an interval before its time to half an interval after."""
    middle = (rates.t[1:] + rates.t[:-1]) / 2
    return Command(np.concatenate([rates.t[:1], middle]), rates.v, rates.omega)


def with_timeout(command: Command, timeout: float) -> Command:
    """The commands that a base takes which stops where none has come for a time [s]: standstill in each longer pause,
    and after the last."""
    pauses = np.diff(np.append(command.t, np.inf)) > timeout + 1e-6
    stop = pauses & ((command.v != 0) | (command.omega != 0))
    t = np.concatenate([command.t, command.t[stop] + timeout])
    order = np.argsort(t, kind="stable")
    zero = np.zeros(int(stop.sum()))
    return Command(t[order], np.append(command.v, zero)[order], np.append(command.omega, zero)[order])


def manoeuvre_of(trial_name: str) -> str:
    """Name without its replicate number, the number of a drive within a recording, or a recorder's date: circle_2,
    circle_2-03 and circle_2024_05_31-10_20_30 -> circle."""
    recording = re.sub(r"(?<=\w)-\d{2,3}$", "", trial_name)
    undated = re.sub(r"(?<=\w)_\d{4}_\d\d_\d\d-\d\d_\d\d_\d\d(_\d+)?$", "", recording)
    return re.sub(r"_\d+$", "", recording) if undated == recording else undated


def standstill_end(command: Command) -> float:
    """Time of the first command to move, at most one second after the first command [s]."""
    moving = np.flatnonzero((np.abs(command.v) > 1e-6) | (np.abs(command.omega) > 1e-6))
    first = command.t[moving[0]] if len(moving) else np.inf
    return float(min(first, command.t[0] + STANDSTILL))


def read_csv(path: Path, columns: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Columns of a CSV file as float arrays, checked for presence, numbers, time order and range."""
    data = read_table(path, [tables.COLUMNS[name] for name in columns],
                      f"missing. A trial needs it with the columns {', '.join(columns)}.", "See docs/log_format.md.")
    line = data.pop("line")
    back = np.flatnonzero(np.diff(data["t"]) <= 0)
    if len(back):
        row = int(back[0])
        before, after = data["t"][row], data["t"][row + 1]
        raise ValueError(f"{path}, line {line[row + 1]}: t goes from {before:g} to {after:g}; it must increase. "
                         "Sort the rows, drop duplicates, and split the trial where its clock was set back.")
    return data


def spec_from_fields(path: Path, fields: dict[str, Any]) -> tuple[VehicleSpec, list[str]]:
    """Vehicle spec from the fields of dataset.toml, and notes on what had to be assumed."""
    name = fields["vehicle"]
    sizes: dict[str, Any] = {field.name: fields[field.name] for field in tables.SIZES if field.name in fields}  # m, kg
    for key in ("wheel_radius", "track"):
        if key not in sizes and name not in SPECS:
            raise ValueError(f"{path}: no {key}. Add {key} = VALUE in metres, measured on the vehicle.")
    changes: dict[str, Any] = {key: fields[key] for key in ("drive", "driven_axle") if key in fields}
    if name in SPECS:
        base, source = replace(SPECS[name], **sizes), f"that of {name}"
    else:
        like = HUSKY if fields.get("drive") == "skid" else WHILL_CR
        base, source = in_proportion(like, name, **sizes), f"in proportion to {like.name}"
    notes = [f"{key} is not in dataset.toml: {getattr(base, key):.3g} is assumed, {source}"
             for key in ("wheel_radius", "track", "wheelbase", "mass") if key not in sizes]
    if "command_limits" in fields:
        v, omega = fields["command_limits"]
        changes.update(v_min=-v, v_max=v, omega_max=omega)
    try:
        return replace(base, **changes), notes
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def check_same_vehicle(log: Log, spec: VehicleSpec, place: str, rule: str) -> None:
    """Raise ValueError where a vehicle of another geometry is given beside a log.

    Args:
        place: where it was given.
        rule: the rule that is broken, in words.
    """
    for name in ("wheel_radius", "track", "wheelbase", "drive"):
        mine, theirs = getattr(log.spec, name), getattr(spec, name)
        if mine != theirs:
            raise ValueError(f"{place}: {name} is {theirs}, but {mine} in {log.name!r}. {rule}; correct dataset.toml "
                             "or leave it out.")


def hash_files(folder: Path) -> str:
    """SHA-256 over names and contents of all data files of a dataset."""
    digest = hashlib.sha256()
    results = {path.parent for path in folder.rglob(RUN_FILE)}  # of commands that were given a place in here
    for path in sorted(folder.rglob("*")):
        if not results.isdisjoint(path.parents):
            continue
        if path.suffix in (".toml", ".csv", ".npz", ".gz") and path.is_file():
            digest.update(str(path.relative_to(folder)).encode() + b"\0")
            with path.open("rb") as file:
                while part := file.read(1 << 20):
                    digest.update(part)
    return digest.hexdigest()


def read_fields(path: Path) -> dict[str, Any]:
    """Checked fields of a dataset.toml."""
    content = read_toml(path, "missing. A dataset needs it to name the vehicle, its geometry and the held-out trials; "
                              "see docs/log_format.md.", "Strings need quotes, decimals a point.")
    content = upgraded("driving-log-dataset", content)
    schema = next(field for field in tables.DATASET if field.name == "schema")
    tables.check(str(path), schema, content.get("schema"))  # before the fields, which follow from it
    return tables.check_table(str(path), tables.DATASET, content)


def _check_seconds(folder: Path, times: dict[str, np.ndarray]) -> None:
    """Rows must not be as far apart as no recording's are: this finds milliseconds and smaller units.

    Args:
        times: of each file (T,).
    """
    steps = {name: float(np.median(np.diff(t))) for name, t in times.items() if len(t) > 1}
    spans = {name: float(t[-1] - t[0]) for name, t in times.items() if len(t) > 1}
    for name, t in times.items():
        if steps.get(name, 0.0) <= SLOWEST:
            continue
        shortest = min(spans, key=lambda other: spans[other])
        longer = spans[name] / max(spans[shortest], 1e-9)
        if longer < LONGER and (len(t) < LEAST_ROWS or name == "command.csv" and min(steps.values()) <= SLOWEST):
            continue  # commands may be sent only when they change
        step, others = steps[name], ""
        if longer > LONGER:
            size = min((size for _, size in TIME_UNITS), key=lambda size: abs(np.log(longer / size)))
            unit = next(unit for unit, one in TIME_UNITS if one == size)
            others = f", and lasts {longer:.2g} times as long as {shortest}"
        else:
            unit, size = next((one for one in TIME_UNITS if step > 1.5e-3 * one[1]), TIME_UNITS[-1])
        raise ValueError(f"{folder / name}: t steps by {step:g} from row to row, a rate of {1 / step:.2g} Hz if that "
                         f"were seconds{others}: it seems to be in {unit}. Divide t by {size:.0f}"
                         f"{' in all streams' if not others and len(times) > 1 else ''}.")


def _check_reach(path: Path, stream: OdometryStream | PoseStream, command: Command) -> None:
    """Distance and turn must be possible under the commands: this finds degrees, millimetres and wrong trials."""
    if stream.t[-1] < command.t[0] or stream.t[0] > command.t[-1] + 60:
        raise ValueError(f"{path}: covers {stream.t[0]:g} to {stream.t[-1]:g} s but the commands cover "
                         f"{command.t[0]:g} to {command.t[-1]:g} s. All streams of a trial count from one origin.")
    hold = np.diff(np.append(command.t, max(stream.t[-1], command.t[-1])))
    distance = 5.0 + 3.0 * float((np.abs(command.v) * hold).sum())
    turn = 2 * np.pi + 3.0 * float((np.abs(command.omega) * hold).sum())
    for name, limit, hint in (("x", distance, "metres"), ("y", distance, "metres"), ("yaw", turn, "radians")):
        values = getattr(stream, name)
        if values is not None and np.ptp(values) > limit:
            raise ValueError(f"{path}: {name} spans {np.ptp(values):g}, though the commands allow {limit:.3g} at most. "
                             f"Convert it to {hint}, or correct the commands.")


def _start_speeds(command: Command, odometry: OdometryStream | None) -> tuple[float, float]:
    """Speed [m/s] and yaw rate [rad/s] at the start; exactly 0 at rest, whatever the sensors' noise."""
    at_start = float(command.v[0]), float(command.omega[0])
    if command.t[0] > 0 or max(abs(at_start[0]), abs(at_start[1])) < 1e-6:
        return 0.0, 0.0
    speeds = at_start if odometry is None else (float(odometry.v[0]), float(odometry.omega[0]))
    return speeds if max(abs(speeds[0]), abs(speeds[1])) > START_NOISE else (0.0, 0.0)


def _rest(t: np.ndarray, still: float) -> np.ndarray:
    """Indices of the samples before the vehicle moves; the first sample where there is none."""
    indices = np.flatnonzero(t <= still)
    return indices if len(indices) else np.array([0])


def _standard_errors(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> tuple[float, float]:
    """Of the mean position, per axis, and of the mean yaw over samples (M,) at rest; 0 of a single sample."""
    if len(x) < 2:
        return 0.0, 0.0
    position = np.sqrt((x.var(ddof=1) + y.var(ddof=1)) / 2 / len(x))
    return float(position), float(np.sqrt(yaw.var(ddof=1) / len(x)))


@dataclass(frozen=True)
class Prediction:
    """A simulated trial at the times of the measurements."""

    ground_truth: PoseStream | None
    odometry: OdometryStream | None
    gyro: GyroStream | None = None


def command_in_force(command: Command, t: np.ndarray) -> np.ndarray:
    """Index of the command that holds at times t (T,); -1 before the first."""
    return np.searchsorted(command.t, t + 1e-9, side="right") - 1
