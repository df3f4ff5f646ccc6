"""Recordings to driving-log datasets: drives are cut out of bags and written as trials."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from sysid.logs import lerobot
from sysid.logs.coverage import sanity
from sysid.logs.log import load_log, load_trial, read_fields, spec_from_fields
from sysid.logs.measured import is_known
from sysid.logs.metrics import relative_pose
from sysid.logs.records import Log, PoseStream, Start, Trial
from sysid.logs.rosbag import PACKED, Bag, clock_notes, find_bags, in_order, read_bag, stream_times
from sysid.logs.sources import is_lerobot
from sysid.logs.text_files import TextDrive, join_drives, read_drives, text_files
from sysid.logs.wheel_states import integrate_speeds
from whill_mjx.io.command_line import WRITING, Range, With
from whill_mjx.io.fields import COLUMNS, counted
from whill_mjx.io.folders import unfinished
from whill_mjx.logs.dataset import COMMAND_HEADER, IMU_HEADER, ODOMETRY_HEADER, POSE_HEADER, write_csv, write_fields
from whill_mjx.vehicle.specs import SPECS, VehicleSpec, find_spec

HEADERS = {"command": COMMAND_HEADER, "odometry": ODOMETRY_HEADER, "ground_truth": POSE_HEADER, "imu": IMU_HEADER}
STILL = 1e-3  # m/s, rad/s of commands that a vehicle does not follow
MOVING = {"v": 0.02, "omega": 0.03}  # m/s, rad/s of the odometry above which the vehicle counts as moving
LEAD = 2.0  # s of standstill kept before and after a drive
SHORTEST = 1.0  # s of motion below which a drive is left out


@dataclass(frozen=True)
class ConvertConfig:
    """Options of the command."""

    source: Path
    """ROS bag, CSV or TUM file, folder of one of them, LeRobotDataset, or a measured set."""
    out: Path = Path("runs/dataset")
    """Dataset folder; made where it does not exist, else the trials are added."""
    to: Literal["dataset", "lerobot"] = "dataset"
    """What is written: a driving-log dataset, or a LeRobotDataset v3 of a driving-log dataset."""
    fps: Annotated[int | None, Range(1, 1000), With("to", ("lerobot",))] = None
    """Frames per second of a LeRobotDataset that is written; by default the rate of the measurements."""
    vehicle: str = "whill_cr"
    """Built-in vehicle whose nominal geometry is noted; measured sets know their own."""
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


OF_RECORDINGS = ("vehicle", "wheel_radius", "track", "mass", "command_topic", "odometry_topic", "truth_topic",
                 "imu_topic", "input", "stamp", "split")  # options that are for bags and tables


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


def convert(config: ConvertConfig) -> tuple[Log, list[str]]:
    """Write the dataset and load it again: the log that a fit will see, and notes on what was chosen and left out."""
    if not config.source.is_dir() and not config.source.is_file():
        what = "a pipe or a device" if config.source.exists() else "does not exist"
        raise FileNotFoundError(f"{config.source}: {what}. Give a ROS bag, a CSV file, a folder of them, or a measured "
                                "set.")
    if config.out.exists() and config.out.samefile(config.source):
        raise ValueError(f"--out {config.out}: exists already, and is the source. Choose another --out.")
    bags = find_bags(config.source)
    notes: list[str] = []
    more: dict[str, Any] = {} if config.command_timeout is None else {"command_timeout": config.command_timeout}
    held_out = config.held_out
    if is_lerobot(config.source) or not bags and not is_known(config.source) and text_files(config.source):
        spec, drives, notes, fields, held = _table_drives(config)
        more |= fields
        held_out = held_out or (() if (config.out / "dataset.toml").exists() else held)
    elif bags:
        spec = _spec(config)
        drives, notes, wheels = _any_drives(bags, config, spec)
        notes += _tables_beside(config.source)
        if wheels:
            more["input"] = "wheels"
    else:
        spec, drives, notes = _known_drives(config)
    if not drives:
        raise ValueError(f"{config.source}: no drive in it moves for {SHORTEST:g} s. Check --command-topic, or use "
                         "--split bag.")
    unknown = sorted(set(held_out) - {drive.name for drive in drives})
    if unknown:
        raise ValueError(f"--held-out {unknown[0]}: no such trial was made (made: "
                         f"{', '.join(drive.name for drive in drives[:20])}). Correct the name.")
    notes += write_dataset(config.out, spec, drives, held_out, more, config.source)
    log = load_log(config.out)
    made = log.select(lambda trial: trial.name in {drive.name for drive in drives})
    again = any("Convert again" in note for note in notes)  # what is odd is of the times that were taken
    return log, notes if again else [*notes, *(f"! {one}" for one in sanity(made))]


def _known_drives(config: ConvertConfig) -> tuple[VehicleSpec, list[Drive], list[str]]:
    """The vehicle and the trials of a dataset or a measured set, and notes."""
    from sysid.logs.inspection import load_whole

    if config.columns:
        raise ValueError(f"--columns: only tables have columns to name; {config.source} is none. Leave it out.")
    if given := [name for name in OF_RECORDINGS if getattr(config, name) != getattr(ConvertConfig, name)]:
        raise ValueError(f"--{given[0].replace('_', '-')}: {config.source} is a dataset, which says this itself. "
                         "Leave it out.")
    log = load_whole(config.source, config.select)
    drives = [trial_drive(trial) for trial in log.trials]
    drives = [one if one.ground_truth is None else replace(one, ground_truth=_at_axle(one.ground_truth, config))
              for one in drives]
    notes = list(log.notes)
    if any(trial.odometry is not None and trial.odometry.x is None for trial in log.trials):
        notes.append("the pose of the odometry was not logged: it is dead reckoned from the wheel speeds")
    return log.spec, drives, notes


def _tables_beside(source: Path) -> list[str]:
    """A note on tables in a folder of bags, which are not read."""
    loose = [one for drive in text_files(source) for one in drive if one.suffix.lower() != ".txt"]
    return [f"left out: {counted(len(loose), 'table')} beside the bags ({loose[0]}). Convert tables by themselves"
            ] if loose else []


def _any_drives(
    bags: Sequence[Path], config: ConvertConfig, spec: VehicleSpec
) -> tuple[list[Drive], list[str], bool]:
    """Trials of several bags, notes, and whether their input is measured wheel speeds: where no bag has commands."""
    wheels = config.input == "wheels"
    drives, notes, refused = _bags_drives(bags, config, spec, wheels)
    if not drives and config.input == "auto" and all("no command topic found" in str(error) for error in refused):
        drives, more, _ = _bags_drives(bags, config, spec, True)
        wheels, notes = bool(drives), more if drives else notes
    if not drives and refused:
        raise refused[0]
    return drives, notes, wheels


def _bags_drives(
    bags: Sequence[Path], config: ConvertConfig, spec: VehicleSpec, wheels: bool
) -> tuple[list[Drive], list[str], list[ValueError]]:
    """Trials of several bags, notes, and why some are left out."""
    drives: list[Drive] = []
    notes: list[str] = []
    refused: list[ValueError] = []
    for path in bags:
        try:
            cut_out, said = bag_drives(path, config, spec, wheels)
        except ValueError as error:
            refused.append(error)
            notes.append(f"left out: {error}")
            continue
        drives += cut_out
        notes += [f"{path.name}: {note}" for note in said]
    return drives, notes, refused


def _table_drives(
    config: ConvertConfig,
) -> tuple[VehicleSpec, list[Drive], list[str], dict[str, Any], tuple[str, ...]]:
    """Nominal geometry, trials, notes, fields of dataset.toml and held-out trials of tables or of a LeRobotDataset."""
    said, wheels = config.columns, config.input == "wheels"
    if not is_lerobot(config.source):
        spec = _spec(config)
        found, left = read_drives(config.source, said, (spec.wheel_radius, spec.track), wheels)
        drives, notes, fields = _text_drives(found, config)
        return spec, drives, [*left, *notes], fields, ()
    episodes = lerobot.read(config.source)
    spec = _spec(config, episodes.spec)
    found, left = join_drives(config.source, [(name, [table]) for name, table in episodes.drives], said,
                              (spec.wheel_radius, spec.track), wheels)
    drives, notes, fields = _text_drives(found, config)
    return spec, drives, [*episodes.notes, *left, *notes], fields, episodes.held_out


def _text_drives(
    found: Sequence[TextDrive], config: ConvertConfig
) -> tuple[list[Drive], list[str], dict[str, Any]]:
    """Trials of drives out of columns, notes, and what dataset.toml says of them."""
    drives: list[Drive] = []
    notes: list[str] = []
    inputs = {one.measured_input for one in found}
    if len(inputs) > 1:
        raise ValueError(f"{config.source}: {found[0].name} and others differ in whether they have commands. Convert "
                         "those without into a dataset of their own.")
    decided = list(dict.fromkeys(str(column) for one in found for column in one.columns))
    for one in found:
        source = Source(config.source, {column.role.partition(".")[0]: column.file for column in one.columns})
        cut_out, said = cut_drives(re.sub(r"[^\w.-]+", "_", one.name), one.tables, source, config)
        drives += cut_out
        notes += [f"{one.name}: {note}" for note in (*one.notes, *said)]
    notes += [f"column {one}{f' ({one.why})' if one.why else ''}" for one in found[0].columns]
    more: dict[str, Any] = {"columns": decided}
    if inputs == {True}:
        more["input"] = "wheels"
    return drives, notes, more


def bag_drives(
    path: Path, config: ConvertConfig, spec: VehicleSpec, wheels: bool = False
) -> tuple[list[Drive], list[str]]:
    """Trials of one bag, and notes; `spec` has the geometry of wheels whose angles or rates were recorded."""
    asked = {"command": config.command_topic, "odometry": config.odometry_topic, "ground_truth": config.truth_topic,
             "imu": config.imu_topic}
    topics = {name: topic for name, topic in asked.items() if topic is not None}
    bag = in_order(read_bag(path, topics, (spec.wheel_radius, spec.track), wheels), config.stamp)
    imu = replace(bag, streams={name: stream for name, stream in bag.streams.items() if name == "imu"})
    bag = replace(bag, streams={name: stream for name, stream in bag.streams.items() if name != "imu"})
    said = clock_notes(bag, config.stamp)
    times = stream_times(bag, config.stamp)
    try:
        more = stream_times(imu, config.stamp), clock_notes(imu, config.stamp)
        _check_rates(imu)
        times, said, bag = {**times, **more[0]}, [*said, *more[1]], replace(bag, streams={**bag.streams, **imu.streams})
    except ValueError as error:  # nothing else depends on it
        if config.imu_topic is not None:
            raise
        said = [*said, f"the gyro is left out: {error}"]
    notes = [*bag.notes, *(f"{name} from {stream.topic} ({stream.kind}), {len(stream.received)} messages"
                           for name, stream in bag.streams.items()), *said]
    if config.stamp == "header" and not np.isfinite(bag.streams["command"].stamped).all():
        notes.append("commands have no header: their time is that of receipt, the other streams' that of their header")
    tables = {}
    for name, t in times.items():
        keep, dropped = _increasing(t)
        if dropped:
            notes.append(f"{name}: {dropped} messages out of order or with an equal stamp are left out")
        tables[name] = np.column_stack([t[keep], bag.streams[name].values[keep]])
    stem = re.sub(r"[^\w.-]+", "_", _recording_name(path))
    source = Source(path, {name: stream.topic for name, stream in bag.streams.items()})
    drives, said = cut_drives(stem, tables, source, config)
    return drives, [*notes, *said]


def _check_rates(bag: Bag) -> None:
    """Raise ValueError where a gyro turns faster than any vehicle."""
    for stream in bag.streams.values():
        most, field = float(np.abs(stream.values).max()), COLUMNS["gyro"]
        if most > field.high:
            raise ValueError(f"{bag.path}: topic {stream.topic} turns at up to {most:.3g} rad/s; it must be below "
                             f"{field.high:g}. {field.remedy}")


def cut_drives(
    stem: str, tables: dict[str, np.ndarray], source: Source, config: ConvertConfig
) -> tuple[list[Drive], list[str]]:
    """The trials of one recording, whole or cut at standstill, and notes."""
    if "ground_truth" in tables:
        tables["ground_truth"] = _at_axle(tables["ground_truth"], config)
    notes = []
    if config.split == "bag":
        ends = [(table[0, 0], table[-1, 0]) for name, table in tables.items() if name not in ("command", "imu")]
        spans = [(max(begin for begin, _ in ends), min(end for _, end in ends))]
    else:
        spans = drive_spans(tables, config.pause)
        notes.append(f"{len(spans)} drives between standstills of {config.pause:g} s")
    drives = []
    for number, span in enumerate(spans, start=1):
        name = stem if len(spans) == 1 else f"{stem}-{number:02d}"
        drives.append(cut(name, tables, span, source))
    return drives, notes


def _recording_name(path: Path) -> str:
    """Name of a recording: of its folder, also where the recorder was killed and left only the file FOLDER_0 in it."""
    if not path.is_file():
        return path.name
    stem = Path(path.stem).stem if path.suffix in PACKED else path.stem
    alone = stem == f"{path.absolute().parent.name}_0" and len(find_bags(path.parent)) == 1
    return path.absolute().parent.name if alone else stem


def cut(
    name: str, tables: dict[str, np.ndarray], span: tuple[float, float], source: Source
) -> Drive:
    """The part of a recording between two times [s] as a trial that counts from its start, with the command then in
    force.

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
        found["odometry"][:, 1:4] = relative_pose(pose, Start(*found["odometry"][0, 1:4]))
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
    measured = [table for name, table in tables.items() if name not in ("command", "imu")]
    first, last = max(table[0, 0] for table in measured), min(table[-1, 0] for table in measured)
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
    command = tables["command"]
    held = np.searchsorted(command[:, 0], t, side="right") - 1
    commanded = np.where(held[:, None] >= 0, command[np.maximum(held, 0), 1:], 0.0)
    moving = (np.abs(commanded[:, 0]) > STILL) | (np.abs(commanded[:, 1]) > STILL)
    if "odometry" in tables:
        v, omega = (np.interp(t, tables["odometry"][:, 0], tables["odometry"][:, k]) for k in (4, 5))
        moving |= (np.abs(v) > MOVING["v"]) | (np.abs(omega) > MOVING["omega"])
    return t, moving


