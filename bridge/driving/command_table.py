"""Commands over time from a file: read, limited, and checked against the floor before anything moves; pure."""

import csv
import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bridge.nodes.exits import OptionError

STANDSTILL = 1.0
"""Seconds of standstill that a recorded drive needs before and after its motion."""
PERIOD = 0.05
"""Seconds between two commands."""
LONGEST = 600.0
"""Seconds that a manoeuvre may last."""
LARGEST = 5_000_000
"""Bytes of a command file: LONGEST at 100 Hz has 2 MB."""
REACTION = 0.25
"""Seconds in which the vehicle drives on before any stop takes effect."""
COLUMNS = ("t", "v", "omega")


@dataclass(frozen=True)
class CommandTable:
    """Commands on a grid of PERIOD, each in force until the next."""

    v: np.ndarray
    """(N,) m/s."""
    omega: np.ndarray
    """(N,) rad/s."""

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return len(self.v) * PERIOD

    def at(self, elapsed: float) -> tuple[float, float]:
        """Return the command in force a time [s] after the start."""
        row = min(int(elapsed / PERIOD + 1e-9), len(self.v) - 1)
        return float(self.v[row]), float(self.omega[row])


@dataclass(frozen=True)
class Reach:
    """The smallest upright rectangle around everything that the vehicle may touch, seen from its start."""

    ahead: float
    """[m] from the start of the drive-axle centre along its first heading."""
    behind: float
    """[m]"""
    left: float
    """[m]"""
    right: float
    """[m]"""
    speed: float
    """Greatest speed [m/s]."""

    @property
    def length(self) -> float:
        """Floor needed along the first heading [m]."""
        return self.ahead + self.behind

    @property
    def width(self) -> float:
        """Floor needed across it [m]."""
        return self.left + self.right


def read_commands(path: Path) -> np.ndarray:
    """Return the rows (N, 3) of a command file: t [s], v [m/s], omega [rad/s].

    Columns after the third are not looked at.

    Raises:
        ValueError: the file cannot be read, is too large, has other columns, rows longer or shorter than the header,
            or times that do not increase.
    """
    reader = csv.reader(_text(path).splitlines())
    try:
        lines = [(reader.line_num, line) for line in reader if line]
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num}: is no CSV ({error}). Save the table again.") from None
    header = lines[0][1] if lines else []
    if tuple(name.strip() for name in header[:3]) != COLUMNS:
        raise ValueError(f"{path}: begins with {_shown(header) if header else 'nothing'}; it must begin with the "
                         f"columns {','.join(COLUMNS)}. sysid.design and sysid.close_loop write such files.")
    rows: list[list[float]] = []
    for number, line in lines[1:]:
        if len(line) != len(header):
            raise ValueError(f"{path}, line {number}: has {len(line)} cells, the header {len(header)}. Write decimals "
                             "with a point.")
        row = [_number(cell) for cell in line[:3]]
        if not all(math.isfinite(value) for value in row):
            raise ValueError(f"{path}, line {number}: {_shown(line)} is not three finite numbers. Correct it.")
        if rows and row[0] <= rows[-1][0]:
            raise ValueError(f"{path}, line {number}: t goes from {rows[-1][0]:g} to {row[0]:g}; it must increase. "
                             "Sort the rows.")
        rows.append(row)
    if len(rows) < 2:
        raise ValueError(f"{path}: has {'no row' if not rows else 'a single row'} of commands; a manoeuvre has at "
                         "least 2. Give the whole file.")
    if rows[-1][0] - rows[0][0] > LONGEST:
        raise ValueError(f"{path}: lasts {rows[-1][0] - rows[0][0]:g} s; a manoeuvre lasts at most {LONGEST:g} s. "
                         "Split it.")
    return np.array(rows)


def _text(path: Path) -> str:
    """Text of a file of at most LARGEST bytes, with or without a byte-order mark."""
    try:
        if not path.is_file():
            raise ValueError(f"{path}: no such file. Give a CSV file with the columns {','.join(COLUMNS)}.")
        with open(path, "rb") as file:
            content = file.read(LARGEST + 1)
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}. Give a CSV file with the columns {','.join(COLUMNS)}.") from None
    if len(content) > LARGEST:
        raise ValueError(f"{path}: is larger than {LARGEST / 1e6:g} MB; a manoeuvre of {LONGEST:g} s needs less. "
                         "Split it.")
    return text


def _number(cell: str) -> float:
    """The number in a cell, nan where it is none; `1_0` is none, though Python reads it."""
    try:
        return float(cell) if cell.isascii() and "_" not in cell else math.nan
    except ValueError:
        return math.nan


def _shown(cells: list[str]) -> str:
    text = ",".join(cells)
    return ascii(text if len(text) <= 60 else text[:57] + "...")[1:-1]


