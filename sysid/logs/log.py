"""Measured driving logs in memory, and the loader of the driving-log dataset (docs/log_format.md).

Every stream keeps its own clock, as real logs do. All quantities are SI, yaw is unwrapped on loading. Poses are of the
reference point: the centre of the driven axle (the vehicle's centre for skid drive).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs.gyro import with_sign
from sysid.logs.planar import unwrapped
from sysid.logs.records import (
    Command,
    GyroStream,
    Log,
    OdometryStream,
    PoseStream,
    Start,
    Trial,
    cell_of,
    hash_files,
    held_from_middle,
    logged_pose,
    manoeuvre_of,
    name_of,
    seen_from,
    with_timeout,
)
from whill_mjx.io import fields as tables
from whill_mjx.io.formats import upgraded
from whill_mjx.io.reading import read_csv as read_table
from whill_mjx.io.reading import read_toml
from whill_mjx.vehicle.specs import HUSKY, SPECS, WHILL_CR, VehicleSpec, in_proportion

STANDSTILL = 1.0  # longest part of a trial's start that is used to find its start pose [s]
START_NOISE = 0.03  # m/s, rad/s below which a trial that begins with a command to move begins at rest

SLOWEST = 4.0  # s between rows that no log has in all of its streams
LEAST_ROWS = 10  # of a stream to be asked for its rate
LONGER = 200.0  # times that one stream of a trial lasts as long as another, which no recording does
STANDS = 1e-4  # m and rad by which a pose changes from row to row while the vehicle stands, at most
LEAST_WAY, WAY_POINTS = 0.3, 100  # m or rad that poses show, and how many of them are looked at
DOUBTED = 0.5  # s between rows, above which t may be in milliseconds as well: its rows come at below 2 kHz then
UNLIKE = 3.0  # factor by which the way by the speeds differs from that of the poses at most, in the right unit of time
TIME_UNITS = (("nanoseconds", 1e9), ("microseconds", 1e6), ("milliseconds", 1e3))

COMMAND_COLUMNS = ("t", "v", "omega")
ODOMETRY_COLUMNS = ("t", "x", "y", "yaw", "v", "omega")
POSE_COLUMNS = ("t", "x", "y", "yaw")
GYRO_COLUMNS = ("t", "gyro")


def load_log(folder: str | Path) -> Log:
    """Load a driving-log dataset; FileNotFoundError or ValueError names the file, value, rule and remedy."""
    folder = Path(folder)
    if not folder.is_dir():
        what = "a file" if folder.exists() else "no such folder"
        raise FileNotFoundError(f"{folder}: {what}. Give the folder that holds dataset.toml and trials/.")
    fields = read_fields(folder / "dataset.toml")
    spec, notes = spec_from_fields(folder / "dataset.toml", fields)
    held_out = fields.get("held_out", [])
    trial_folders = sorted(path for path in (folder / "trials").glob("[!.]*") if path.is_dir())
    if not trial_folders:
        raise ValueError(f"{folder / 'trials'}: no trial in it. Each trial is a folder trials/NAME with command.csv.")
    unknown = sorted(set(held_out) - {path.name for path in trial_folders})
    if unknown:
        raise ValueError(f"{folder / 'dataset.toml'}: held_out names {unknown}, which are not under trials/. "
                         "Correct the names, or nothing is really held out.")
    timeout = fields.get("command_timeout")
    trials = tuple(load_trial(path, path.name in held_out, timeout) for path in trial_folders)
    notes += [f"{path / 'imu.csv'}: hardly any of its rows lies within the trial, so the gyro is left out. All streams "
              "of a trial count from one origin" for path, trial in zip(trial_folders, trials, strict=True)
              if trial.gyro is None and (path / "imu.csv").exists()]
    trials, said = with_sign(trials)
    notes += said
    trials, said = _near_origin(trials)
    notes += said
    if fields.get("input") == "wheels":
        trials = tuple(replace(trial, command=held_from_middle(trial.command)) for trial in trials)
        notes.append("the input is measured wheel speeds, not commands: delays, drive and limits do not show")
    return Log(name_of(folder), spec, trials, hash_files(folder), tuple(notes), fields)


def _near_origin(trials: Sequence[Trial]) -> tuple[tuple[Trial, ...], list[str]]:
    """Trials in a room whose origin is near their starts, one for all as far as possible, and a note where it moved.

    Replays are in single precision: on a national grid a vehicle would not move at all.
    """
    place = next((cell_of(one.start) for one in trials if one.ground_truth is not None), (0.0, 0.0))
    near = tuple(seen_from(trial, place) for trial in trials)
    near = tuple(seen_from(trial, cell_of(trial.start)) for trial in near)
    return near, [f"the outside pose is far from the origin of its room: it is counted from x {place[0]:.0f} m, y "
                  f"{place[1]:.0f} m"] if any(place) else []


def load_trial(folder: Path, held_out: bool = False, timeout: float | None = None) -> Trial:
    """Load and check one trial folder; after `timeout` [s] without a command the base stops (None: never).

    The trial starts with the first row of its streams, unless that is within a second of 0.
    """
    command = Command(**read_csv(folder / "command.csv", COMMAND_COLUMNS))
    measured: dict[str, Any] = {
        name: kind(**read_csv(path, columns)) for name, kind, columns in (
            ("odometry", OdometryStream, ODOMETRY_COLUMNS), ("ground_truth", PoseStream, POSE_COLUMNS))
        if (path := folder / f"{name}.csv").exists()}
    imu = folder / "imu.csv"
    if not measured:
        raise ValueError(f"{folder}: neither odometry.csv nor ground_truth.csv. A trial needs at least one of them."
                         f"{' imu.csv alone shows no speed.' * imu.exists()}")
    _check_seconds(folder, {f"{name}.csv": one.t for name, one in {"command": command, **measured}.items()})
    for name, stream in measured.items():
        _check_way(folder / f"{name}.csv", stream, measured.get("odometry", command))
        _check_reach(folder / f"{name}.csv", stream, command)  # before unwrapping, which would hide degrees
    begin = min(float(one.t[0]) for one in (command, *measured.values()))
    begin = 0.0 if 0 <= begin <= STANDSTILL else begin  # replays begin at 0, whatever t counts from
    command = replace(command, t=command.t - begin)
    odometry, ground_truth = (None if (one := measured.get(name)) is None else replace(one, t=one.t - begin)
                              for name in ("odometry", "ground_truth"))
    if odometry is not None:
        odometry = replace(odometry, yaw=unwrapped(odometry.yaw, np.diff(command.turned(odometry.t))))
    if ground_truth is not None:
        t, known = ground_truth.t, logged_pose(odometry)
        turned = command.turned(t) if known is None else np.interp(t, known.t, known.yaw)
        ground_truth = replace(ground_truth, yaw=unwrapped(ground_truth.yaw, np.diff(turned)))
    if timeout is not None:
        command = with_timeout(command, timeout)
    trial = make_trial(folder.name, command, odometry, ground_truth, held_out=held_out)
    if not imu.exists():
        return trial
    t, rates = read_csv(imu, GYRO_COLUMNS).values()
    t = t - begin
    inside = (t >= 0) & (t <= trial.duration)
    return trial if inside.sum() < 2 else replace(trial, gyro=GyroStream.of_rates(t[inside], rates[inside]))


def make_trial(
    name: str, command: Command, odometry: OdometryStream | None, ground_truth: PoseStream | None,
    held_out: bool = False,
) -> Trial:
    """A trial with its start: the mean pose over at most one second of standstill before the first command.

    The odometry is counted from there. A first command that already moves starts in motion, at the speeds that the
    odometry has until it comes, or else at those commanded.
    """
    moving = np.flatnonzero((np.abs(command.v) > 1e-6) | (np.abs(command.omega) > 1e-6))
    still = float(min(command.t[moving[0]] if len(moving) else np.inf, command.t[0] + STANDSTILL))
    v, omega = _start_speeds(command, odometry)
    start = Start(v=v, omega=omega, rest=still)
    if ground_truth is not None:
        place, position_sigma, yaw_sigma = _at_rest(ground_truth, still)
        start = Start(*place, v, omega, position_sigma, yaw_sigma, rest=still)
    if odometry is not None and (pose := logged_pose(odometry)) is not None:
        place, position_sigma, yaw_sigma = _at_rest(pose, still)
        start = replace(start, odometry_position_sigma=position_sigma, odometry_yaw_sigma=yaw_sigma)
        odometry = replace(odometry, **vars(pose.seen_from(*place)))
    return Trial(name, manoeuvre_of(name), command, odometry, ground_truth, start, held_out)


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


def of_file(log: Log, spec: VehicleSpec, place: str) -> Log:
    """The log of the vehicle of a file: sizes and inertias are the file's, limits of commands stay the log's.

    ValueError where wheels or drive differ; `place` is the file, named in it.
    """
    check_same_vehicle(log, spec, place, "The vehicle file must be of the same vehicle",
                       ("wheel_radius", "track", "drive"))
    mine = log.spec
    spec = replace(spec, v_min=mine.v_min, v_max=mine.v_max, omega_max=mine.omega_max)
    note = f"the wheelbase is that of {place}, {spec.wheelbase:.4g} m; dataset.toml has {mine.wheelbase:.4g} m"
    return replace(log, spec=spec, notes=log.notes if spec.wheelbase == mine.wheelbase else (*log.notes, note))


def check_same_vehicle(
    log: Log, spec: VehicleSpec, place: str, rule: str,
    names: tuple[str, ...] = ("wheel_radius", "track", "wheelbase", "drive"),
) -> None:  # fmt: skip
    """Raise ValueError where a vehicle given beside a log differs in a field of `names`, by `place` and `rule`."""
    for name in names:
        mine, theirs = getattr(log.spec, name), getattr(spec, name)
        if mine != theirs:
            raise ValueError(f"{place}: {name} is {theirs}, but {mine} in {log.name!r}. {rule}; correct dataset.toml "
                             "or leave it out.")


def read_fields(path: Path) -> dict[str, Any]:
    """Checked fields of a dataset.toml."""
    content = read_toml(path, "missing. A dataset needs it to name the vehicle, its geometry and the held-out trials; "
                              "see docs/log_format.md.", "Strings need quotes, decimals a point.")
    content = upgraded("driving-log-dataset", content)
    schema = next(field for field in tables.DATASET if field.name == "schema")
    tables.check(str(path), schema, content.get("schema"))  # before the fields, which follow from it
    return tables.check_table(str(path), tables.DATASET, content)


def _check_seconds(folder: Path, times: dict[str, np.ndarray]) -> None:
    """Refuse times (T,) of files that are as far apart as no recording's are: milliseconds or smaller units."""
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


