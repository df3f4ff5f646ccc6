"""Streams out of tables: rows in order of time, in SI units, as v and omega and as a pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.logs.directions import RESPONSE, VARIED
from sysid.logs.planar import (
    DIFFERENCED,
    integrate_speeds,
    pose_speeds,
    rates_left_at_zero,
    twist_of_wheels,
    without_wraps,
    yaw_of,
)
from sysid.logs.records import Command
from sysid.logs.tables.columns import UNITS, Column, Table
from sysid.logs.tables.text_table import ONE_SIDE
from whill_mjx.io.fields import counted

FOLLOWED, UNFOLLOWED = 0.7, 0.5  # correlation with a command of what follows it, and of what does not
BACK = (3.0, 0.1)  # usual steps, and s, by which a row may be older than the one before it: it came out of order


def stream_rows(
    stream: str, tables: Sequence[Table], columns: Sequence[Column]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Rows of a stream in SI units in order of time, by quantity and "t", without those with an empty cell; notes.

    Columns in several files are brought to one clock.
    """
    mine = [one for one in columns if one.role.startswith(f"{stream}.")]
    parts, notes = list[tuple[str, dict[str, np.ndarray]]](), list[str]()
    for file in dict.fromkeys(one.file for one in mine):
        found, said = _rows_of_file(stream, file, next(one for one in tables if one.stem == file), columns)
        parts.append((file, found))
        notes += said
    if len(parts) < 2:
        return parts[0][1] if parts else {}, notes
    found, said = _joined(stream, parts)
    return found, notes + said