def trial_drive(trial: Trial) -> Drive:
    """A trial in memory as tables; a window that starts in motion keeps its start pose as its first pose."""
    odometry = pose = None
    if trial.odometry is not None:
        source = trial.odometry
        x, y, yaw = (source.x, source.y, source.yaw)
        if x is None or y is None or yaw is None:
            x, y, yaw = integrate_speeds(source.t, source.v, source.omega)
        odometry = np.column_stack([source.t, x, y, yaw, source.v, source.omega])
    if trial.ground_truth is not None:
        truth = trial.ground_truth
        pose = np.column_stack([truth.t, truth.x, truth.y, truth.yaw])
        if pose[0, 0] > 1e-6:
            pose = np.vstack([[0.0, trial.start.x, trial.start.y, trial.start.yaw], pose])
        pose[:, 3] = np.angle(np.exp(1j * pose[:, 3]))
    imu = None
    if trial.gyro is not None and len(trial.gyro.t) > 1:
        imu = np.column_stack([trial.gyro.t, np.gradient(trial.gyro.turn, trial.gyro.t)])
    return Drive(re.sub(r"[^\w.-]+", "-", trial.name), trial.command.table, odometry, pose, imu)


def _at_axle(truth: np.ndarray, config: ConvertConfig) -> np.ndarray:
    """Rows (T, 4) of an outside pose at the drive-axle centre and along the vehicle."""
    t, x, y, yaw = truth.T
    yaw = yaw - np.deg2rad(config.truth_turned)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x = x - config.truth_ahead * cos + config.truth_left * sin
    y = y - config.truth_ahead * sin - config.truth_left * cos
    return np.column_stack([t, x, y, np.angle(np.exp(1j * yaw))])


