"""Drives out of somebody else's CSV and TUM files: which columns they have, joined by time, in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sysid.logs.records import name_of
from sysid.logs.tables.columns import QUANTITIES, Column, Table
from sysid.logs.tables.decisions import decide, decisions_of, first_of, unused_columns, without_yaw_rate
from sysid.logs.tables.guess import guess, shown_units
from sysid.logs.tables.sizes import TURNED
from sysid.logs.tables.streams import as_odometry, as_twist, backward_wheel, dead_reckoned, stream_rows, with_rates
from sysid.logs.tables.text_table import read_table, text_files, unreadable

LEAST_OF: dict[str, list[tuple[str, ...]]] = {
    "command": [("v",), ("left", "right")], "odometry": [("v", "omega"), ("x", "y", "yaw")],
    "ground_truth": [("x", "y")], "wheels": [("left", "right"), ("left_angle", "right_angle")],
}  # fmt: skip
"""What of a stream must be there, at least one of these."""


@dataclass(frozen=True)
class TextDrive:
    """One drive out of text files."""

    name: str
    tables: dict[str, np.ndarray]  # "command", "odometry", "ground_truth": t [s] and the columns of docs/log_format.md
    columns: tuple[Column, ...]
    notes: tuple[str, ...]
    measured_input: bool  # whether the commands are measured wheel speeds


def read_drives(
    source: Path, said: Sequence[str], geometry: tuple[float, float], wheels: bool = False
) -> tuple[list[TextDrive], list[str]]:
    """The drives of a CSV or TUM file or a folder of them, and notes on what is left out; ValueError if none is clear.

    Args:
        said: decisions, each ROLE=[FILE/]COLUMN[:UNIT]; the rest is guessed.
        geometry: wheel radius and track [m], of wheel speeds.
        wheels: take measured wheel speeds as the input, and leave commands out.
    """
    groups, refused = list[tuple[str, list[Table]]](), list[ValueError]()
    for path in unreadable(source):
        refused.append(ValueError(f"{path}: no file that can be read: a broken link, a pipe or a device."))
    for files in text_files(source):
        found = []
        for path in files:
            try:
                found.append((path, read_table(path)))
            except ValueError as error:
                refused.append(error)
        stems = [path.stem for path, _ in found]
        tables = [one if stems.count(path.stem) == 1 else replace(one, stem=path.name) for path, one in found]
        if not tables:
            continue
        whole = tables if source.is_file() else [table for table in tables if _is_whole(table)]
        if source.is_file() or len(whole) > max(1, len(tables) / 2):
            groups += [(table.stem, [table]) for table in whole]
            refused += [ValueError(f"{files[0].parent / table.stem}: no drive by itself, as most files beside it are: "
                                   "it lacks an input or a measurement.")
                        for table in tables if all(table is not one for one in whole)]
        else:
            groups.append((name_of(files[0].parent), tables))
    if not groups and refused:
        raise refused[0]
    try:
        drives, notes = join_drives(source, groups, said, geometry, wheels)
    except ValueError as error:
        raise ValueError(f"{error} Left out before: {refused[0]}") if refused else error from None
    return drives, [*(f"left out: {error}" for error in refused), *notes]


def join_drives(
    source: Path, groups: Sequence[tuple[str, list[Table]]], said: Sequence[str], geometry: tuple[float, float],
    wheels: bool = False,
) -> tuple[list[TextDrive], list[str]]:
    """Drives of tables by name, otherwise as `read_drives`; one that is not clear does not keep out the others."""
    units = shown_units([guess(tables, decisions_of(tables, said)) for _, tables in groups]) if len(groups) > 1 else {}
    drives, refused, agreed = list[TextDrive](), list[ValueError](), list(said)
    for name, tables in groups:
        try:
            columns, agreed = decide(source, tables, agreed, units, wheels)
            drives.append(_join(name, source, tables, columns, geometry))
        except ValueError as error:
            at = "" if str(source) in str(error) else f"{source}: "
            refused.append(ValueError(f"{at}{error}"))
    if not drives and refused:
        raise refused[0]
    return drives, [f"left out: {error}" for error in refused]


def _is_whole(table: Table) -> bool:
    """Whether a file is a drive of its own: with an input and a measurement."""
    streams = {one.role.partition(".")[0] for one in guess([table])} - {"time"}
    return len(streams) > 1 and bool(streams & {"command", "ground_truth"})


def _join(name: str, source: Path, tables: Sequence[Table], columns: Sequence[Column],
          geometry: tuple[float, float]) -> TextDrive:
    """The streams of one drive on one clock."""
    notes = [f"{table.stem}: {table.odd[one.name]}" for table in tables for one in columns
             if one.file == table.stem and one.name in table.odd]
    streams: dict[str, dict[str, np.ndarray]] = {}
    for stream in QUANTITIES:
        found, said = stream_rows(stream, tables, columns)
        if found and not any(set(one) <= set(found) for one in LEAST_OF[stream]):
            parts = " and ".join(f"{stream}.{one}" for one in LEAST_OF[stream][0])
            said = [f"{stream}: only {', '.join(sorted(set(found) - {'t'}))} of {parts}: left out"]
        elif found:
            streams[stream] = found
        notes += said
    made: dict[str, np.ndarray] = {}
    if "command" in streams:
        made["command"] = as_twist(streams["command"], columns, "command", geometry)
    wheels, counted = None, list(columns)
    if "wheels" in streams:
        rates, counted, said = with_rates(streams["wheels"], columns)
        wheels = as_twist(rates, counted, "wheels", geometry)
        notes += said
    if wheels is not None and "command" in made and (backwards := backward_wheel(made["command"], wheels)):
        one = next(one for one in counted if one.role.startswith(f"wheels.{backwards}"))
        turned = replace(one, sign=-one.sign, unit="" if one.why else one.unit)  # a unit guessed from it may be wrong
        raise ValueError(f"{source}: {one.file}/{one.name}: the {backwards} wheel counts backwards: the two differ "
                         f"where the vehicle is sent straight ahead. Turn its sign: --columns {turned}")
    odometry = streams.get("odometry")
    if odometry is not None:
        made["odometry"], note = as_odometry(odometry, wheels)
        notes += [note] if note else []
    elif wheels is not None and "command" in made:
        made["odometry"] = dead_reckoned(wheels)
        notes.append("odometry is dead reckoned from the wheel speeds")
    measured_input = "command" not in made
    if measured_input:
        made["command"] = wheels if wheels is not None else made["odometry"][:, [0, 4, 5]]
        notes.append("no commands: the measured wheel speeds are the input"
                     if wheels is not None else "no commands: the odometry's speeds are the input")
        made.pop("odometry", None)
    if "ground_truth" in streams:
        truth = streams["ground_truth"]
        if "yaw" in truth:
            made["ground_truth"] = np.column_stack([truth["t"], truth["x"], truth["y"], truth["yaw"]])
        else:
            notes.append("the outside pose has no heading and is left out")
    if not {"odometry", "ground_truth"} & set(made):
        raise ValueError(f"{source}: {name} has {'wheel speeds' if measured_input else 'commands'} and nothing to "
                         "compare their motion with. Add an outside pose, or commands beside the wheel speeds.")
    begin, end = max(one[0, 0] for one in made.values()), min(one[-1, 0] for one in made.values())
    if begin >= end:
        spans = "; ".join(f"{key} {one[0, 0]:.3f} to {one[-1, 0]:.3f} s" for key, one in made.items())
        raise ValueError(f"{source}: the streams of {name} share no time ({spans}). Put them on one clock first.")
    turns = [float(np.ptp(made[one][:, 3])) for one in ("odometry", "ground_truth") if one in made]
    if not {"omega", "left"} & set(streams.get("command", {"omega"})) and min(turns) > TURNED:
        raise ValueError(f"{source}: {name}: {without_yaw_rate(min(turns), _left_over(tables, columns))}")
    if unused := _left_over(tables, columns):
        notes.append(f"not used: {first_of(unused)}")
    notes = list(dict.fromkeys(note.removeprefix(f"{name}: ") for note in notes))
    return TextDrive(name, made, tuple(columns), tuple(notes), measured_input)


def _left_over(tables: Sequence[Table], columns: Sequence[Column]) -> list[str]:
    """The columns that change and have no role, each as FILE/COLUMN."""
    changing = [replace(table, columns={name: values for name, values in table.columns.items()
                                        if np.nanmin(values) < np.nanmax(values)}) for table in tables]
    return unused_columns(changing, columns)
