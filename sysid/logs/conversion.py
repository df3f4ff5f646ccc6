"""Recordings to driving-log datasets: the drives of bags, tables and measured sets, written as trials."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs import lerobot
from sysid.logs.bags.clocks import clock_notes, in_order, stream_times
from sysid.logs.bags.reader import read_bag
from sysid.logs.bags.recording import PACKED, Bag, find_bags
from sysid.logs.conversion_options import ConvertConfig
from sysid.logs.coverage import sanity
from sysid.logs.dataset_writing import write_dataset
from sysid.logs.drive_cuts import SHORTEST, Drive, Source, at_axle, cut_drives, trial_drive
from sysid.logs.log import load_log
from sysid.logs.measured import is_known, load_whole
from sysid.logs.records import Log
from sysid.logs.sources import is_lerobot
from sysid.logs.tables.drives import TextDrive, join_drives, read_drives
from sysid.logs.tables.text_table import text_files
from whill_mjx.io.fields import COLUMNS, counted
from whill_mjx.vehicle.specs import SPECS, VehicleSpec, find_spec

OF_RECORDINGS = ("vehicle", "wheel_radius", "track", "mass", "command_topic", "odometry_topic", "truth_topic",
                 "imu_topic", "input", "stamp", "split")  # options that are for bags and tables


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
    if config.columns:
        raise ValueError(f"--columns: only tables have columns to name; {config.source} is none. Leave it out.")
    if given := [name for name in OF_RECORDINGS if getattr(config, name) != getattr(ConvertConfig, name)]:
        raise ValueError(f"--{given[0].replace('_', '-')}: {config.source} is a dataset, which says this itself. "
                         "Leave it out.")
    log = load_whole(config.source, config.select)
    drives = [trial_drive(trial) for trial in log.trials]
    drives = [one if one.ground_truth is None else replace(one, ground_truth=at_axle(one.ground_truth, config))
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


def _recording_name(path: Path) -> str:
    """Name of a recording: of its folder, also where the recorder was killed and left only the file FOLDER_0 in it."""
    if not path.is_file():
        return path.name
    stem = Path(path.stem).stem if path.suffix in PACKED else path.stem
    alone = stem == f"{path.absolute().parent.name}_0" and len(find_bags(path.parent)) == 1
    return path.absolute().parent.name if alone else stem


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
