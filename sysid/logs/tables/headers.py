"""Names of the columns of a text file: above it, in comments, in several lines, or nowhere."""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sysid.logs.tables.cells import are_numbers, number_of
from sysid.logs.tables.columns import TUM, unit_named
from sysid.logs.tables.names import with_unit

ONE_SIDE = 0.5  # of the squares of qx and qy of a vehicle that lies on its side
NUMBERED = re.compile(r"(\d+(?:(?:[\s,]+|\s*\.\.\s*)\d+)*)[\s:.)]+([^\W\d].*)")
"""A comment that gives columns names by their numbers, as loggers for MATLAB write it."""
PREAMBLE = 30  # lines above the names


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


def without_preamble(path: Path, data: list[tuple[int, str]], split: str | None) -> list[tuple[int, str]]:
    """Lines from the first that has as many cells as most: above it a logger may say who it is. ValueError where the
    names above it are more or fewer."""
    counts = [len(cells_of(line, split)) for _, line in data]
    usual = Counter(counts).most_common(1)[0][0]
    first = counts.index(usual)
    if not 0 < first <= PREAMBLE:
        return data
    names, row = cells_of(data[first - 1][1], split), cells_of(data[first][1], split)
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
    first = next((k for k, row in enumerate(rows) if 2 * sum(map(are_numbers, [[one] for one in row if one]))
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
