"""Recordings to driving-log datasets: the drives of bags, tables and measured sets, written as trials."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.logs import lerobot
from sysid.logs.bags.clocks import clock_notes, in_order, stream_times
from sysid.logs.bags.reader import read_bag
from sysid.logs.bags.recording import OPTIONS, PACKED, find_bags
from sysid.logs.coverage import sanity
from sysid.logs.dataset_writing import HEADERS, Found, copies, write_dataset
from sysid.logs.drive_cuts import SHORTEST, ConvertConfig, Drive, Source, at_axle, cut_drives, trial_drive
from sysid.logs.loaders import detect_format, is_known, load_whole
from sysid.logs.log import load_log, read_csv, read_fields, spec_from_fields
from sysid.logs.records import Log, name_of, spaced
from sysid.logs.sources import is_lerobot
from sysid.logs.tables.drives import TextDrive, join_drives, read_drives
from sysid.logs.tables.text_table import text_files
from whill_mjx.io.fields import COLUMNS, counted
from whill_mjx.vehicle.specs import SPECS, WHILL_CR, VehicleSpec, find_spec, in_proportion

OF_RECORDINGS = ("vehicle", "wheel_radius", "track", "mass", "command_topic", "odometry_topic", "truth_topic",
                 "imu_topic", "input", "stamp", "split")  # options that are for bags and tables
OF_VEHICLE = ("schema", "vehicle", "drive", "driven_axle", "wheel_radius", "track", "wheelbase", "mass",
              "command_limits", "held_out")  # fields of dataset.toml that follow from a vehicle and its trials


def convert(config: ConvertConfig) -> tuple[Log, list[str]]:
    """Write the dataset and load it again: the log that a fit will see, and notes on what was chosen and left out."""
    if not config.source.is_dir() and not config.source.is_file():
        what = "a pipe or a device" if config.source.exists() else "does not exist"
        raise FileNotFoundError(f"{config.source}: {what}. Give a ROS bag, a CSV file, a folder of them, or a measured "
                                "set.")
    if config.out.exists() and config.out.samefile(config.source):
        raise ValueError(f"--out {config.out}: exists already, and is the source. Choose another --out.")
    there = _vehicle_there(config)
    bags = find_bags(config.source)
    if is_lerobot(config.source) or not bags and not is_known(config.source) and text_files(config.source):
        found = _of_tables(config, there)
    elif bags:
        found = _of_bags(bags, config, there)
    else:
        found = _of_known(config)
    drives = found.drives
    if not drives:
        raise ValueError(f"{config.source}: no drive in it moves for {SHORTEST:g} s. Check --command-topic, or use "
                         "--split bag.")
    names = {drive.name for drive in drives}
    unknown = sorted(set(config.held_out) - names)
    if unknown:
        raise ValueError(f"--held-out {unknown[0]}: no such trial was made (made: "
                         f"{', '.join(drive.name for drive in drives[:20])}). Correct the name.")
    if config.command_timeout is not None:
        found = replace(found, more={**found.more, "command_timeout": config.command_timeout})
    kept_out = [name for name in found.held_out if name in names]
    held_out = config.held_out or (kept_out if there is None else ())
    notes = [*found.notes, *copies(drives), *write_dataset(config.out, found, held_out, config.source)]
    log = load_log(config.out)
    if there is not None and (fitted := sorted(set(kept_out) - {trial.name for trial in log.held_out})):
        notes.append(f"{', '.join(fitted)}: held out in {config.source}, but not here. Add "
                     f"{'it' if len(fitted) == 1 else 'them'} to held_out of {config.out / 'dataset.toml'}")
    made = log.select(lambda trial: trial.name in names)
    again = any("Convert again" in note for note in notes)  # what is odd is of the times that were taken
    return log, notes if again else [*notes, *(f"! {one}" for one in sanity(made))]


def _vehicle_there(config: ConvertConfig) -> VehicleSpec | None:
    """The vehicle of a dataset that trials are added to; None where --out is new.

    ValueError where an option says something else: its dataset.toml stays as it is.
    """
    path = config.out / "dataset.toml"
    if not path.exists():
        return None
    fields = read_fields(path)
    spec, _ = spec_from_fields(path, fields)
    has = {"vehicle": spec.name, "wheel_radius": spec.wheel_radius, "track": spec.track, "mass": spec.mass,
           "command_timeout": fields.get("command_timeout", "not stated")}
    for key, mine in has.items():
        asked = getattr(config, key)
        if asked in (getattr(ConvertConfig, key), mine):
            continue
        flag = f"--{key.replace('_', '-')}"
        uses_none = key in ("mass", "command_timeout")  # nothing that is there was computed with it
        correct = f" write {key} = {asked:g} there," if uses_none else ""
        raise ValueError(f"{path}: {key} is {mine}, and {flag} {asked} differs. Leave {flag} out,{correct} or choose "
                         "another --out.")
    return spec


def _of_known(config: ConvertConfig) -> Found:
    """What a dataset or a measured set holds."""
    if config.columns:
        raise ValueError(f"--columns: only tables have columns to name; {config.source} is none. Leave it out.")
    kind = detect_format(config.source)
    if given := [name for name in OF_RECORDINGS if getattr(config, name) != getattr(ConvertConfig, name)]:
        raise ValueError(f"--{given[0].replace('_', '-')}: {config.source} is a dataset, which says this itself. "
                         "Leave it out.")
    log = load_whole(config.source, config.select)
    names, notes = [trial.name for trial in log.trials], list(log.notes)
    of_dataset = kind == "dataset"
    folders = {name: config.source / "trials" / name for name in names} if of_dataset else {}
    drives = [_written(one) for one in folders.values()] or [trial_drive(trial) for trial in log.trials]
    drives = [one if one.ground_truth is None else replace(one, ground_truth=at_axle(one.ground_truth, config))
              for one in drives]
    if any(trial.odometry is not None and trial.odometry.x is None for trial in log.trials):
        notes.append("the pose of the odometry was not logged: it is dead reckoned from the wheel speeds")
    if not of_dataset:
        return Found(log.spec, drives, notes)
    held = [name for name in log.fields.get("held_out", ()) if name in names]
    more = {key: value for key, value in log.fields.items() if key not in OF_VEHICLE}
    return Found(log.spec, drives, notes, held, more, log.fields, folders)


def _written(folder: Path) -> Drive:
    """A trial of a dataset as it was written, without what its loader makes of a time-out, wheel speeds or a gyro."""
    tables: dict[str, Any] = {"odometry": None, "ground_truth": None}
    for stream, header in HEADERS.items():
        if (path := folder / f"{stream}.csv").exists():
            columns = read_csv(path, tuple(header.split(",")))
            tables[stream] = np.column_stack([columns[name] for name in header.split(",")])
    return Drive(folder.name, **tables)


def _of_bags(bags: Sequence[Path], config: ConvertConfig, there: VehicleSpec | None) -> Found:
    """What several bags hold; their input is measured wheel speeds where no bag has commands."""
    wheels, spec = config.input == "wheels", _spec(config, there)
    drives, notes, refused = _bags_drives(bags, config, spec, wheels)
    if not drives and config.input == "auto" and all("no command topic found" in str(error) for error in refused):
        drives, said, _ = _bags_drives(bags, config, spec, True)
        wheels, notes = bool(drives), said if drives else notes
    if not drives and refused:
        raise refused[0]
    if loose := [one for drive in text_files(config.source) for one in drive if one.suffix.lower() != ".txt"]:
        notes.append(f"left out: {counted(len(loose), 'table')} beside the bags ({loose[0]}). Convert tables by "
                     "themselves")
    return Found(spec, drives, notes, more={"input": "wheels"} if wheels else {}, stated=_stated(config))


def _bags_drives(
    bags: Sequence[Path], config: ConvertConfig, spec: VehicleSpec, wheels: bool
) -> tuple[list[Drive], list[str], list[ValueError]]:
    """Trials of several bags, notes, and why some are left out."""
    drives, notes, refused = list[Drive](), list[str](), list[ValueError]()
    for path in bags:
        try:
            cut_out, said = bag_drives(path, config, spec, wheels)
            drives += cut_out
            notes += [f"{path.name}: {note}" for note in said]
        except ValueError as error:
            refused.append(error)
            notes.append(f"left out: {error}")
    return drives, notes, refused


def _of_tables(config: ConvertConfig, there: VehicleSpec | None) -> Found:
    """What tables or a LeRobotDataset hold."""
    if config.stamp != ConvertConfig.stamp:
        raise ValueError(f"--stamp {config.stamp}: rows of tables have one time each. Leave it out.")
    episodes = lerobot.read(config.source) if is_lerobot(config.source) else lerobot.Episodes()
    noted = episodes.spec if config.vehicle == ConvertConfig.vehicle else None
    spec = _spec(config, there, noted)
    how = config.columns, (spec.wheel_radius, spec.track), config.input == "wheels"
    groups = [(name, [table]) for name, table in episodes.drives]
    found, left = join_drives(config.source, groups, *how) if groups else read_drives(config.source, *how)
    drives, notes, fields = _text_drives(found, config)
    return Found(spec, drives, [*episodes.notes, *left, *notes], episodes.held_out, fields,
                 _stated(config) if noted is None else None)


def _text_drives(
    found: Sequence[TextDrive], config: ConvertConfig
) -> tuple[list[Drive], list[str], dict[str, Any]]:
    """Trials of drives out of columns, notes, and what dataset.toml says of them."""
    drives, notes = list[Drive](), list[str]()
    inputs = {one.measured_input for one in found}
    if len(inputs) > 1:
        raise ValueError(f"{config.source}: {found[0].name} and others differ in whether they have commands. Convert "
                         "those without into a dataset of their own.")
    for one in found:
        source = Source(config.source, {column.role.partition(".")[0]: column.file for column in one.columns})
        name = re.sub(r"[^\w.-]+", "_", one.name).lstrip(".") or "drive"  # hidden folders are no trials
        cut_out, said = cut_drives(name, one.tables, source, config)
        drives += cut_out
        notes += [f"{one.name}: {note}" for note in (*one.notes, *said)]
    notes += [f"column {one}{f' ({one.why})' if one.why else ''}" for one in found[0].columns]
    decided = list(dict.fromkeys(str(column) for one in found for column in one.columns))
    return drives, notes, {"columns": decided, **({"input": "wheels"} if inputs == {True} else {})}


def bag_drives(
    path: Path, config: ConvertConfig, spec: VehicleSpec, wheels: bool = False
) -> tuple[list[Drive], list[str]]:
    """Trials of one bag, and notes; `spec` has the geometry of wheels whose angles or rates were recorded."""
    topics = {name: topic for name, option in OPTIONS.items()
              if (topic := getattr(config, option[2:].replace("-", "_"))) is not None}
    bag = in_order(read_bag(path, topics, (spec.wheel_radius, spec.track), wheels, config.stamp), config.stamp)
    imu = replace(bag, streams={name: stream for name, stream in bag.streams.items() if name == "imu"})
    bag = replace(bag, streams={name: stream for name, stream in bag.streams.items() if name != "imu"})
    said = clock_notes(bag, config.stamp)
    times = stream_times(bag, config.stamp)
    try:
        times_of_imu, said_of_imu = stream_times(imu, config.stamp), clock_notes(imu, config.stamp)
        for stream in imu.streams.values():
            if (most := float(np.abs(stream.values).max())) > (field := COLUMNS["gyro"]).high:
                raise ValueError(f"{path}: topic {stream.topic} turns at up to {most:.3g} rad/s; it must be below "
                                 f"{field.high:g}. {field.remedy}")
        times, said, bag = times | times_of_imu, said + said_of_imu, replace(bag, streams=bag.streams | imu.streams)
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
        keep = spaced(t, 1e-6)
        if dropped := len(t) - len(keep):
            notes.append(f"{name}: {dropped} messages out of order or with an equal stamp are left out")
        tables[name] = np.column_stack([t[keep], bag.streams[name].values[keep]])
    stem = re.sub(r"[^\w.-]+", "_", _recording_name(path))
    source = Source(path, {name: stream.topic for name, stream in bag.streams.items()})
    drives, said = cut_drives(stem, tables, source, config)
    return drives, [*notes, *said]


def _recording_name(path: Path) -> str:
    """Name of a recording: of its folder, also where the recorder was killed and left only the file FOLDER_0 in it."""
    if not path.is_file():
        return name_of(path)
    stem = Path(path.stem).stem if path.suffix in PACKED else path.stem
    alone = stem == f"{name_of(path.parent)}_0" and len(find_bags(path.parent)) == 1
    return name_of(path.parent) if alone else stem


def _spec(config: ConvertConfig, there: VehicleSpec | None, noted: VehicleSpec | None = None) -> VehicleSpec:
    """Nominal geometry: as the source notes it, else of the dataset that trials are added to, else as options say."""
    changes = _given(config)
    if noted is not None:
        return replace(noted, **changes)
    if there is not None:
        return there
    if config.vehicle in SPECS:
        return replace(find_spec(config.vehicle), **changes)
    missing = [key for key in ("wheel_radius", "track") if key not in changes]
    if missing:
        raise ValueError(f"--vehicle {config.vehicle}: not built in (known: {', '.join(SPECS)}), and no "
                         f"--{missing[0].replace('_', '-')}. Give --wheel-radius and --track as measured.")
    return in_proportion(WHILL_CR, config.vehicle, **changes)


def _given(config: ConvertConfig) -> dict[str, Any]:
    """Sizes that options state."""
    return {key: value for key in ("wheel_radius", "track", "mass") if (value := getattr(config, key)) is not None}


def _stated(config: ConvertConfig) -> Container[str] | None:
    """Fields of the vehicle that are known; None where it is built in, so that all are."""
    return None if config.vehicle in SPECS else _given(config)