def make_table(rows: np.ndarray, low: tuple[float, float], high: tuple[float, float], slew: tuple[float, float],
               name: str = "the command file") -> CommandTable:
    """Put commands on the grid, with standstill around them and changes no steeper than the slew limits.

    Args:
        rows: (N, 3) t [s], v [m/s], omega [rad/s].
        low, high: smallest and largest v [m/s], omega [rad/s].
        slew: largest change of v [m/s2], of omega [rad/s2].
        name: what errors call the commands.

    Raises:
        OptionError: a command is beyond the limits: it is refused, not cut, because a cut manoeuvre is another one.
    """
    for column, unit in ((1, "m/s"), (2, "rad/s")):
        values = rows[:, column]
        a, b = low[column - 1], high[column - 1]
        worst = values[np.argmax(np.maximum(values - b, a - values))]
        if not a <= worst <= b:
            raise OptionError(f"{name}: {COLUMNS[column]} {worst:g} {unit} is not within {a:g} to {b:g} {unit}, the "
                              "limits of base and command line. Drive a slower manoeuvre, or widen the limits.")
    times = np.arange(0.0, rows[-1, 0] - rows[0, 0] + PERIOD, PERIOD) + rows[0, 0]
    held = np.searchsorted(rows[:, 0], times + 1e-9, side="right") - 1
    still = np.zeros(round(STANDSTILL / PERIOD))
    columns = []
    for column in (1, 2):
        wanted = np.concatenate([still, rows[held, column]])
        columns.append(_ramped(wanted, slew[column - 1] * PERIOD))
    longest = max(len(one) for one in columns)
    v, omega = (np.concatenate([one, np.zeros(longest - len(one)), still]) for one in columns)
    return CommandTable(v, omega)


def _ramped(wanted: np.ndarray, step: float) -> np.ndarray:
    """Follow the wanted values with changes of at most `step`, and end at zero."""
    out, now = [], 0.0
    for target in itertools.chain(wanted, itertools.repeat(0.0)):
        now += min(max(target - now, -step), step)
        out.append(now)
        if len(out) >= len(wanted) and now == 0.0:
            return np.array(out)
    raise AssertionError("unreachable")


def reach_of(table: CommandTable, radius: float, uncertainty: float) -> Reach:
    """Return the floor that a manoeuvre may need.

    The path is that of a vehicle which does as commanded, once for each corner of speed and yaw rate too large and too
    small by `uncertainty`, and its mirrored drift. Each place is widened by the vehicle's radius, and by what it drives
    on before a stop takes effect.

    Args:
        table: what is driven.
        radius: of the vehicle around its drive-axle centre [m].
        uncertainty: relative error of speed and yaw rate.
    """
    corners = [(1 + a * uncertainty, 1 + b * uncertainty) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    lows, highs = [], []
    for scale_v, scale_omega in corners:
        yaw = np.cumsum(table.omega * scale_omega) * PERIOD
        speed = table.v * scale_v
        heading = np.concatenate([[0.0], yaw[:-1]]) + 0.5 * np.diff(np.concatenate([[0.0], yaw]))
        place = np.cumsum(np.stack([speed * np.cos(heading), speed * np.sin(heading)]), axis=1) * PERIOD
        place = np.concatenate([np.zeros((2, 1)), place], axis=1)
        margin = radius + np.concatenate([[0.0], np.abs(speed)]) * REACTION
        lows.append((place - margin).min(axis=1))
        highs.append((place + margin).max(axis=1))
    (x0, y0), (x1, y1) = np.min(lows, axis=0), np.max(highs, axis=0)
    return Reach(float(x1), float(-x0), float(y1), float(-y0), float(np.abs(table.v).max()))


def check_space(reach: Reach, space: tuple[float, float]) -> str:
    """Return where to put the vehicle on a free floor of length and width [m].

    Raises:
        OptionError: the floor is too small either way round.
    """
    length, width = space
    if reach.length <= length and reach.width <= width:
        along, x, y = "LENGTH", length - reach.length, width - reach.width
    elif reach.length <= width and reach.width <= length:
        along, x, y = "WIDTH", width - reach.length, length - reach.width
    else:
        raise OptionError(f"the manoeuvre needs a floor of {reach.length:.1f} x {reach.width:.1f} m with its margins; "
                          f"{length:g} x {width:g} m are free. Find more room, drive slower, or ask sysid.design for a "
                          "manoeuvre with --space.")
    return (f"Put the drive axle {reach.behind + x / 2:.1f} m from the edge behind it and {reach.left + y / 2:.1f} m "
            f"from the edge on its left, facing along the floor's {along}. The drive needs {reach.length:.1f} x "
            f"{reach.width:.1f} m, margins included, and reaches {reach.speed:.2f} m/s.")
