"""Drives out of somebody else's CSV and TUM files: joined by time, in SI units; which column holds what is as the user
said, as guessed, or as answered on a terminal."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sysid.logs.records import name_of
from sysid.logs.tables.columns import QUANTITIES, ROLES, SAID, Column, Table, is_unit_of, kind_of, unit_of, units_of
from sysid.logs.tables.guess import guess, shown_units
from sysid.logs.tables.names import COUNTS, TICKS, TIME_WORDS, split_unit
from sysid.logs.tables.sizes import TURNED
from sysid.logs.tables.streams import as_odometry, as_twist, backward_wheel, dead_reckoned, stream_rows, with_rates
from sysid.logs.tables.text_table import read_table, text_files
from whill_mjx.io.fields import shown

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
    changing = [replace(table, columns={name: values for name, values in table.columns.items()
                                        if np.nanmin(values) < np.nanmax(values)}) for table in tables]
    if unused := unused_columns(changing, columns):
        notes.append(f"not used: {first_of(unused)}")
    notes = list(dict.fromkeys(note.removeprefix(f"{name}: ") for note in notes))
    return TextDrive(name, made, tuple(columns), tuple(notes), measured_input)


NAMED = 12  # columns that an error lists
FAR_MORE, STEEP, LEAST_WAY = 3.0, 0.3, 0.3
"""Times the least of x and y, share of the greatest, and m of that at least: no vehicle on a floor rises by as much."""


def read_decision(text: str, tables: Sequence[Table]) -> Column:
    """One `ROLE=[FILE/]COLUMN[:UNIT]` as somebody wrote it; a minus before the unit, or for it, turns the sign."""
    role, equals, rest = text.partition("=")
    role, rest = role.strip(), rest.strip()
    if not equals or role not in ROLES:
        raise ValueError(f"--columns {text}: must be ROLE=COLUMN:UNIT, with a role of {', '.join(ROLES)}.")
    for table in tables:
        for name in sorted(table.columns, key=len, reverse=True):
            for written in (f"{table.stem}/{name}", name):
                unit = rest[len(written) :].strip()
                if rest.startswith(written) and (not unit or unit.startswith(":")):
                    unit = unit_of(unit[1:].strip()) if unit else ""
                    plain = "-" if kind_of(role) == "none" else ""  # a unit that is a minus itself
                    sign = -1.0 if unit.startswith("-") and unit != plain and role != "time" else 1.0
                    unit = unit_of(unit[1:]) if sign < 0 else unit
                    if unit and not is_unit_of(role, unit):
                        ticks = {"time": ", Nhz for N rows in a second"}.get(
                            role, ", N/rev for N ticks in a turn" if role.endswith("_angle") else "")
                        raise ValueError(f"--columns {text}: {unit!r} is no unit of {role} "
                                         f"(known: {', '.join(units_of(role))}{ticks}).")
                    return Column(role, table.stem, name, unit or split_unit(name)[1], "" if unit else SAID, sign=sign)
    known = ", ".join(f"{table.stem}/{name}" for table in tables for name in table.columns)
    raise ValueError(f"--columns {text}: no such column (found {known[:400]}). Correct its name.")


def decisions_of(tables: Sequence[Table], said: Sequence[str]) -> list[Column]:
    """The decisions that are of these files; ValueError where two are of one column, or give one role to two."""
    found: dict[tuple[str, ...], str] = {}
    columns = []
    for text in dict.fromkeys(said):
        if not _is_here(text, tables) and len(tables) > 1:
            continue
        one = read_decision(text, tables)
        columns.append(one)
        for key in ((one.role, one.file if one.role == "time" else ""), ("", one.file, one.name)):
            if (other := found.setdefault(key, text)) != text:
                raise ValueError(f"--columns {other} and {text}: two decisions on one "
                                 f"{'role' if key[0] else 'column'}. Leave one of them out.")
    return columns


def decide(
    source: Path, tables: Sequence[Table], said: Sequence[str], units: Mapping[tuple[str, str], str], wheels: bool
) -> tuple[list[Column], list[str]]:
    """What the columns hold: as said, as guessed from names and numbers, and as answered on a terminal."""
    def guessed_now() -> list[Column]:
        found = guess(tables, decided, units)
        return [one for one in found if not wheels or not one.role.startswith("command.")]

    decided = decisions_of(tables, said)
    columns = guessed_now()
    problem = _problem(tables, columns)
    if problem and sys.stdin.isatty() and sys.stdout.isatty():
        print(f"{source}: {problem}\nGuessed:")
        for one in columns:
            print(f"  {one}" + (f"   ({one.why})" if one.why else ""))
        print("Columns:", ", ".join(f"{table.stem}/{name}" for table in tables for name in table.columns))
        answer = input("Enter takes this; or type what differs, as ROLE=COLUMN:UNIT ROLE=COLUMN:UNIT ...\n> ")
        decided = decisions_of(tables, [*said, *answer.split()])
        columns = [replace(one, why="", sure=True, assumed=False) for one in guessed_now()]
        problem, said = _problem(tables, columns), [str(one) for one in columns]
    if problem:
        names = [f"{table.stem}/{name}" for table in tables for name in (*table.columns, *table.texts)]
        guessed = " ".join(f"'{one}'" for one in columns) or "nothing"
        raise ValueError(f"{source}: {problem} Its columns are {first_of(names)}; guessed: {guessed}. Give --columns "
                         "with what differs and what is missing, each as ROLE=COLUMN:UNIT; see docs/sysid_tools.md.")
    return columns, list(said)


def first_of(names: Sequence[str]) -> str:
    """A list of columns, as messages show it."""
    return ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")


def _is_here(text: str, tables: Sequence[Table]) -> bool:
    """Whether a decision is of one of these files; one without a known column is, so that it is refused."""
    rest = text.partition("=")[2].strip()
    if any(rest.startswith((f"{table.stem}/{name}", name)) for table in tables for name in table.columns):
        return True
    return all("/" not in rest or rest.split("/")[0] == table.stem for table in tables)


def _problem(tables: Sequence[Table], columns: Sequence[Column]) -> str:
    """What is not clear; empty where a drive can be made."""
    roles = {one.role for one in columns}
    used = {one.file for one in columns if one.role != "time"}
    timeless = sorted(used - {one.file for one in columns if one.role == "time"})
    if timeless:
        table = next(table for table in tables if table.stem == timeless[0])
        said = next((f" Its {name} holds {shown(cell)}, which is no time that is known: write seconds, or "
                     "YYYY-MM-DD HH:MM:SS.SSS." for name, cell in table.texts.items()
                     if set(re.split("[^a-z]+", name.lower())) & set(TIME_WORDS)), "")
        said = said or next((f" If its {name} counts rows, say how many there are in a second: time={table.stem}/{name}"
                             ":100hz." for name in table.columns if COUNTS.search(name)), "")
        return f"no column of {timeless[0]} is surely its time.{said}"
    if sideways := _of_a_camera(tables, columns):
        return sideways
    arrays = {(table.stem, name): values for table in tables for name, values in table.columns.items()}
    for one in columns:
        values = arrays[one.file, one.name]
        if one.role == "time" and one.file in used and np.nanmin(values) == np.nanmax(values):
            return f"time stands still in {one.file}/{one.name}."
    pair, wheels = ({f"{stream}.left", f"{stream}.right"} <= roles for stream in ("command", "wheels"))
    wheels |= {"wheels.left_angle", "wheels.right_angle"} <= roles
    speeds, place, outside = {"odometry.v", "odometry.omega"} <= roles, {"odometry.x", "odometry.y"} <= roles, {
        "ground_truth.x", "ground_truth.y"} <= roles
    commands = "command.v" in roles or pair
    if not commands and (found := [one for one in columns if one.role.startswith("command.")]):
        return (f"{found[0].file}/{found[0].name} is the only part of a command: v and omega, or left and right belong "
                "to it.")
    if {"command.v", "command.omega"} & roles == {"command.v"} and (turn := _turned(columns, arrays)) > TURNED:
        unused = first_of(unused_columns(tables, columns))
        return (f"no column is the commanded yaw rate, though the vehicle turns by {turn:.2g} rad: "
                f"{f'not used: {unused}' if unused else 'all columns are used'}. If none was commanded, add a column "
                "of zeros for it.")
    inputs = {"command.v", "command.omega"} <= roles or pair or wheels
    measured = outside or speeds or place
    for holds, said in (
            (not inputs and not measured, "no column is surely a command, a wheel speed or a pose."),
            ({"odometry.v", "odometry.omega"} & roles and not place and not speeds,
             "the odometry has only one of v and omega."),
            (not inputs and not speeds, "there are neither commands (v, omega) nor wheel speeds."),
            (not commands and not outside,
             "there are measured speeds, and neither commands nor an outside pose to compare them with."),
            (not measured and not (wheels and commands),
             "there is neither odometry (v, omega or x, y, yaw) nor an outside pose.")):
        if holds:
            return said
    if unsure := [one for one in columns if not one.sure]:
        ticks = next((f" If it counts ticks, say how many make a turn: {one.role}={one.file}/{one.name}:N/rev."
                      for one in unsure if TICKS.search(one.name)), "")
        return f"it is not clear what {', '.join(f'{one.file}/{one.name}' for one in unsure)} " + (
            "is." if len(unsure) == 1 else "are.") + ticks
    return ""


def _of_a_camera(tables: Sequence[Table], columns: Sequence[Column]) -> str:
    """A sentence on a trajectory in TUM's form, guessed to be of the floor, whose z moves as none does on a floor."""
    guessed = {(one.file, one.name): one.role.partition(".")[0] for one in columns if one.why not in ("", SAID)}
    for table in tables:
        stream = guessed.get((table.stem, "tx"))
        if stream is None or guessed.get((table.stem, "ty")) != stream or "tz" not in table.columns:
            continue
        x, y, z = (float(np.subtract(*np.nanpercentile(table.columns[name], (98, 2)))) for name in ("tx", "ty", "tz"))
        if z < FAR_MORE * min(x, y) or z < STEEP * max(x, y, LEAST_WAY):
            continue
        up, least, axes = (("tx", x, ("ty", "tz", "qy", "qz", "qx")) if x < y > STEEP * z else
                           ("ty", y, ("tz", "tx", "qz", "qx", "qy")))
        decided = [f"{stream}.{role}={table.stem}/{name}{turned}" for role, name, turned in zip(
            ("x", "y", "qx", "qy", "qz", "qw"), (*axes, "qw"), ("", ":-m", "", ":--", ":--", ""), strict=True)]
        return (f"its tz moves by {z:.2g} m, {up} by {least:.2g} m: its frame is that of a camera, whose {up[1]} axis "
                f"is the vertical one. Where {up[1]} points down, as ORB-SLAM writes it: --columns "
                f"{' '.join(decided)}. Where {up[1]} points up: the same without the three minus units.")
    return ""


def _turned(columns: Sequence[Column], arrays: Mapping[tuple[str, str], np.ndarray]) -> float:
    """How far the vehicle surely turns [rad]: the least span of its measured headings; 0 where none is measured."""
    spans = []
    for one in columns:
        if one.role in ("odometry.yaw", "ground_truth.yaw"):  # others may have no unit yet
            values = arrays[one.file, one.name]
            known = one.in_si(values[np.isfinite(values)])
            spans.append(float(np.ptp(np.unwrap(known))) if len(known) else 0.0)
    return min(spans, default=0.0)


def unused_columns(tables: Sequence[Table], columns: Sequence[Column]) -> list[str]:
    """The columns without a role, each as FILE/COLUMN."""
    used = {(one.file, one.name) for one in columns}
    return [f"{table.stem}/{name}" for table in tables for name in table.columns if (table.stem, name) not in used]
