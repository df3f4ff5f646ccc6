"""Units that numbers show: a speed must be the rate of its pose, a measured speed about the commanded one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.logs.planar import differenced, yaw_of
from sysid.logs.tables.columns import UNITS, Column, is_unit_of, kind_of, size_of, units_of

FASTEST_STEP, SLOWEST_STEP = 5e-4, 4.0  # s; rows that follow faster, or slower, are in another unit of time
SHORTEST = 10.0  # s; a recording that would be shorter is in a larger unit
DATES = (1e9, 1e10)  # s since 1970
SERIAL_DAYS, DAY_STEP = ((2e4, 6e4), (7.2e5, 7.6e5)), 5e-5
"""Ranges of dates that count days, as spreadsheets and MATLAB have them, and the longest step of such a recording."""
TOO_FAST, DOUBTFUL = 50.0, (10.0, 100.0)
"""Speed [m/s] of a pose that often moves faster, so that it is in millimetres; and speeds of one that may as well be in
centimetres, and is asked for."""
RAPID = 2e-3  # s; rows of a recording shorter than SHORTEST that follow faster may be in a larger unit
TOO_SLOW = 0.02  # m/s; a pose that never moves faster shows no unit
TURNED = 0.3  # rad; the same of a heading
FULL_TURN = 0.9  # of it, beyond which the step between two rows is that of a heading that begins anew
ALONG, CLEARER = 0.5, 4.0
"""How well a heading follows the path (1 is exactly), at least, and how many times less well that of another unit."""
STEPPED = 0.5  # s over which a path has a direction
FOLLOWED, SLIPPED = 0.5, 7.0  # correlation of the turns with a yaw rate, and the factor by which they may be another's
ALIKE = 0.25  # relative difference from a unit's size within which numbers agree with it
LARGEST_SI = 4.0  # m/s and rad/s that speeds of a vehicle usually stay below
BUSY = 0.3  # of its usual largest, above which a signal is compared: a vehicle may turn seldom
GAP = 2.0  # s without samples, over which nothing is interpolated
Signal = tuple[np.ndarray, np.ndarray]  # times (T,) [s] and values (T,)


def with_time_unit(column: Column, values: np.ndarray) -> Column:
    if column.unit in UNITS["time"] and not (column.unit == "s" and np.nanmedian(np.abs(values)) > 1e11):
        return column
    known = values[np.isfinite(values)]
    steps = np.diff(np.unique(known))
    step = float(np.median(steps)) if len(steps) else 1.0
    first = float(np.abs(known[0])) if len(known) else 0.0
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):  # since 1970
        if first > least:
            return replace(column, unit=unit, why="it counts since 1970")
    if step < DAY_STEP and any(low < first < high for low, high in SERIAL_DAYS):
        return replace(column, unit="d", why="it counts days")
    span = float(np.ptp(known)) if len(known) else 0.0
    quickest = min(step, span / (len(known) - 1)) if len(known) > 1 else step  # rounded times repeat
    able = [unit for unit in ("s", "ms", "us", "ns") if quickest * UNITS["time"][unit] > FASTEST_STEP
            and (unit == "s" or span * UNITS["time"][unit] >= SHORTEST)]
    usual = [unit for unit in able if step * UNITS["time"][unit] < SLOWEST_STEP]
    since = "s" in usual and DATES[0] < first < DATES[1]
    clear = since or len(usual or able) == 1 and (span >= SHORTEST or step >= RAPID)
    return replace(column, unit=(usual or able or ["s"])[0], why=f"it steps by {step:.3g}", sure=column.sure and clear)


def with_units(found: list[Column], arrays: Mapping[tuple[str, str], np.ndarray]) -> list[Column]:
    """Columns with the units that their numbers agree with, in the order in which one shows the next."""
    drive = _Known({one.role: one for one in found if one.role != "time"},
                   {one.file: one for one in found if one.role == "time"}, arrays)  # fmt: skip
    streams = ("ground_truth", "odometry")
    for stream in streams:
        drive.settle_pose(stream)
    ways = {stream: _way(drive.signal(f"{stream}.x"), drive.signal(f"{stream}.y")) for stream in streams}
    turns = {stream: _rate(*heading) if (heading := drive.heading(stream)) else None for stream in streams}
    drive.settle("odometry.v", _first(ways["odometry"], ways["ground_truth"]), "as the pose moves")
    drive.settle("odometry.omega", _first(turns["odometry"], turns["ground_truth"]), "as the pose turns")
    for role, rates, why in (("v", ways, "as the vehicle moves"), ("omega", turns, "as the vehicle turns")):
        measured = _first(drive.signal(f"odometry.{role}"), rates["odometry"], rates["ground_truth"])
        drive.settle(f"command.{role}", measured, why, 0.5)
    drive.settle_wheels(_first(drive.signal("command.v"), drive.signal("odometry.v"), *ways.values(),
                               drive.raw("command.v")))
    return [one if one.role == "time" else _with_some_unit(drive.columns[one.role], arrays[one.file, one.name])
            for one in found]


def _with_some_unit(one: Column, values: np.ndarray) -> Column:
    """The column, in SI where nothing shows its unit, if that is at all possible."""
    wheel = one.role.rpartition(".")[2] in ("left", "right")
    if is_unit_of(one.role, one.unit):
        return one
    usual = float(np.nanpercentile(np.abs(values), 95)) if np.isfinite(values).any() else 0.0
    largest = 40.0 if wheel else LARGEST_SI if kind_of(one.role) in ("speed", "rate") else np.inf
    return replace(one, unit=next(iter(UNITS[kind_of(one.role)])), why=f"{one.why}; SI assumed",
                   sure=one.sure and usual < largest, assumed=True, moves=usual > 0.05)


@dataclass
class _Known:
    """What is known of the columns of a drive while their units are found."""

    columns: dict[str, Column]  # by role
    clocks: dict[str, Column]  # by file
    arrays: Mapping[tuple[str, str], np.ndarray]

    def signal(self, role: str, unit: str = "") -> Signal | None:
        """Times [s] and values of a role in SI units; None where there are few, or its unit is not known."""
        one = self.columns.get(role)
        clock = self.clocks.get(one.file) if one is not None else None
        if one is None or clock is None or not self._shows(role, unit or one.unit):
            return None
        t = self.arrays[clock.file, clock.name] * size_of("time", clock.unit)
        values = self.arrays[one.file, one.name] * (one.sign * size_of(role, unit or one.unit))
        good = np.flatnonzero(np.isfinite(t) & np.isfinite(values))
        good = good[np.argsort(t[good], kind="stable")]  # the newest row may come first
        return (t[good], values[good]) if len(good) > 20 else None

    def _shows(self, role: str, unit: str) -> bool:
        """Whether a unit says how large the numbers of a role are: a wheel's may be those of its rim."""
        return is_unit_of(role, unit) and (kind_of(role) != "rate" or unit not in units_of("command.v"))

    def raw(self, role: str) -> Signal | None:
        """The same as if it were in SI units already."""
        return self.signal(role, next(iter(UNITS[kind_of(role)])))

    def settle(self, role: str, reference: Signal | None, why: str, loose: float = ALIKE) -> None:
        """Find the unit in which a signal is as large as a reference."""
        one, mine = self.columns.get(role), self.raw(role)
        if one is None or is_unit_of(role, one.unit) or mine is None:
            return
        unit = _unit_like(mine, reference, UNITS[kind_of(role)], loose)
        if unit is not None:
            self.columns[role] = replace(one, unit=unit, why=f"{one.why}; {why}")

    def settle_wheels(self, reference: Signal | None) -> None:
        """Find whether wheel speeds are those of their rims: no wheel has a radius of a metre, or of a millimetre."""
        for stream in ("wheels", "command"):
            sides = [self.raw(f"{stream}.{side}") for side in ("left", "right")]
            if sides[0] is None or sides[1] is None or len(sides[0][0]) != len(sides[1][0]):
                continue
            mean = sides[0][0], (sides[0][1] + sides[1][1]) / 2
            unit = _unit_like(mean, reference, {one: UNITS["speed"][one] for one in ("m/s", "mm/s")}, ALIKE)
            for side in ("left", "right") if unit is not None else ():
                one = self.columns[f"{stream}.{side}"]
                if not is_unit_of(one.role, one.unit):
                    self.columns[one.role] = replace(one, unit=str(unit), why=f"{one.why}; as the vehicle moves")

    def settle_pose(self, stream: str) -> None:
        """Find the units of a pose: of its heading by what it follows, of its place by how fast it moves."""
        role = f"{stream}.yaw"
        if (one := self.columns.get(role)) and not is_unit_of(role, one.unit) and (mine := self.raw(role)):
            span = float(np.ptp(mine[1]))
            shown = _begun_anew(mine[1]) or self._along_path(stream, mine) or self._as_turned(mine)
            unit, why = shown or ("deg" if span > 30 else "rad", "its range")
            self.columns[role] = replace(one, unit=unit, why=f"{one.why}; {why}", assumed=shown is None,
                                         sure=one.sure and (shown is not None or span < TURNED), moves=span > TURNED)
        axes = [place for axis in ("x", "y") if (place := self.raw(f"{stream}.{axis}"))]
        rate = max((float(np.percentile(np.abs(_rate(*place)[1]), 90)) for place in axes), default=0.0)
        for role in (f"{stream}.x", f"{stream}.y"):
            if (one := self.columns.get(role)) and not is_unit_of(role, one.unit) and self.raw(role):
                self.columns[role] = replace(one, unit="mm" if rate > TOO_FAST else "m", why=f"{one.why}; its rate",
                                             assumed=rate <= TOO_FAST, moves=rate >= TOO_SLOW,
                                             sure=one.sure and not DOUBTFUL[0] < rate < DOUBTFUL[1])
        for role in (f"{stream}.{one}" for one in ("qx", "qy", "qz", "qw")):
            if one := self.columns.get(role):
                self.columns[role] = replace(one, unit="-")

    def _along_path(self, stream: str, yaw: Signal) -> tuple[str, str] | None:
        """The unit in which a heading follows the direction of the path, and why; None where several do, or none."""
        x, y = _together(self.raw(f"{stream}.x"), self.raw(f"{stream}.y"))
        if x is None or y is None:
            return None
        (t, dx), (_, dy) = (_rate(one[0], one[1], STEPPED) for one in (x, y))
        way, double = np.hypot(dx, dy), 2 * np.arctan2(dy, dx)  # twice the angle: it may drive backwards
        moving = way > 0.3 * np.percentile(way, 95)
        if not moving.any():
            return None
        apart = {}
        for unit in ("rad", "deg"):
            turned = 2 * np.interp(t, yaw[0], np.unwrap(yaw[1] * UNITS["angle"][unit]))
            both = [np.average(np.exp(1j * (double + sign * turned))[moving], weights=way[moving]) for sign in (-1, 1)]
            apart[unit] = 1 - float(np.abs(both).max())
        unit, other = sorted(apart, key=lambda one: apart[one])
        clear = apart[unit] < 1 - ALONG and apart[other] > CLEARER * apart[unit] + 0.01
        return (unit, "as the path turns") if clear else None

    def _as_turned(self, yaw: Signal) -> tuple[str, str] | None:
        """The unit in which a heading turns as fast as a yaw rate says, and why; None where neither is."""
        roles = [role for role in ("odometry.omega", "command.omega") if role in self.columns]
        for role in sorted(roles, key=lambda one: self.signal(one) is None):
            known, rate = self.signal(role), self.raw(role)
            if rate is None:
                continue
            size, why = UNITS["angle"]["deg"], f"as {role}"
            gains = {unit: _gain((yaw[0], np.unwrap(yaw[1] * UNITS["angle"][unit])), known or rate)
                     for unit in ("rad", "deg")}
            if near := [unit for unit, gain in gains.items() if _is_near(gain)]:
                both_degrees = known is None and near == ["rad"] and np.percentile(np.abs(rate[1]), 95) > LARGEST_SI
                return ("deg" if both_degrees else near[0]), why
            if known is None and _is_near(gains["rad"] / size):
                return "rad", why
        return None

    def heading(self, stream: str) -> Signal | None:
        """Times [s] and heading [rad] of a pose, without jumps."""
        parts = {one: part for one in ("qw", "qx", "qy", "qz") if (part := self.signal(f"{stream}.{one}"))}
        together = dict(zip(parts, _together(*parts.values()), strict=True)) if {"qw", "qz"} <= set(parts) else {}
        if together and together["qw"] is not None:
            t, w = together["qw"]
            x, y, z = (together[one][1] if one in together else np.zeros(len(t)) for one in ("qx", "qy", "qz"))
            return t, np.unwrap(yaw_of(w, x, y, z))
        yaw = self.signal(f"{stream}.yaw")
        return (yaw[0], np.unwrap(yaw[1])) if yaw else None


