"""Trials written into a dataset folder: those that the loader accepts, at once, and never over others."""

from __future__ import annotations

import os
import shutil
from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sysid.logs.drive_cuts import Drive
from sysid.logs.log import load_log, load_trial, read_fields, spec_from_fields
from whill_mjx.io.command_line import WRITING
from whill_mjx.io.folders import unfinished
from whill_mjx.logs.dataset import COMMAND_HEADER, IMU_HEADER, ODOMETRY_HEADER, POSE_HEADER, write_csv, write_fields
from whill_mjx.vehicle.specs import VehicleSpec

HEADERS = {"command": COMMAND_HEADER, "odometry": ODOMETRY_HEADER, "ground_truth": POSE_HEADER, "imu": IMU_HEADER}
ENCODER = "encoder.csv"


@dataclass(frozen=True)
class Found:
    """What a source holds: the trials to be written, and what dataset.toml says of them."""

    spec: VehicleSpec
    drives: Sequence[Drive]
    notes: Sequence[str] = ()
    held_out: Sequence[str] = ()  # by the source itself
    more: Mapping[str, Any] = field(default_factory=dict)  # further fields
    stated: Container[str] | None = None  # fields of the vehicle that are known; None: all
    beside: Mapping[str, Path] = field(default_factory=dict)  # trial -> its folder, of which encoder.csv is kept


def copies(drives: Sequence[Drive]) -> list[str]:
    """Notes on drives that hold the same numbers as an earlier one."""
    first: dict[tuple[bytes, ...], str] = {}
    pairs = [(drive.name, first.setdefault(tuple(b"" if one is None else one.tobytes() for one in (
        drive.command, drive.odometry, drive.ground_truth)), drive.name)) for drive in drives]
    return [f"{name} is a copy of {other}: as replicates they would show a noise of 0, and held out it would be seen "
            "before. Leave one out" for name, other in pairs if name != other]


def write_dataset(folder: Path, found: Found, held_out: Sequence[str] = (), source: Path | None = None) -> list[str]:
    """Write the trials that the loader accepts into a dataset folder, and note those left out; an existing dataset
    keeps its fields and trials. `source`: named in errors.

    ValueError, and nothing is written, where a trial exists with other contents, names repeat, none is accepted, or an
    existing dataset is of another vehicle.
    """
    drives, more = found.drives, dict(found.more)
    names = [drive.name for drive in drives]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{folder}: two trials would be named {twice[0]!r}. Rename one of the bags.")
    known = (folder / "dataset.toml").exists()
    if known and held_out and set(held_out) != set(read_fields(folder / "dataset.toml").get("held_out", ())):
        raise ValueError(f"{folder / 'dataset.toml'}: exists already, so --held-out cannot be noted. Add the "
                         "trials to its held_out by hand.")
    if known:
        _check_joins(folder, found)
    if known and any((folder / "trials").glob("*")):
        load_log(folder)  # trials are not added to what cannot be loaded
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
            write_fields(partial, found.spec, held_out, more, found.stated)
            spec_from_fields(folder / "dataset.toml", read_fields(partial / "dataset.toml"))
        for name in refused:
            shutil.rmtree(partial / "trials" / name)
        for name in accepted:
            if name in found.beside and (encoder := found.beside[name] / ENCODER).exists():
                shutil.copyfile(encoder, partial / "trials" / name / ENCODER)
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


def _check_joins(folder: Path, found: Found) -> None:
    """Raise ValueError where new trials mean something else than those of the dataset that they join."""
    fields = read_fields(folder / "dataset.toml")
    spec, _ = spec_from_fields(folder / "dataset.toml", fields)
    usual = {"input": "commands", "reference_point": "drive axle centre"}
    pairs = {key: (getattr(spec, key), getattr(found.spec, key)) for key in ("wheel_radius", "track", "drive")}
    pairs |= {key: (fields.get(key, usual.get(key)), found.more.get(key, usual.get(key)))
              for key in ("input", *(one for one in ("command_timeout", "reference_point") if one in found.more))}
    for key, (mine, theirs) in pairs.items():
        if mine != theirs:
            raise ValueError(f"{folder}: its {key} is {mine}, and that of the new trials is {theirs}. Choose another "
                             "--out.")


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
