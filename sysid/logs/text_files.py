"""Drives out of somebody else's CSV and TUM files: which columns they have, joined by time, in SI units."""

from __future__ import annotations

import csv
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sysid.logs.columns import (
    COUNTS,
    QUANTITIES,
    TICKS,
    TIME_WORDS,
    UNITS,
    Column,
    Table,
    guess,
    read_decision,
    shown_units,
    unit_named,
    with_unit,
)  # fmt: skip
from sysid.logs.directions import RESPONSE, VARIED
from sysid.logs.transforms import DIFFERENCED, pose_speeds
from sysid.logs.wheel_states import integrate_speeds
from whill_mjx.io.fields import counted, shown
from whill_mjx.io.reading import CSV_BYTES, read_text

SUFFIXES = (".csv", ".txt", ".tsv", ".tum")
TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
LEAST = 10  # rows of a stream
FOLLOWED, UNFOLLOWED = 0.7, 0.5  # correlation with a command of what follows it, and of what does not
LONGEST_NAME = 200  # characters
HOUR = 3600.0  # s
DAY = 86400.0  # s
ONE_SIDE = 0.5  # of the squares of qx and qy of a vehicle that lies on its side
DATE = re.compile(r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})[ T/,-]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,:](\d+))?)?"
                  r" *([AaPp][Mm])?")
"""A date and a time of day, as spreadsheets, MATLAB and `rostopic echo -p` write them."""
NUMBERED = re.compile(r"(\d+(?:(?:[\s,]+|\s*\.\.\s*)\d+)*)[\s:.)]+([^\W\d].*)")
"""A comment that gives columns names by their numbers, as loggers for MATLAB write it."""
PREAMBLE = 30  # lines above the names
BACK = (3.0, 0.1)  # usual steps, and s, by which a row may be older than the one before it: it came out of order
NAMED = 12  # columns that an error lists
LEAST_OF: dict[str, list[tuple[str, ...]]] = {
    "command": [("v",), ("left", "right")], "odometry": [("v", "omega"), ("x", "y", "yaw")],
    "ground_truth": [("x", "y")], "wheels": [("left", "right"), ("left_angle", "right_angle")],
}  # fmt: skip
"""What of a stream must be there, at least one of these."""
MISSING = ("", "nan", "na", "n/a", "null", "none", "-", "--")  # cells of samples that are missing


@dataclass(frozen=True)
class TextDrive:
    """One drive out of text files."""

    name: str
    tables: dict[str, np.ndarray]  # "command", "odometry", "ground_truth": t [s] and the columns of docs/log_format.md
    columns: tuple[Column, ...]
    notes: tuple[str, ...]
    measured_input: bool  # whether the commands are measured wheel speeds


def text_files(source: Path) -> list[list[Path]]:
    """The text files of each drive at a path: a file, a folder of them, or a folder of such folders."""
    if source.is_file():
        return [[source]] if source.suffix.lower() in SUFFIXES else []
    files = _texts(source)
    if not files:
        return [found for folder in sorted(source.iterdir()) if folder.is_dir() and (found := _texts(folder))]
    return [files]


def read_drives(
    source: Path, said: Sequence[str], geometry: tuple[float, float], wheels: bool = False
) -> tuple[list[TextDrive], list[str]]:
    """The drives of a CSV file, a TUM file or a folder of them, and notes on what is left out; ValueError where none
    is clear.

    Args:
        said: decisions, each ROLE=[FILE/]COLUMN[:UNIT]; the rest is guessed.
        geometry: wheel radius and track [m], of wheel speeds.
        wheels: take measured wheel speeds as the input, and leave commands out.
    """
    groups: list[tuple[str, list[Table]]] = []
    refused: list[ValueError] = []
    for files in text_files(source):
        tables = []
        for path in files:
            try:
                tables.append(read_table(path))
            except ValueError as error:
                refused.append(error)
        if not tables:
            continue
        whole = tables if source.is_file() else [table for table in tables if _is_whole(table)]
        if source.is_file() or len(whole) > max(1, len(tables) / 2):
            groups += [(table.stem, [table]) for table in whole]
            refused += [ValueError(f"{files[0].parent / table.stem}: no drive by itself, as most files beside it are: "
                                   "it lacks an input or a measurement.")
                        for table in tables if all(table is not one for one in whole)]
        else:
            groups.append((files[0].absolute().parent.name, tables))
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
    units = shown_units([guess(tables, _said_of(tables, said)) for _, tables in groups]) if len(groups) > 1 else {}
    drives: list[TextDrive] = []
    refused: list[ValueError] = []
    agreed: list[str] = list(said)
    for name, tables in groups:
        try:
            columns, agreed = _decide(source, tables, agreed, units, wheels)
            drives.append(_join(name, source, tables, columns, geometry))
        except ValueError as error:
            at = "" if str(source) in str(error) else f"{source}: "
            refused.append(ValueError(f"{at}{error}"))
    if not drives and refused:
        raise refused[0]
    return drives, [f"left out: {error}" for error in refused]