def _joined(
    stream: str, parts: Sequence[tuple[str, dict[str, np.ndarray]]]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns of a stream that are in several files: commands hold until the next row of their file, what was
    measured is interpolated to the rows of the file that has most columns."""
    main, rows = max(parts, key=lambda part: len(part[1]))
    others = [part for part in parts if part[0] != main]
    begin, end = (pick(one["t"][at] for _, one in parts) for pick, at in ((max, 0), (min, -1)))
    held = stream == "command"
    t = np.unique(np.concatenate([one["t"] for _, one in parts])) if held else rows["t"]
    t = t[t >= begin] if held else t[(t >= begin) & (t <= end)]
    if len(t) < 2:
        spans = "; ".join(f"{file} {one['t'][0]:.3f} to {one['t'][-1]:.3f} s" for file, one in parts)
        raise ValueError(f"the columns of {stream} are in files that share no time ({spans}). Put them on one clock "
                         "first.")
    found = {"t": t}
    for _, one in parts:
        at = np.searchsorted(one["t"], t, side="right") - 1
        for key, values in one.items():
            if key != "t":  # headings have no wraps already
                smooth = without_wraps(values) if key.endswith("_angle") else values
                found[key] = values[at] if held else np.interp(t, one["t"], smooth)
    what = "hold until the next row of their file" if held else f"are interpolated to the times of {main}"
    return found, [f"{stream}: {', '.join(sorted(set(one) - {'t'}))} of {file} {what}" for file, one in others]


def _rows_of_file(
    stream: str, file: str, table: Table, columns: Sequence[Column]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """As `stream_rows`, of the columns in one file."""
    mine = [one for one in columns if one.role.startswith(f"{stream}.") and one.file == file]
    clock = next(one for one in columns if one.role == "time" and one.file == file)
    found = {"t": clock.in_si(table.columns[clock.name]),
             **{one.role.partition(".")[2]: one.in_si(table.columns[one.name]) for one in mine}}
    if stream == "command":  # a logger that writes what changed leaves the cell of the other part empty
        sent = np.isfinite([found[key] for key in found if key != "t"]).any(axis=0)
        found = {key: values[sent] if key == "t" else _held(values[sent]) for key, values in found.items()}
    known = np.isfinite([found[key] for key in found if key != "t"]).all(axis=0)
    timeless = known & ~np.isfinite(found["t"])
    found = {key: values[known & ~timeless] for key, values in found.items()}
    found, unset = _with_orientation(found)
    notes = _check_clock(file, found["t"])
    if timeless.any():
        notes.append(f"{file}: {counted(int(timeless.sum()), 'row')} of {stream} without a time left out")
    if unset:
        notes.append(f"{file}: {counted(unset, 'row')} of {stream} with an orientation that is all zero left out")
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
        level = np.zeros(len(found["t"]))  # of a vehicle on a floor qx and qy are often left out
        if "qx" in found and np.mean(found["qx"] ** 2 + found.get("qy", level) ** 2) > ONE_SIDE:
            notes.append(f"{file}: by its quaternion the vehicle lies on its side in {stream}: its columns may be in "
                         "the order w, x, y, z. Say which is which with --columns")
        found["yaw"] = yaw_of(found["qw"], found.get("qx", level), found.get("qy", level), found["qz"])
    if "yaw" in found:
        found["yaw"] = np.unwrap(found["yaw"])
    return found, notes


def _with_orientation(found: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], int]:
    """The rows (T,) that have an orientation, and how many have a quaternion of zeros; all rows where none has one."""
    parts = [found[name] for name in ("qx", "qy", "qz", "qw") if name in found]
    known = np.any(parts, axis=0) if "qw" in found else np.ones(len(found["t"]), bool)
    if not known.any():
        return found, 0
    return {key: values[known] for key, values in found.items()}, int((~known).sum())


def _held(values: np.ndarray) -> np.ndarray:
    """Values (T,) each of which holds until the next one, in place of nan."""
    latest = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[latest])


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


def with_rates(
    wheels: dict[str, np.ndarray], columns: Sequence[Column]
) -> tuple[dict[str, np.ndarray], list[Column], list[str]]:
    """Wheel speeds, from angles where only these were measured; the columns that count, and notes."""
    sides, angles = ("left", "right"), ("left_angle", "right_angle")
    unfilled = {*sides, *angles} <= set(wheels) and rates_left_at_zero(
        *(np.column_stack([wheels[one] for one in pair]) for pair in (angles, sides)))
    if set(sides) <= set(wheels) and not unfilled:
        return wheels, list(columns), []
    found = {side: np.gradient(without_wraps(wheels[angle]), wheels["t"])
             for side, angle in zip(sides, angles, strict=True)}
    return ({"t": wheels["t"], **found},
            [one for one in columns if one.role not in ("wheels.left", "wheels.right")],
            ["the speeds of the wheels are all 0: taken from their angles"] if unfilled else [])


def as_twist(rates: dict[str, np.ndarray], columns: Sequence[Column], stream: str,
              geometry: tuple[float, float]) -> np.ndarray:
    """(T, 3) of t, v and omega of a command, or of the speeds of two wheels."""
    if "left" not in rates:
        return np.column_stack([rates["t"], rates["v"], rates.get("omega", 0 * rates["t"])])
    of_rims = {one.role for one in columns if one.unit in UNITS["speed"]}
    left, right = (rates[side] * (1.0 if f"{stream}.{side}" in of_rims else geometry[0]) for side in ("left", "right"))
    return np.column_stack([rates["t"], *twist_of_wheels(left, right, 1.0, geometry[1])])


def backward_wheel(command: np.ndarray, wheels: np.ndarray) -> str:
    """The wheel, "left" or "right", whose difference from the other one follows the commanded speed as their mean
    should; empty where it is not so. Rows (T, 3) of t, v and omega."""
    sent = Command(*command.T).at(wheels[:, 0] - RESPONSE, (0.0, 0.0))[0]
    if sent.std() < VARIED or min(wheels[:, 1].std(), wheels[:, 2].std()) == 0.0:  # their unit may be another
        return ""
    mean, difference = (float(np.corrcoef(sent, wheels[:, k])[0, 1]) for k in (1, 2))
    if abs(difference) < FOLLOWED or abs(mean) > UNFOLLOWED:
        return ""
    return "left" if difference > 0 else "right"


def as_odometry(odometry: dict[str, np.ndarray], wheels: np.ndarray | None) -> tuple[np.ndarray, str]:
    """(T, 6) rows of an odometry, and a note on what was computed."""
    t = odometry["t"]
    note = ""
    if not {"x", "y", "yaw"} <= set(odometry):
        if not {"v", "omega"} <= set(odometry):
            raise ValueError("the odometry has no heading. Name its yaw or its quaternion with --columns.")
        return dead_reckoned(np.column_stack([t, odometry["v"], odometry["omega"]])), (
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


def dead_reckoned(rates: np.ndarray) -> np.ndarray:
    """(T, 6) odometry of speeds (T, 3)."""
    return np.column_stack([rates[:, 0], *integrate_speeds(*rates.T), rates[:, 1:]])