def write_dataset(
    folder: Path, spec: VehicleSpec, drives: Sequence[Drive], held_out: Sequence[str] = (),
    more: Mapping[str, Any] | None = None, source: Path | None = None,
) -> list[str]:
    """Write the trials that the loader accepts into a dataset folder, and note those left out; an existing dataset
    keeps its fields and trials. `more`: further fields of a new dataset.toml; `source`: named in errors.

    ValueError, and nothing is written, where a trial exists with other contents, names repeat, or none is accepted.
    """
    names = [drive.name for drive in drives]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{folder}: two trials would be named {twice[0]!r}. Rename one of the bags.")
    known = (folder / "dataset.toml").exists()
    if known and held_out and set(held_out) != set(read_fields(folder / "dataset.toml").get("held_out", ())):
        raise ValueError(f"{folder / 'dataset.toml'}: exists already, so --held-out cannot be noted. Add the "
                         "trials to its held_out by hand.")
    if known and any((folder / "trials").glob("*")):
        log = load_log(folder)  # trials are not added to what cannot be loaded
        if log.fields.get("input", "commands") != (more or {}).get("input", "commands"):
            raise ValueError(f"{folder}: its input is {log.fields.get('input', 'commands')}, and that of the new "
                             "trials is another. Choose another --out.")
    made, partial = not folder.exists(), unfinished(folder)
    try:
        accepted, refused = _write_accepted(partial, drives)
        notes = [f"left out: {str(error).replace(str(partial), str(folder))}" for error in refused.values()]
        missing = sorted(set(held_out) & set(refused))
        if not accepted or missing:
            reason = notes[0] if not missing else f"{missing[0]} is held out, but it is {notes[0]}"
            came = f"{source}: made into a trial, " if source else ""
            raise ValueError(f"{came}{reason.removeprefix('left out: ')} Nothing was written.")
        if not known:
            write_fields(partial, spec, held_out, more)
            spec_from_fields(folder / "dataset.toml", read_fields(partial / "dataset.toml"))
        for name in refused:
            shutil.rmtree(partial / "trials" / name)
        there = [name for name in accepted if (folder / "trials" / name).exists()]
        for name in there:
            if _contents(folder / "trials" / name) != _contents(partial / "trials" / name):
                raise ValueError(f"{folder / 'trials' / name}: exists already, with other contents; a conversion never "
                                 "replaces a trial. Choose another --out, or remove the trial.")
        notes += [f"{name} is there already, with the same contents" for name in there]
        _place(partial, folder, [name for name in accepted if name not in there])
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):
            if made and not any(folder.iterdir()):
                folder.rmdir()
    return notes