def read_table(path: Path) -> Table:
    """The numbers of a text file by column; comments and blank lines are left out, empty cells are nan."""
    text = read_text(path, CSV_BYTES, "no such file.")
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    header: list[str] | None = None
    data = [(number, line) for number, line in lines if not line.lstrip().startswith(("#", "%"))]
    comments = [line.lstrip("#% \t") for _, line in lines if line.lstrip().startswith(("#", "%"))]
    if not data:
        raise ValueError(f"{path}: no rows. Give a table of numbers with a line of names.")
    split = next((one for one in ("\t", ";", ",") if one in data[len(data) // 2][1]), None)  # None: spaces
    data = _without_preamble(path, data, split)
    if stacked := _stacked_names([_cells(line, split) for _, line in data[:PREAMBLE]]):
        header, data = stacked[0], data[stacked[1] :]
    elif numbered := _numbered_names(comments, _cells(data[0][1], split)):
        header = numbered
    elif comments and path.read_bytes()[:1] == b"%" and (
            len(_cells(comments[0], split)) == len(_cells(data[0][1], split))):
        header = _cells(comments[0], split)  # of `rostopic echo -p`
    elif not _is_numbers([cell.replace(",", ".") for cell in _cells(data[0][1], split)]):
        header, data = _cells(data[0][1], split), data[1:]
    elif comments and len(_cells(comments[-1], split)) == len(_cells(data[0][1], split)):
        header = _cells(comments[-1], split)
    rows = [_cells(line, split) for _, line in data]
    width = len(header) if header is not None else len(rows[0]) if rows else 0
    if rows and all(len(row) > width and not any(row[width:]) for row in rows):
        rows = [row[:width] for row in rows]  # each row ends with a separator, and the names do not
    if rows and len(rows[-1]) != width:
        rows = rows[:-1]  # a recorder that was stopped
    for (number, _), row in zip(data, rows, strict=False):
        if len(row) != width:
            raise ValueError(f"{path}, line {number}: has {len(row)} cells, the first row {width}. Save it again.")
    if len(rows) < LEAST:
        raise ValueError(f"{path}: {counted(len(rows), 'row')}; at least {LEAST} are needed. Give the whole recording.")
    if header is not None and all(unit_named(cell) for cell in rows[0] if cell) and any(rows[0]):
        header, data, rows = list(map(with_unit, header, rows[0])), data[1:], rows[1:]
    if header is None:
        header = _tum_names(rows) if width == len(TUM) else [f"column{k + 1}" for k in range(width)]
    odd = next((name for name in header if not name.isprintable() or len(name) > LONGEST_NAME), None)
    if odd is not None:
        raise ValueError(f"{path}: column {shown(odd)}: a name has at most {LONGEST_NAME} printable characters. "
                         "Correct it.")
    return _table(path, header, rows, [number for number, _ in data])


def _table(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]], lines: Sequence[int]) -> Table:
    """The columns of a file that hold numbers, and notes on their cells that do not."""
    numbers: dict[str, np.ndarray] = {}
    odd: dict[str, str] = {}
    texts: dict[str, str] = {}
    for name, *cells in zip((one.strip() for one in header), *rows, strict=True):
        values = _numbers(cells := _without_separators(cells))
        known = np.isfinite(values)
        if known.sum() < 3 or not name:
            texts |= {name: cells[0]} if name and any(cells) else {}
            continue
        if name in numbers and not np.array_equal(numbers[name], values, equal_nan=True):
            raise ValueError(f"{path}: two columns are named {shown(name)} and differ. Give each its own name.")
        numbers[name] = values
        wrong = [int(k) for k in np.flatnonzero(~known) if cells[k].lower() not in MISSING]
        if wrong:
            odd[name] = (f"{counted(len(wrong), 'cell')} of {name} {'is no number' if len(wrong) == 1 else 'are none'} "
                         f"({shown(cells[wrong[0]])} in line {lines[wrong[0]]}): left out")
    return Table(path.stem, _with_whole_stamps(numbers), odd, texts)


def _tum_names(rows: Sequence[Sequence[str]]) -> list[str]:
    """Names of the columns of a trajectory in TUM's form. Some programs write w of the quaternion first, which shows
    where a vehicle would lie on its side otherwise."""
    parts = np.array([[_number(cell) for cell in row[4:]] for row in rows])
    last, first = (float(np.nanmean((parts[:, k : k + 2] ** 2).sum(1))) for k in (0, 1))
    return [*TUM[:4], "qw", "qx", "qy", "qz"] if first < ONE_SIDE / 10 < ONE_SIDE < last else list(TUM)


def _without_separators(cells: Sequence[str]) -> list[str]:
    """The cells of a column with decimal points, and without the separators of thousands that some of them show."""
    if any(re.fullmatch(r"[-+]?\d{1,3}(\.\d{3})+,\d+|[-+]?\d{1,3}(\.\d{3}){2,}", cell) for cell in cells):
        cells = [cell.replace(".", "") for cell in cells]
    if any(re.fullmatch(r"[-+]?\d{1,3}(,\d{3})+\.\d+|[-+]?\d{1,3}(,\d{3}){2,}", cell) for cell in cells):
        return [cell.replace(",", "") for cell in cells]
    return [cell.replace(",", ".") if re.fullmatch(r"[-+]?\d*,\d*([eE][-+]?\d+)?", cell) else cell for cell in cells]


def _texts(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()
                  and not path.name.lower().startswith(("readme", "license", ".")))


def _cells(line: str, split: str | None) -> list[str]:
    if '"' in line and split:  # a cell in quotes may hold the separator
        found = next(csv.reader([line], delimiter=split, skipinitialspace=True))
    else:
        found = line.split(split)
    return [cell.strip().strip('"').strip() for cell in found]


def _without_preamble(path: Path, data: list[tuple[int, str]], split: str | None) -> list[tuple[int, str]]:
    """Lines from the first that has as many cells as most: above it a logger may say who it is. ValueError where the
    names above it are more or fewer."""
    counts = [len(_cells(line, split)) for _, line in data]
    usual = Counter(counts).most_common(1)[0][0]
    first = counts.index(usual)
    if not 0 < first <= PREAMBLE:
        return data
    names, row = _cells(data[first - 1][1], split), _cells(data[first][1], split)
    texts = all(names) and not any(_is_numbers([one]) for one in names)
    if texts and _is_numbers(row) and 1 < len(names) and usual <= 2 * len(names):
        if not any(row[len(names) :]) and len(row) > len(names):
            return data[first - 1 :]
        cause = " Are there decimal commas in it? Write decimals with a point, or part the cells by semicolons." if (
            split == "," and usual > len(names)) else " Save it again."
        raise ValueError(f"{path}, line {data[first][0]}: has {usual} cells, the names above it {len(names)}.{cause}")
    return data[first:]


def _stacked_names(rows: Sequence[Sequence[str]]) -> tuple[list[str], int] | None:
    """Names of columns above which, or below which, further lines of words stand, and how many lines that are; None
    where one line has the names. Motion-capture programs write a body, a quantity and an axis in a line each."""
    first = next((k for k, row in enumerate(rows) if 2 * sum(map(_is_numbers, [[one] for one in row if one]))
                  > max(len([one for one in row if one]), 1)), 0)
    units = first > 1 and all(unit_named(one) for one in rows[first - 1] if one) and any(rows[first - 1])
    last = first - 1 - units
    whole = all(rows[0]) and len(set(rows[0])) == len(rows[0])  # names enough: what follows are cells without a value
    if last < 1 or whole or len({len(row) for row in rows[: first + 1]}) > 1:
        return None
    names, above = list(rows[last]), rows[last - 1]
    if len(set(names)) < len(names):
        names = [f"{over} {name}".strip() for over, name in zip(above, names, strict=True)]
    names = [name or over for name, over in zip(names, above, strict=True)]
    return [with_unit(name, unit) for name, unit in zip(names, rows[first - 1], strict=True)] if units else names, first


def _numbered_names(comments: Sequence[str], row: Sequence[str]) -> list[str] | None:
    """Names that comments give to columns by their numbers, as `% 2,3 Velocity left, right (m/s)`, counted from 0 or 1;
    None where no two lines do so, or where they number more columns than a row of numbers has."""
    if not _is_numbers(row):
        return None
    found = [([int(one) for one in re.findall(r"\d+", match[1])], match[2]) for line in comments
             if (match := NUMBERED.fullmatch(line.strip()))]
    places = [place for numbers, _ in found for place in numbers]
    if len(found) < 2 or (first := min(places)) > 1 or max(places) - first >= len(row):
        return None
    names = [f"column{k + 1}" for k in range(len(row))]
    for numbers, text in found:
        for place, name in zip(numbers, _names_in(text, len(numbers)), strict=True):
            names[place - first] = f"{name} {place}" if name in names else name
    return names


def _names_in(text: str, count: int) -> list[str]:
    """So many names in a text like `Pose x, y, h [m, m, rad]: 0.0 0.1 0.2`, each with its unit; sample values go."""
    text = re.sub(r"\s[-+]?\d+(\.\d*)?(?=\s|$)", "", text.partition(":")[0])
    match = re.search(r"[\[(]([^\])]*)[\])]", text)
    before, inside, after = (text[: match.start()], match[1], text[match.end() :]) if match else (text, "", "")
    units = [one.strip() for one in inside.split(",")]
    parts = [one.strip() for one in (before if count == 1 else f"{before.strip()} {after.strip()}").split(",")]
    if len(parts) == count > 1:
        shared, _, parts[0] = parts[0].rpartition(" ")
        parts = [f"{shared} {one}".strip() for one in parts]
    elif count > 1:
        parts = [f"{' '.join(parts)} {k + 1}" for k in range(count)]
    else:
        parts = [before.strip()]
    units = units if len(units) == count else count * units[:1]
    return [with_unit(name, unit) if unit_named(unit) else name for name, unit in zip(parts, units, strict=True)]


def _numbers(cells: Sequence[str]) -> np.ndarray:
    """Numbers of cells (T,), nan where a cell is none; of dates and times of day, seconds."""
    values = np.array([_number(cell) for cell in cells])
    if np.isfinite(values).any() or not any(":" in cell for cell in cells):
        return values
    day_first = any((date := DATE.match(cell)) and date[2] == "." or date and int(date[1]) > 12 for cell in cells)
    values = np.array([_seconds(cell, bool(day_first)) for cell in cells])
    again = DAY if any(cell.count(":") > 1 for cell in cells) else HOUR  # past midnight, or of minutes past the hour
    return values + again * np.cumsum(np.diff(values, prepend=values[:1]) < -again / 2)


def _seconds(cell: str, day_first: bool) -> float:
    """Seconds since 1970 of a date with a time of day, since midnight, or of minutes; nan of anything else.

    `day_first`: a date that does not begin with its year begins with the day, not with the month.
    """
    if match := re.fullmatch(r"(?:(\d{1,2}):(?=\d+:))?(\d{1,2}):(\d{2}(?:[.,]\d+)?)", cell):
        if match[1] or not match[3].isdigit():  # 12:30 may be hours
            return HOUR * float(match[1] or 0) + 60 * float(match[2]) + float(match[3].replace(",", "."))
    try:
        found = datetime.fromisoformat(cell.replace(",", ".")) if not (date := DATE.fullmatch(cell)) else _date(
            date, day_first)
    except ValueError:
        return float("nan")
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


def _date(match: re.Match[str], day_first: bool) -> datetime:
    first, second, third = int(match[1]), int(match[3]), int(match[4])
    year, month, day = (first, second, third) if len(match[1]) == 4 else (third, second, first) if day_first else (
        third, first, second)
    hour, half = int(match[5]), (match[9] or "").lower()
    if half:
        hour = hour % 12 + 12 * half.startswith("p")
    return datetime(year, month, day, hour, int(match[6]), int(match[7] or 0), int((match[8] or "0")[:6].ljust(6, "0")))


def _number(cell: str) -> float:
    try:
        return float("nan" if "_" in cell else cell)  # 1_0 is a number in Python alone
    except ValueError:
        return float("nan")


def _is_numbers(cells: Sequence[str]) -> bool:
    return all(not cell or np.isfinite(_number(cell)) or cell.lower() in ("nan", "inf") for cell in cells)


def _with_whole_stamps(numbers: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of which seconds and nanoseconds of one stamp are joined as SECS+NSECS."""
    for name in list(numbers):
        match = re.fullmatch(r"(.*?)(secs|sec)", name)
        for rest in ("nsecs", "nsec", "nanosec", "nanosecs"):
            other = f"{match[1]}{rest}" if match else ""
            if match and other in numbers:
                joined = numbers.pop(name) + 1e-9 * numbers.pop(other)
                numbers = {f"{name}+{rest}": joined, **numbers}
    return numbers


def _is_whole(table: Table) -> bool:
    """Whether a file is a drive of its own: with an input and a measurement."""
    streams = {one.role.partition(".")[0] for one in guess([table])} - {"time"}
    return len(streams) > 1 and bool(streams & {"command", "ground_truth"})


def _said_of(tables: Sequence[Table], said: Sequence[str]) -> list[Column]:
    """The decisions that are of these files.

    Raises:
        ValueError: two of them are of one column, or give one role to two.
    """
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


def _decide(
    source: Path, tables: Sequence[Table], said: Sequence[str], units: Mapping[tuple[str, str], str], wheels: bool
) -> tuple[list[Column], list[str]]:
    """What the columns hold: as said, as guessed from names and numbers, and as answered on a terminal."""
    def guessed_now() -> list[Column]:
        found = guess(tables, decided, units)
        return [one for one in found if not wheels or not one.role.startswith("command.")]

    decided = _said_of(tables, said)
    columns = guessed_now()
    problem = _problem(tables, columns)
    if problem and sys.stdin.isatty() and sys.stdout.isatty():
        print(f"{source}: {problem}\nGuessed:")
        for one in columns:
            print(f"  {one}" + (f"   ({one.why})" if one.why else ""))
        print("Columns:", ", ".join(f"{table.stem}/{name}" for table in tables for name in table.columns))
        answer = input("Enter takes this; or type what differs, as ROLE=COLUMN:UNIT ROLE=COLUMN:UNIT ...\n> ")
        decided = _said_of(tables, [*said, *answer.split()])
        columns = [replace(one, why="", sure=True, assumed=False) for one in guessed_now()]
        problem, said = _problem(tables, columns), [str(one) for one in columns]
    if problem:
        names = [f"{table.stem}/{name}" for table in tables for name in (*table.columns, *table.texts)]
        listed = ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")
        guessed = " ".join(f"'{one}'" for one in columns) or "nothing"
        raise ValueError(f"{source}: {problem} Its columns are {listed}; guessed: {guessed}. Give --columns with what "
                         "differs and what is missing, each as ROLE=COLUMN:UNIT; see docs/sysid_tools.md.")
    return columns, list(said)


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
        texts = next(table.texts for table in tables if table.stem == timeless[0])
        said = next((f" Its {name} holds {shown(cell)}, which is no time that is known: write seconds, or "
                     "YYYY-MM-DD HH:MM:SS.SSS." for name, cell in texts.items()
                     if set(re.split("[^a-z]+", name.lower())) & set(TIME_WORDS)), "")
        table = next(table for table in tables if table.stem == timeless[0])
        said = said or next((f" If its {name} counts rows, say how many there are in a second: time={table.stem}/{name}"
                             ":100hz." for name in table.columns if COUNTS.search(name)), "")
        return f"no column of {timeless[0]} is surely its time.{said}"
    arrays = {(table.stem, name): values for table in tables for name, values in table.columns.items()}
    for one in columns:
        values = arrays[one.file, one.name]
        if one.role == "time" and one.file in used and np.nanmin(values) == np.nanmax(values):
            return f"time stands still in {one.file}/{one.name}."
    commands = _has(roles, "command", "v") or _has(roles, "command", "left", "right")
    if not commands and (found := [one for one in columns if one.role.startswith("command.")]):
        return (f"{found[0].file}/{found[0].name} is the only part of a command: v and omega, or left and right belong "
                "to it.")
    inputs = _has(roles, "command", "v", "omega") or _has(roles, "command", "left", "right") or _wheels(roles)
    measured = _has(roles, "ground_truth", "x", "y") or _has(roles, "odometry", "v", "omega") or _has(
        roles, "odometry", "x", "y")
    if not inputs and not measured:
        return "no column is surely a command, a wheel speed or a pose."
    if {"odometry.v", "odometry.omega"} & roles and not _has(roles, "odometry", "x", "y") and not _has(
            roles, "odometry", "v", "omega"):
        return "the odometry has only one of v and omega."
    if not inputs and not _has(roles, "odometry", "v", "omega"):
        return "there are neither commands (v, omega) nor wheel speeds."
    if not commands and not _has(roles, "ground_truth", "x", "y"):
        return "there are measured speeds, and neither commands nor an outside pose to compare them with."
    if not measured and not (_wheels(roles) and commands):
        return "there is neither odometry (v, omega or x, y, yaw) nor an outside pose."
    if unsure := [one for one in columns if not one.sure]:
        ticks = next((f" If it counts ticks, say how many make a turn: {one.role}={one.file}/{one.name}:N/rev."
                      for one in unsure if TICKS.search(one.name)), "")
        return f"it is not clear what {', '.join(f'{one.file}/{one.name}' for one in unsure)} " + (
            "is." if len(unsure) == 1 else "are.") + ticks
    return ""


def _has(roles: set[str], stream: str, *quantities: str) -> bool:
    return all(f"{stream}.{one}" in roles for one in quantities)


def _wheels(roles: set[str]) -> bool:
    return _has(roles, "wheels", "left", "right") or _has(roles, "wheels", "left_angle", "right_angle")


def _join(name: str, source: Path, tables: Sequence[Table], columns: Sequence[Column],
          geometry: tuple[float, float]) -> TextDrive:
    """The streams of one drive on one clock."""
    notes = [f"{table.stem}: {table.odd[one.name]}" for table in tables for one in columns
             if one.file == table.stem and one.name in table.odd]
    streams: dict[str, dict[str, np.ndarray]] = {}
    for stream in QUANTITIES:
        found, said = _stream(stream, tables, columns)
        if found and not any(set(one) <= set(found) for one in LEAST_OF[stream]):
            parts = " and ".join(f"{stream}.{one}" for one in LEAST_OF[stream][0])
            said = [f"{stream}: only {', '.join(sorted(set(found) - {'t'}))} of {parts}: left out"]
        elif found:
            streams[stream] = found
        notes += said
    made: dict[str, np.ndarray] = {}
    if "command" in streams:
        made["command"] = _as_twist(streams["command"], columns, "command", geometry)
    wheels = _as_twist(_with_rates(streams["wheels"]), columns, "wheels", geometry) if "wheels" in streams else None
    if wheels is not None and "command" in made and (backwards := _backwards(made["command"], wheels)):
        one = next(one for one in columns if one.role.startswith(f"wheels.{backwards}"))
        turned = replace(one, sign=-one.sign, unit="" if one.why else one.unit)  # a unit guessed from it may be wrong
        raise ValueError(f"{source}: {one.file}/{one.name}: the {backwards} wheel counts backwards: the two differ "
                         f"where the vehicle is sent straight ahead. Turn its sign: --columns {turned}")
    odometry = streams.get("odometry")
    if odometry is not None:
        made["odometry"], note = _as_odometry(odometry, wheels)
        notes += [note] if note else []
    elif wheels is not None and "command" in made:
        made["odometry"] = _dead_reckoned(wheels)
        notes.append("odometry is dead reckoned from the wheel speeds")
    measured_input = "command" not in made
    if measured_input:
        rates = wheels if wheels is not None else made["odometry"][:, [0, 4, 5]]
        made["command"] = rates
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
    used = {(one.file, one.name) for one in columns}
    unused = [f"{table.stem}/{one}" for table in tables for one, values in table.columns.items()
              if (table.stem, one) not in used and np.nanmin(values) < np.nanmax(values)]
    if unused:
        notes.append(f"not used: {', '.join(unused[:NAMED])}{', ...' if len(unused) > NAMED else ''}")
    notes = list(dict.fromkeys(note.removeprefix(f"{name}: ") for note in notes))
    return TextDrive(name, made, tuple(columns), tuple(notes), measured_input)


def _stream(
    stream: str, tables: Sequence[Table], columns: Sequence[Column]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Rows of a stream in SI units in order of time, by quantity and "t", without those with an empty cell; notes."""
    mine = [one for one in columns if one.role.startswith(f"{stream}.")]
    if not mine:
        return {}, []
    files = {one.file for one in mine}
    file = max(files, key=lambda name: sum(one.file == name for one in mine))  # a stream is in one file
    mine = [one for one in mine if one.file == file]
    table = next(one for one in tables if one.stem == file)
    clock = next(one for one in columns if one.role == "time" and one.file == file)
    found = {"t": clock.in_si(table.columns[clock.name])}
    for one in mine:
        found[one.role.partition(".")[2]] = one.in_si(table.columns[one.name])
    whole = np.isfinite(list(found.values())).all(axis=0)
    found = {key: values[whole] for key, values in found.items()}
    notes = _check_clock(file, found["t"])
    order = np.argsort(found["t"], kind="stable")
    if (spread := _spread(found["t"][order])) is not None:
        step = float(np.median(np.diff(np.unique(found["t"]))))
        found["t"][order] = spread
        notes.append(f"{file}: its time is rounded to {step:.3g} s: rows of {stream} at one time are spread evenly "
                     "until the next")
    later = np.diff(found["t"][order], prepend=-np.inf) > 1e-6
    found = {key: values[order][later] for key, values in found.items()}
    if len(found["t"]) < 2:
        raise ValueError(f"{file}: {stream} needs at least 2 rows without an empty cell, at two times, and has "
                         f"{len(found['t'])}.")
    if not later.all():
        rounded = ": is its time rounded, as to whole seconds?" if later.mean() < 0.5 else ""
        notes.append(f"{file}: {counted(int((~later).sum()), 'row')} of {len(later)} of {stream} at the time of the "
                     f"row before left out{rounded}")
    if {"qz", "qw"} <= set(found):
        from sysid.logs.rosbag import yaw_of

        level = np.zeros(len(found["t"]))  # of a vehicle on a floor qx and qy are often left out
        if "qx" in found and np.mean(found["qx"] ** 2 + found.get("qy", level) ** 2) > ONE_SIDE:
            notes.append(f"{file}: by its quaternion the vehicle lies on its side in {stream}: its columns may be in "
                         "the order w, x, y, z. Say which is which with --columns")
        found["yaw"] = np.array([yaw_of(*one) for one in zip(
            found["qw"], found.get("qx", level), found.get("qy", level), found["qz"], strict=True)])
    if "yaw" in found:
        found["yaw"] = np.unwrap(found["yaw"])
    return found, notes


def _spread(t: np.ndarray) -> np.ndarray | None:
    """Times (T,) of rows that came evenly, from times rounded down to a coarser step; None where they were not."""
    first = np.flatnonzero(np.diff(t, prepend=-np.inf) > 1e-6)
    if len(first) < 3 or len(first) > len(t) / 2:
        return None
    stamps, steps = t[first], np.diff(t[first])
    step = float(np.median(steps))
    if (np.abs(steps - step) > 1e-3 * step).any() or (np.abs(stamps / step - np.round(stamps / step)) > 1e-3).any():
        return None
    apart = step / float(np.median(np.diff(first)))
    rows = np.arange(len(t))
    spread = np.interp(rows, first, stamps)
    before, after = rows < first[1], rows > first[-1]
    spread[before] = stamps[1] - apart * (first[1] - rows[before])
    spread[after] = stamps[-1] + np.minimum(apart * (rows[after] - first[-1]), step * (1 - 1e-6))
    return spread


def _check_clock(file: str, t: np.ndarray) -> list[str]:
    """Notes on a stream's time (T,); ValueError where it goes back by more than rows out of order do."""
    steps = np.diff(t)
    if (steps < 0).sum() > len(steps) / 2:
        return [f"{file}: its newest row comes first; its rows are turned round"]
    least = max(BACK[0] * float(np.median(np.abs(steps))), BACK[1])
    if len(back := np.flatnonzero(steps < -least)):
        k = int(back[0])
        raise ValueError(f"{file}: its time goes back by {-steps[k]:.2f} s after row {k + 1} ({t[k] - t[0]:.1f} s into "
                         "it): the clock was set back, or the recording began again. Cut the file there.")
    late = int((steps < 0).sum())
    return [f"{file}: {counted(late, 'row')} out of order, sorted by time"] if late else []


def _with_rates(wheels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Wheel speeds, from angles where only these were measured."""
    if "left" in wheels:
        return wheels
    t = wheels["t"]
    return {"t": t, **{side: np.gradient(np.unwrap(wheels[f"{side}_angle"]), t) for side in ("left", "right")}}


def _as_twist(rates: dict[str, np.ndarray], columns: Sequence[Column], stream: str,
              geometry: tuple[float, float]) -> np.ndarray:
    """(T, 3) of t, v and omega of a command, or of the speeds of two wheels."""
    if "left" not in rates:
        return np.column_stack([rates["t"], rates["v"], rates.get("omega", 0 * rates["t"])])
    of_rims = {one.role for one in columns if one.unit in UNITS["speed"]}
    left, right = (rates[side] * (1.0 if f"{stream}.{side}" in of_rims else geometry[0]) for side in ("left", "right"))
    return np.column_stack([rates["t"], (left + right) / 2, (right - left) / geometry[1]])


def _backwards(command: np.ndarray, wheels: np.ndarray) -> str:
    """The wheel, "left" or "right", whose difference from the other one follows the commanded speed as their mean
    should; empty where it is not so. Rows (T, 3) of t, v and omega."""
    held = np.searchsorted(command[:, 0], wheels[:, 0] - RESPONSE, side="right") - 1
    sent = np.where(held >= 0, command[np.maximum(held, 0), 1], 0.0)
    if sent.std() < VARIED or min(wheels[:, 1].std(), wheels[:, 2].std()) == 0.0:  # their unit may be another
        return ""
    mean, difference = (float(np.corrcoef(sent, wheels[:, k])[0, 1]) for k in (1, 2))
    if abs(difference) < FOLLOWED or abs(mean) > UNFOLLOWED:
        return ""
    return "left" if difference > 0 else "right"


def _as_odometry(odometry: dict[str, np.ndarray], wheels: np.ndarray | None) -> tuple[np.ndarray, str]:
    """(T, 6) rows of an odometry, and a note on what was computed."""
    t = odometry["t"]
    note = ""
    if not {"x", "y", "yaw"} <= set(odometry):
        if not {"v", "omega"} <= set(odometry):
            raise ValueError("the odometry has no heading. Name its yaw or its quaternion with --columns.")
        return _dead_reckoned(np.column_stack([t, odometry["v"], odometry["omega"]])), (
            f"the odometry has {'no heading' if 'x' in odometry else 'speeds only'}: its pose is dead reckoned from "
            "its speeds")
    x, y, yaw = odometry["x"], odometry["y"], odometry["yaw"]
    if {"v", "omega"} <= set(odometry):
        v, omega = odometry["v"], odometry["omega"]
    elif wheels is not None:
        v, omega = (np.interp(t, wheels[:, 0], wheels[:, k]) for k in (1, 2))
    else:
        v, omega = pose_speeds(t, x, y, yaw)
        note = f"the odometry has poses only: v and omega are their differences over {DIFFERENCED:g} s"
    return np.column_stack([t, x, y, yaw, v, omega]), note


def _dead_reckoned(rates: np.ndarray) -> np.ndarray:
    """(T, 6) odometry of speeds (T, 3)."""
    return np.column_stack([rates[:, 0], *integrate_speeds(*rates.T), rates[:, 1:]])
