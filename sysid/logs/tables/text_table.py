"""A text file as a table of numbers."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sysid.logs.tables.cells import are_numbers, numbers_of, without_separators
from sysid.logs.tables.columns import TUM, Table, unit_named
from sysid.logs.tables.headers import (
    PREAMBLE,
    cells_of,
    numbered_names,
    stacked_names,
    tum_names,
    without_preamble,
)  # fmt: skip
from sysid.logs.tables.names import with_unit
from whill_mjx.io.fields import counted, shown
from whill_mjx.io.reading import CSV_BYTES, read_text

SUFFIXES = (".csv", ".txt", ".tsv", ".tum")
LEAST = 10  # rows of a stream
LONGEST_NAME = 200  # characters
MISSING = ("", "nan", "na", "n/a", "null", "none", "-", "--")  # cells of samples that are missing


def text_files(source: Path) -> list[list[Path]]:
    """The text files of each drive at a path: a file, a folder of them, or a folder of such folders."""
    if source.is_file():
        return [[source]] if source.suffix.lower() in SUFFIXES else []
    files = _texts(source)
    if not files:
        return [found for folder in sorted(source.iterdir()) if folder.is_dir() and (found := _texts(folder))]
    return [files]


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
    data = without_preamble(path, data, split)
    if stacked := stacked_names([cells_of(line, split) for _, line in data[:PREAMBLE]]):
        header, data = stacked[0], data[stacked[1] :]
    elif numbered := numbered_names(comments, cells_of(data[0][1], split)):
        header = numbered
    elif comments and path.read_bytes()[:1] == b"%" and (
            len(cells_of(comments[0], split)) == len(cells_of(data[0][1], split))):
        header = cells_of(comments[0], split)  # of `rostopic echo -p`
    elif not are_numbers([cell.replace(",", ".") for cell in cells_of(data[0][1], split)]):
        header, data = cells_of(data[0][1], split), data[1:]
    elif comments and len(cells_of(comments[-1], split)) == len(cells_of(data[0][1], split)):
        header = cells_of(comments[-1], split)
    rows = [cells_of(line, split) for _, line in data]
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
        if name in numbers and not np.array_equal(numbers[name], values, equal_nan=True):
            raise ValueError(f"{path}: two columns are named {shown(name)} and differ. Give each its own name.")
        numbers[name] = values
        wrong = [int(k) for k in np.flatnonzero(~known) if cells[k].lower() not in MISSING]
        if wrong:
            odd[name] = (f"{counted(len(wrong), 'cell')} of {name} {'is no number' if len(wrong) == 1 else 'are none'} "
                         f"({shown(cells[wrong[0]])} in line {lines[wrong[0]]}): left out")
    return Table(path.stem, _with_whole_stamps(numbers), odd, texts)


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
