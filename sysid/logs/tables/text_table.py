"""A text file as a table of numbers: the names of its columns, wherever they stand, and the numbers in its cells.

Names are above the numbers, in comments, in several lines, or nowhere. Cells may have decimal commas, separators of
thousands, dates and times of day.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sysid.logs.tables.columns import TUM, Table, unit_named
from sysid.logs.tables.names import with_unit
from whill_mjx.io.fields import counted, shown
from whill_mjx.io.reading import CSV_BYTES, read_text

SUFFIXES = (".csv", ".txt", ".tsv", ".tum")
LEAST = 10  # rows of a stream
LONGEST_NAME = 200  # characters
MISSING = ("", "nan", "na", "n/a", "null", "none", "-", "--")  # cells of samples that are missing
ONE_SIDE = 0.5  # of the squares of qx and qy of a vehicle that lies on its side
NUMBERED = re.compile(r"(\d+(?:(?:[\s,]+|\s*\.\.\s*)\d+)*)[\s:.)]+([^\W\d].*)")
"""A comment that gives columns names by their numbers, as loggers for MATLAB write it."""
PREAMBLE = 30  # lines above the names
OVERFLOWS = (2.0**16, 2.0**16 / 1e3, 2.0**32, 2.0**32 / 1e3, 2.0**32 / 1e6, 2.0**32 / 1e9)
"""Where counters of 16 and 32 bits begin anew; also those of ms, us and ns that are written in seconds."""
HOUR = 3600.0  # s
DAY = 86400.0  # s
DATE = re.compile(r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})[ T/,-]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,:](\d+))?)?"
                  r" *([AaPp][Mm])?")
"""A date and a time of day, as spreadsheets, MATLAB and `rostopic echo -p` write them."""


def text_files(source: Path) -> list[list[Path]]:
    """The text files of each drive at a path: a file, a folder of them, or a folder of such folders."""
    if source.is_file():
        return [[source]] if source.suffix.lower() in SUFFIXES else []
    files = _texts(source)
    if not files:
        return [found for folder in sorted(source.iterdir()) if folder.is_dir() and (found := _texts(folder))]
    return [files]


def unreadable(source: Path) -> list[Path]:
    """What has the name of a text file in a folder and is neither a file nor a folder."""
    inside = sorted(source.iterdir()) if source.is_dir() else []
    return [path for path in inside if path.suffix.lower() in SUFFIXES and not path.is_file() and not path.is_dir()]


def read_table(path: Path) -> Table:
    """The numbers of a text file by column; comments and blank lines are left out, empty cells are nan."""
    text = read_text(path, CSV_BYTES, "no such file.")
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    plain = [(number, line) for number, line in lines if not line.lstrip().startswith(("#", "%"))]
    if not plain:
        raise ValueError(f"{path}: no rows. Give a table of numbers with a line of names.")
    split = next((one for one in ("\t", ";", ",") if one in plain[len(plain) // 2][1]), None)  # None: spaces
    comments = [line.lstrip("#% \t") for _, line in lines if line.lstrip().startswith(("#", "%"))]
    named = [cells_of(line, split) for line in comments]
    data = without_preamble(path, [(number, cells_of(line, split)) for number, line in plain], split)
    header: list[str] | None = None
    first = data[0][1]
    if stacked := stacked_names([cells for _, cells in data[:PREAMBLE]]):
        header, data = stacked[0], data[stacked[1] :]
    elif numbered := numbered_names(comments, first):
        header = numbered
    elif comments and path.read_bytes()[:1] == b"%" and len(named[0]) == len(first):
        header = named[0]  # of `rostopic echo -p`
    elif not are_numbers([cell.replace(",", ".") for cell in first]):
        header, data = first, data[1:]
    elif comments and len(named[-1]) == len(first):
        header = named[-1]
    rows = [cells for _, cells in data]
    width = len(rows[0] if header is None else header)
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
        header = tum_names(rows) if width == len(TUM) else [f"column{k + 1}" for k in range(width)]
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
        values = numbers_of(cells := without_separators(cells))
        known = np.isfinite(values)
        if known.sum() < 3 or not name:
            texts |= {name: cells[0]} if name and any(cells) else {}
            continue
        if (turn := overflow_of(values)) is not None:
            values = without_overflows(values, turn)
            odd[name] = f"{name} counts to {turn:.7g} and begins anew: it is counted on"
        if name in numbers and not np.array_equal(numbers[name], values, equal_nan=True):
            raise ValueError(f"{path}: two columns are named {shown(name)} and differ. Give each its own name.")
        numbers[name] = values
        wrong = [int(k) for k in np.flatnonzero(~known) if cells[k].lower() not in MISSING]
        if wrong:
            left = (f"{counted(len(wrong), 'cell')} of {name} {'is no number' if len(wrong) == 1 else 'are none'} "
                    f"({shown(cells[wrong[0]])} in line {lines[wrong[0]]}): left out")
            odd[name] = "; ".join([odd[name], left] if name in odd else [left])
    return Table(path.stem, _with_whole_stamps(numbers), odd, texts)


def overflow_of(values: np.ndarray) -> float | None:
    """Where a counter (T,) that only goes forward overflows, as a microcontroller's clock of 16 or 32 bits does.

    Each step back must be one step forward as the others are, once the overflow is added. None where it goes back
    otherwise, as a clock that was set back does, or never.
    """
    known = values[np.isfinite(values)]
    steps = np.diff(known)
    back, ahead = steps[steps < 0], steps[steps > 0]
    if not len(back) or len(back) > len(ahead) / 2 or known.min() < 0:
        return None
    for turn in OVERFLOWS:
        over = back + turn
        if known.max() < turn and ahead.min() / 2 <= over.min() and over.max() <= 2 * ahead.max() < turn / 2:
            return turn
    return None


def without_overflows(values: np.ndarray, turn: float) -> np.ndarray:
    """The counter (T,) that goes on instead of beginning anew; nan where it was."""
    known = np.isfinite(values)
    counted_on = values.copy()
    counted_on[known] += turn * np.cumsum(np.diff(values[known], prepend=values[known][:1]) < 0)
    return counted_on


def _texts(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()
                  and not path.name.lower().startswith(("readme", "license", ".")))


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


def tum_names(rows: Sequence[Sequence[str]]) -> list[str]:
    """Names of the columns of a trajectory in TUM's form. Some programs write w of the quaternion first, which shows
    where a vehicle would lie on its side otherwise."""
    parts = np.array([[number_of(cell) for cell in row[4:]] for row in rows])
    last, first = (float(np.nanmean((parts[:, k : k + 2] ** 2).sum(1))) for k in (0, 1))
    return [*TUM[:4], "qw", "qx", "qy", "qz"] if first < ONE_SIDE / 10 < ONE_SIDE < last else list(TUM)


def cells_of(line: str, split: str | None) -> list[str]:
    if '"' in line and split:  # a cell in quotes may hold the separator
        found = next(csv.reader([line], delimiter=split, skipinitialspace=True))
    else:
        found = line.split(split)
    return [cell.strip().strip('"').strip() for cell in found]


def without_preamble(
    path: Path, data: list[tuple[int, list[str]]], split: str | None
) -> list[tuple[int, list[str]]]:
    """Lines from the first that has as many cells as most: above it a logger may say who it is. ValueError where the
    names above it are more or fewer."""
    counts = [len(cells) for _, cells in data]
    usual = Counter(counts).most_common(1)[0][0]
    first = counts.index(usual)
    if not 0 < first <= PREAMBLE:
        return data
    names, row = data[first - 1][1], data[first][1]
    texts = all(names) and not any(are_numbers([one]) for one in names)
    if texts and are_numbers(row) and 1 < len(names) and usual <= 2 * len(names):
        if not any(row[len(names) :]) and len(row) > len(names):
            return data[first - 1 :]
        cause = " Are there decimal commas in it? Write decimals with a point, or part the cells by semicolons." if (
            split == "," and usual > len(names)) else " Save it again."
        raise ValueError(f"{path}, line {data[first][0]}: has {usual} cells, the names above it {len(names)}.{cause}")
    return data[first:]


def stacked_names(rows: Sequence[Sequence[str]]) -> tuple[list[str], int] | None:
    """Names of columns above which, or below which, further lines of words stand, and how many lines that are; None
    where one line has the names. Motion-capture programs write a body, a quantity and an axis in a line each."""
    filled = [[one for one in row if one] for row in rows]
    first = next((k for k, row in enumerate(filled) if 2 * sum(are_numbers([one]) for one in row) > len(row)), 0)
    units = first > 1 and bool(filled[first - 1]) and all(map(unit_named, filled[first - 1]))
    last = first - 1 - units
    whole = all(rows[0]) and len(set(rows[0])) == len(rows[0])  # names enough: what follows are cells without a value
    if last < 1 or whole or len({len(row) for row in rows[: first + 1]}) > 1:
        return None
    names, above = list(rows[last]), rows[last - 1]
    if len(set(names)) < len(names):
        names = [f"{over} {name}".strip() for over, name in zip(above, names, strict=True)]
    names = [name or over for name, over in zip(names, above, strict=True)]
    return [with_unit(name, unit) for name, unit in zip(names, rows[first - 1], strict=True)] if units else names, first


def numbered_names(comments: Sequence[str], row: Sequence[str]) -> list[str] | None:
    """Names that comments give to columns by their numbers, as `% 2,3 Velocity left, right (m/s)`, counted from 0 or 1;
    None where no two lines do so, or where they number more columns than a row of numbers has."""
    if not are_numbers(row):
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


def without_separators(cells: Sequence[str]) -> list[str]:
    """The cells of a column with decimal points, and without the separators of thousands that some of them show."""
    cells = [_signed(cell) for cell in cells]
    if any(re.fullmatch(r"[-+]?\d{1,3}(\.\d{3})+,\d+|[-+]?\d{1,3}(\.\d{3}){2,}", cell) for cell in cells):
        cells = [cell.replace(".", "") for cell in cells]
    if any(re.fullmatch(r"[-+]?\d{1,3}(,\d{3})+\.\d+|[-+]?\d{1,3}(,\d{3}){2,}", cell) for cell in cells):
        return [cell.replace(",", "") for cell in cells]
    return [cell.replace(",", ".") if re.fullmatch(r"[-+]?\d*,\d*([eE][-+]?\d+)?", cell) else cell for cell in cells]


def numbers_of(cells: Sequence[str]) -> np.ndarray:
    """Numbers of cells (T,), nan where a cell is none; of dates and times of day, seconds."""
    values = np.array([number_of(cell) for cell in cells])
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


def _signed(cell: str) -> str:
    """A number with a hyphen for its sign: spreadsheets write a minus sign or a dash, bookkeepers parentheses."""
    if cell.isascii() and cell[:1] != "(":
        return cell
    cell = cell.replace("\u2212", "-")
    if cell[:1] == "\u2013":
        return f"-{cell[1:].lstrip()}"
    return f"-{match[1]}" if (match := re.fullmatch(r"\(\s*(\d[\d.,]*([eE]-?\d+)?)\s*\)", cell)) else cell


def number_of(cell: str) -> float:
    cell = _signed(cell)
    try:
        return float("nan" if "_" in cell else cell)  # 1_0 is a number in Python alone
    except ValueError:
        return float("nan")


def are_numbers(cells: Sequence[str]) -> bool:
    return all(not cell or np.isfinite(number_of(cell)) or cell.lower() in ("nan", "inf") for cell in cells)