def _place(partial: Path, folder: Path, trials: Sequence[str]) -> None:
    """Move what was written to its place, in one step where the dataset is new."""
    with WRITING:
        if (partial / "dataset.toml").exists():
            os.replace(partial / "dataset.toml", folder / "dataset.toml")
        if not (folder / "trials").exists():
            os.replace(partial / "trials", folder / "trials")
        else:
            for name in trials:
                os.replace(partial / "trials" / name, folder / "trials" / name)


def _contents(trial: Path) -> dict[str, bytes]:
    """Content of each stream of a trial."""
    return {stream: path.read_bytes() for stream in HEADERS if (path := trial / f"{stream}.csv").exists()}


def _write_accepted(folder: Path, drives: Sequence[Drive]) -> tuple[list[str], dict[str, ValueError]]:
    """Write trials; returns the names of those that load again, and what is said of the others."""
    accepted, refused = [], {}
    for drive in drives:
        for stream in HEADERS:
            table = getattr(drive, stream)
            if table is not None:
                write_csv(folder / "trials" / drive.name / f"{stream}.csv", HEADERS[stream], table)
        try:
            load_trial(folder / "trials" / drive.name)
            accepted.append(drive.name)
        except ValueError as error:
            refused[drive.name] = error
    return accepted, refused