def _together(*signals: Signal | None) -> tuple[Any, ...]:
    """The signals at the times that all of them have; all None where one is, or where they share few."""
    shared: np.ndarray | None = None
    for one in signals:
        if one is None:
            return (None,) * len(signals)
        shared = np.unique(one[0]) if shared is None else np.intersect1d(shared, one[0])
    if shared is None or len(shared) <= 20:
        return (None,) * len(signals)
    return tuple((shared, one[1][np.searchsorted(one[0], shared)]) for one in signals if one is not None)


def _first(*signals: Signal | None) -> Signal | None:
    return next((one for one in signals if one is not None), None)


def _unit_like(mine: Signal, reference: Signal | None, units: Mapping[str, float], loose: float) -> str | None:
    """The unit in which a signal is as large as a reference; None where they are not alike or no unit fits."""
    if reference is None:
        return None
    t = _grid(mine[0], max(mine[0][0], reference[0][0]), min(mine[0][-1], reference[0][-1]))
    if len(t) < 40:
        return None
    ours, theirs = (np.abs(np.interp(t, *one)) for one in (mine, reference))
    if ours.max() < 1e-9 or theirs.max() < 1e-3:
        return None
    busy = np.convolve(ours > BUSY * np.percentile(ours, 99), np.ones(39), "same") > 0  # and 1 s around: it may be late
    if not busy.any():
        return None
    ratio = float(np.percentile(theirs[busy], 90) / max(np.percentile(ours[busy], 90), 1e-12))
    if ratio <= 0:
        return None
    apart: dict[str, float] = {}  # ft/s, for example, is too near to km/h for numbers to separate them
    for one, size in units.items():
        if all(abs(np.log(size / other)) > np.log(1 + ALIKE) for other in apart.values()):
            apart[one] = size
    unit = min(apart, key=lambda one: abs(np.log(ratio / apart[one])))
    return unit if abs(np.log(ratio / apart[unit])) < np.log(1 + loose) + 0.05 else None


