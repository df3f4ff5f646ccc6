"""What the columns of a drive hold: as the user said, as guessed, and as answered on a terminal."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sysid.logs.tables.columns import (
    ROLES,
    SAID,
    Column,
    Table,
    is_unit_of,
    kind_of,
    size_of,
    unit_named,
    unit_of,
    units_of,
)
from sysid.logs.tables.guess import guess
from sysid.logs.tables.names import (
    COUNTS,
    STREAM_WORDS,
    TICKS,
    TIME_WORDS,
    by_name,
    says_any_stream,
    says_stream,
    split_unit,
)
from sysid.logs.tables.sizes import TURNED
from whill_mjx.io.fields import shown

NAMED = 12  # columns that an error lists
MEASURE = re.compile(r"[^\W\d_] ?[/%]|%|^hz$")
"""In texts behind a name that are units: of others nobody knows, and numbers show the unit."""
SAME = 0.02  # of a column's range, within which another one holds the same
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
    if said := _of_a_camera(tables, columns) or _of_no_unit(columns) or _of_two_clocks(tables, columns):
        return said
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
        return without_yaw_rate(turn, unused_columns(tables, columns))
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
    if rivals := _rivals(tables, columns):
        return rivals
    if unsure := [one for one in columns if not one.sure]:
        ticks = next((f" If it counts ticks, say how many make a turn: {one.role}={one.file}/{one.name}:N/rev."
                      for one in unsure if TICKS.search(one.name)), "")
        return f"it is not clear what {', '.join(f'{one.file}/{one.name}' for one in unsure)} " + (
            "is." if len(unsure) == 1 else "are.") + ticks
    return ""


def _rivals(tables: Sequence[Table], columns: Sequence[Column]) -> str:
    """A sentence on two columns that may equally be one quantity and differ; empty where there are none."""
    arrays = {(table.stem, name): values for table in tables for name, values in table.columns.items()}
    taken = {(one.file, one.name) for one in columns}
    chosen = {one.role: one for one in columns if one.guessed and one.sure and one.role != "time"
              and not one.role.startswith("wheels.")}
    for table in tables:
        for name in table.columns:
            other = None if (table.stem, name) in taken else by_name(table, name)
            mine = chosen.get(other.role) if other is not None and other.sure else None
            if other is None or mine is None or says_any_stream(mine.name) and not says_any_stream(name):
                continue
            if _differ(arrays[mine.file, mine.name], mine, arrays[table.stem, name], other):
                return (f"{mine.file}/{mine.name} and {table.stem}/{name} may both be {mine.role}, and they differ. "
                        f"Say which is: {mine.role}=COLUMN.")
    return ""


def _of_no_unit(columns: Sequence[Column]) -> str:
    """A sentence on a column whose name states a unit that is not known: its numbers would be read in another one."""
    for one in columns:
        unit = split_unit(one.name)[1]
        if one.guessed and MEASURE.search(unit) and not unit_named(unit) and not is_unit_of(one.role, unit):
            known = ", ".join(units_of(one.role))
            return (f"the unit {unit!r} of {one.file}/{one.name} is not known (known: {known}). If it is one of these, "
                    f"say {one.role}={one.file}/{one.name}:UNIT; else convert the column.")
    return ""


def _of_two_clocks(tables: Sequence[Table], columns: Sequence[Column]) -> str:
    """A sentence on two columns of a file that are the times of two streams, and differ: a file has one time."""
    for table in tables:
        if any(one.role == "time" and one.file == table.stem and not one.guessed for one in columns):
            continue  # somebody said which one counts
        used = STREAM_WORDS.keys() & {one.role.partition(".")[0] for one in columns if one.file == table.stem}
        clocks: dict[str, str] = {}  # by stream
        for name in table.columns:
            column = by_name(table, name)
            if column is not None and column.role == "time":
                clocks |= {stream: name for stream in used if says_stream(name, stream)}
        if len(set(clocks.values())) > 1:
            one, other, *_ = dict.fromkeys(clocks.values())
            first, second = (table.columns[name] for name in (one, other))
            step = float(np.nanmedian(np.abs(np.diff(first))))
            if not np.allclose(first, second, rtol=0.0, atol=SAME * step, equal_nan=True):
                return (f"{table.stem}/{one} and {table.stem}/{other} are times of different streams, and they differ, "
                        "while a file has one time. Write each stream with its time to a file of its own, or say which "
                        f"counts: time={table.stem}/{one}.")
    return ""


def _differ(values: np.ndarray, one: Column, others: np.ndarray, other: Column) -> bool:
    """Whether two columns (T,) hold other numbers; one that states no unit has the other's."""
    if not (np.isfinite(values).any() and np.isfinite(others).any()) or np.nanmin(others) == np.nanmax(others):
        return False  # nothing is lost with a column that never changes
    if len(values) != len(others):
        return True
    sizes = [size_of(each.role, each.unit) if is_unit_of(each.role, each.unit) else 1.0
             for each in (one, other if other.unit else one)]
    rows = np.arange(len(values))
    a, b = (np.interp(rows, rows[np.isfinite(numbers)], size * numbers[np.isfinite(numbers)])
            for numbers, size in zip((values, others), sizes, strict=True))
    apart = np.angle(np.exp(1j * (a - b))) if kind_of(one.role) == "angle" else a - b  # a heading may be wrapped
    return bool(np.percentile(np.abs(apart), 90) > SAME * np.ptp(a))


def _of_a_camera(tables: Sequence[Table], columns: Sequence[Column]) -> str:
    """A sentence on a trajectory in TUM's form, guessed to be of the floor, whose z moves as none does on a floor."""
    guessed = {(one.file, one.name): one.role.partition(".")[0] for one in columns if one.guessed}
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


def without_yaw_rate(turn: float, unused: Sequence[str]) -> str:
    """What is said of commands without a yaw rate to a vehicle that turns [rad]."""
    return (f"no column is the commanded yaw rate, though the vehicle turns by {turn:.2g} rad: "
            f"{f'not used: {first_of(unused)}' if unused else 'all columns are used'}. If none was commanded, add a "
            "column of zeros for it.")


def unused_columns(tables: Sequence[Table], columns: Sequence[Column]) -> list[str]:
    """The columns without a role, each as FILE/COLUMN."""
    used = {(one.file, one.name) for one in columns}
    return [f"{table.stem}/{name}" for table in tables for name in table.columns if (table.stem, name) not in used]