def _spec(config: ConvertConfig, noted: VehicleSpec | None = None) -> VehicleSpec:
    """Nominal geometry: as the options say, else as the source notes it."""
    changes = {key: value for key in ("wheel_radius", "track", "mass")
               if (value := getattr(config, key)) is not None}
    if noted is not None and config.vehicle == ConvertConfig.vehicle:
        return replace(noted, **changes)
    if config.vehicle in SPECS:
        return replace(find_spec(config.vehicle), **changes)
    missing = [key for key in ("wheel_radius", "track") if key not in changes]
    if missing:
        raise ValueError(f"--vehicle {config.vehicle}: not built in (known: {', '.join(SPECS)}), and no "
                         f"--{missing[0].replace('_', '-')}. Give --wheel-radius and --track as measured.")
    return replace(find_spec("whill_cr"), name=config.vehicle, **changes)


def _increasing(t: np.ndarray) -> tuple[np.ndarray, int]:
    """Indices of the times that are later than all before, by a microsecond at least, and how many are not."""
    keep, latest = [], -np.inf
    for i, value in enumerate(t):
        if value >= latest + 1e-6:
            keep.append(i)
            latest = value
    return np.array(keep, int), len(t) - len(keep)


def _origin(tables: dict[str, np.ndarray]) -> float:
    return min(float(table[0, 0]) for table in tables.values())