def _check_way(path: Path, stream: Any, speeds: OdometryStream | Command) -> None:
    """Refuse poses that are as much shorter a way than the speeds give as seconds are longer than a smaller unit."""
    if len(t := stream.t) < LEAST_ROWS or not DOUBTED <= float(np.median(np.diff(t))) <= SLOWEST:
        return
    yaw, few = np.unwrap(stream.yaw), np.linspace(0, len(t) - 1, min(len(t), WAY_POINTS)).astype(int)
    steps, (way, turn) = ((np.hypot(np.diff(stream.x[rows]), np.diff(stream.y[rows])), np.abs(np.diff(yaw[rows])))
                          for rows in (slice(None), few))  # noise adds up in many
    if all(float(np.median(one)) < STANDS for one in steps):
        return  # most of the time the vehicle stood, which explains the short way
    inside = (speeds.t >= t[0]) & (speeds.t <= t[-1])
    held = np.diff(np.append(speeds.t[inside], t[-1]))
    for moved, speed, unit in ((float(way.sum()), speeds.v, "m"), (float(turn.sum()), speeds.omega, "rad")):
        said = float((np.abs(speed[inside]) * held).sum())
        times = said / moved if moved > LEAST_WAY else 0.0
        for name, size in TIME_UNITS:
            if size / UNLIKE < times < size * UNLIKE:
                raise ValueError(f"{path}: the speeds give {said:.3g} {unit} in {np.ptp(t):.5g} s, the "
                                 f"poses {moved:.3g} {unit}: t seems to be in {name}. Divide t by {size:.0f} in all "
                                 "streams.")


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
    if odometry is None and command.t[0] > 0 or max(abs(at_start[0]), abs(at_start[1])) < 1e-6:
        return 0.0, 0.0
    speeds = at_start
    if odometry is not None:  # a single noisy row is no motion
        until = max(int((odometry.t <= command.t[0]).sum()), 1)
        speeds = float(np.median(odometry.v[:until])), float(np.median(odometry.omega[:until]))
    return speeds if max(abs(speeds[0]), abs(speeds[1])) > START_NOISE else (0.0, 0.0)


def _at_rest(pose: PoseStream, still: float) -> tuple[tuple[float, float, float], float, float]:
    """Mean pose until the vehicle moves [s], at least of the first sample, and standard errors of x and y, and of yaw;
    0 of a single sample."""
    rows = pose.values[: max(int((pose.t <= still).sum()), 1)]
    x, y, yaw = (float(one.mean()) for one in rows.T)
    if len(rows) < 2:
        return (x, y, yaw), 0.0, 0.0
    along_x, along_y, turn = (one.var(ddof=1) for one in rows.T)
    return (x, y, yaw), float(np.sqrt((along_x + along_y) / 2 / len(rows))), float(np.sqrt(turn / len(rows)))