def _begun_anew(yaw: np.ndarray) -> tuple[str, str] | None:
    """The unit in which a heading (T,) stays within a full turn and steps by one, and why; None where it does not."""
    span, step = float(np.ptp(yaw)), float(np.abs(np.diff(yaw)).max())
    for unit, turn in (("rad", 2 * np.pi), ("deg", 360.0)):
        if FULL_TURN * turn < step and span < 1.01 * turn:
            return unit, "its full turns"
    return None


def _gain(heading: Signal, rate: Signal) -> float:
    """How many times as fast a heading turns as a yaw rate says; 0 where it does not follow it."""
    t, turned = _rate(*heading)
    inside = (t >= rate[0][0]) & (t <= rate[0][-1])
    turned, said = turned[inside], np.interp(t[inside], *rate)
    size = float(np.linalg.norm(turned) * np.linalg.norm(said))
    if len(said) < 40 or np.abs(said).max() < 1e-3 or abs(turned @ said) <= FOLLOWED * size:
        return 0.0
    return abs(float(turned @ said / (said @ said)))


def _is_near(gain: float) -> bool:
    return 1 / SLIPPED < gain < SLIPPED


def _rate(t: np.ndarray, values: np.ndarray, over: float = 0.2) -> Signal:
    """Rate of a signal (T,) over so many seconds, at 20 Hz."""
    grid = _grid(t, t[0] + over / 2, t[-1] - over / 2)
    if len(grid) < 2:
        return t[:1], np.zeros(1)
    return grid, differenced(t, values, grid, over / 2)


def _grid(t: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Times at 20 Hz from `begin` to `end`, but for gaps of more than GAP in the samples' times (T,)."""
    if end <= begin:
        return np.zeros(0)
    inside = np.unique(np.concatenate([[begin], t[(t > begin) & (t < end)], [end]]))
    pieces = np.split(inside, np.flatnonzero(np.diff(inside) > GAP) + 1)
    return np.concatenate([np.arange(one[0], one[-1], 0.05) for one in pieces])


def _way(x: Signal | None, y: Signal | None) -> Signal | None:
    x, y = _together(x, y)
    if x is None or y is None:
        return None
    (t, vx), (_, vy) = _rate(*x), _rate(*y)
    return t, np.hypot(vx, vy)
