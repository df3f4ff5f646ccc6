"""A table of numbers, and what one of its columns holds: a role, and a unit with its size in SI."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

STREAMS = ("command", "odometry", "ground_truth", "wheels")
QUANTITIES = {
    "command": ("v", "omega", "left", "right"), "odometry": ("x", "y", "yaw", "qx", "qy", "qz", "qw", "v", "omega"),
    "ground_truth": ("x", "y", "yaw", "qx", "qy", "qz", "qw"),
    "wheels": ("left", "right", "left_angle", "right_angle"),
}
ROLES = ("time", *(f"{stream}.{one}" for stream in STREAMS for one in QUANTITIES[stream]))
UNITS = {  # kind -> unit -> SI
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "in": 0.0254},
    "angle": {"rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "rev": 2 * np.pi},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "mm/s": 1e-3, "cm/s": 1e-2, "mph": 0.44704, "ft/s": 0.3048},
    "rate": {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3, "rpm": 2 * np.pi / 60},
    "none": {"-": 1.0},
}
RARE = {
    "length": {"yd": 0.9144, "dm": 0.1}, "angle": {"gon": np.pi / 200},
    "speed": {"kn": 1852 / 3600, "m/min": 1 / 60, "ft/min": 0.3048 / 60, "in/s": 0.0254, "dm/s": 0.1},
    "rate": {"rev/s": 2 * np.pi, "rad/min": 1 / 60, "deg/min": np.pi / 180 / 60, "gon/s": np.pi / 200},
}  # fmt: skip
"""Units that count where they are written; numbers alone show none of them."""
SPELLED = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "usec": "us", "micros": "us", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanoseconds": "ns", "nanos": "ns",
    "degree": "deg", "degrees": "deg", "radians": "rad", "radian": "rad", "mps": "m/s", "ms-1": "m/s", "kmh": "km/h",
    "kph": "km/h", "kmph": "km/h", "mmps": "mm/s", "cmps": "cm/s", "radps": "rad/s", "rads": "rad/s", "dps": "deg/s",
    "degps": "deg/s", "degs": "deg/s", "meter": "m", "meters": "m", "metre": "m", "metres": "m", "m s": "m/s",
    "mins": "min", "minute": "min", "minutes": "min", "hour": "h", "hours": "h", "hrs": "h", "day": "d", "days": "d",
    "km h": "km/h", "mm s": "mm/s", "cm s": "cm/s", "rad s": "rad/s", "deg s": "deg/s", "°": "deg", "°/s": "deg/s",
    "feet": "ft", "foot": "ft", "feet/s": "ft/s", "fps": "ft/s", "feet/min": "ft/min", "inch": "in", "inches": "in",
    "inches/s": "in/s", "yard": "yd", "yards": "yd", "knot": "kn", "knots": "kn", "kt": "kn", "kts": "kn",
    "mi/h": "mph", "miles/h": "mph", "meters/s": "m/s", "metres/s": "m/s", "gons": "gon", "turn": "rev",
    "turns": "rev", "revs": "rev", "rps": "rev/s",
    "rev/min": "rpm", "r/min": "rpm", "u/min": "rpm", "1/min": "rpm", "radians/s": "rad/s", "degrees/s": "deg/s",
}
PER_TURN = re.compile(r"(\d+(?:\.\d+)?)/rev")  # A unit of ticks: so many in a turn
PER_SECOND = re.compile(r"(\d+(?:\.\d+)?) ?hz")  # A unit of rows: so many in a second
TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")  # columns of a trajectory in TUM's form
SAID = "as said"  # why a column has its role where somebody gave no unit


@dataclass(frozen=True)
class Column:
    role: str
    file: str  # stem of the file
    name: str
    unit: str
    why: str  # how role and unit were found; empty where somebody said both
    sure: bool = True
    assumed: bool = False  # whether neither name nor numbers show the unit, so that it is the usual one
    moves: bool = True  # whether its numbers change by what a moving vehicle would have in this unit
    sign: float = 1.0  # -1 where it counts the other way round

    def __str__(self) -> str:
        return f"{self.role}={self.file}/{self.name}:{'-' if self.sign < 0 else ''}{self.unit}"

    @property
    def guessed(self) -> bool:
        """Whether nobody said which role it has."""
        return bool(self.why) and not self.why.startswith(SAID)

    def in_si(self, values: np.ndarray) -> np.ndarray:
        """Its numbers (T,) in SI units."""
        return np.asarray(values * (self.sign * size_of(self.role, self.unit)))


@dataclass(frozen=True)
class Table:
    """One text file of numbers; nan where a cell is empty."""

    stem: str
    columns: dict[str, np.ndarray]  # name -> (T,)
    odd: Mapping[str, str] = field(default_factory=dict)  # name of a column -> note on its cells that are no numbers
    texts: Mapping[str, str] = field(default_factory=dict)  # name of a column without numbers -> its first cell


def kind_of(role: str) -> str:
    """What a role measures: a key of UNITS."""
    quantity = role.rpartition(".")[2]
    if quantity in ("qx", "qy", "qz", "qw"):
        return "none"
    return {"time": "time", "x": "length", "y": "length", "yaw": "angle", "v": "speed", "left": "rate", "right": "rate",
            "left_angle": "angle", "right_angle": "angle"}.get(quantity, "rate")


def units_of(role: str) -> dict[str, float]:
    """The units of a role that have a name, and their sizes in SI units; a wheel's speed may be that of its rim."""
    wheel = role.rpartition(".")[2] in ("left", "right")
    kinds = ("speed", "rate") if wheel else (kind_of(role),)
    return {unit: size for kind in kinds for unit, size in (UNITS[kind] | RARE.get(kind, {})).items()}


def size_of(role: str, unit: str) -> float:
    """Size of a unit of a role in SI units; KeyError for one that is not known."""
    if kind_of(role) == "angle" and (turn := PER_TURN.fullmatch(unit)):
        return 2 * np.pi / float(turn[1])
    if role == "time" and (often := PER_SECOND.fullmatch(unit)):
        return 1 / float(often[1])
    return units_of(role)[unit]


def is_unit_of(role: str, unit: str) -> bool:
    try:
        return size_of(role, unit) > 0
    except (KeyError, ZeroDivisionError):
        return False


def unit_of(text: str) -> str:
    text = re.sub(r"/ ?sec(onds?)?$", "/s", text.strip().lower().replace("²", "2"))
    return SPELLED.get(text, text)


def unit_named(text: str) -> bool:
    """Whether a text is the name of a unit."""
    return any(unit_of(text.strip("[]()")) in units for units in (*UNITS.values(), *RARE.values()))
