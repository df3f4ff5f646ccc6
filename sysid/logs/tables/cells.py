"""Numbers in the cells of a text file: decimal commas, separators of thousands, dates and times of day."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

HOUR = 3600.0  # s
DAY = 86400.0  # s
DATE = re.compile(r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})[ T/,-]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,:](\d+))?)?"
                  r" *([AaPp][Mm])?")
"""A date and a time of day, as spreadsheets, MATLAB and `rostopic echo -p` write them."""


def without_separators(cells: Sequence[str]) -> list[str]:
    """The cells of a column with decimal points, and without the separators of thousands that some of them show."""
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


def number_of(cell: str) -> float:
    try:
        return float("nan" if "_" in cell else cell)  # 1_0 is a number in Python alone
    except ValueError:
        return float("nan")


def are_numbers(cells: Sequence[str]) -> bool:
    return all(not cell or np.isfinite(number_of(cell)) or cell.lower() in ("nan", "inf") for cell in cells)
