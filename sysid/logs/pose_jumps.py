"""Poses that no vehicle drives: jumps from one row to the next, rows that stand still, columns that never change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.logs.records import Trial

JUMP = (0.1, 3.0)  # m or rad, and times the way that the speed gives, of a step that is a jump
RARE = (3, 0.05)  # jumps of one drive, and of the rows of an outside pose; more are noise
HELD = 0.5  # s for which rows repeat before a jump when a driver was held up
FROZEN = 1.0  # s for which rows repeat that is longer than a driver takes between two updates
STILL = 1e-3  # m/s and rad/s below which a speed is none
MOVED = 0.5  # m and rad that a vehicle goes and turns by when each of its columns must change


def jumps(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on steps of a pose that its speeds do not allow."""
    found = [(trial, at) for trial in trials if len(at := _jumps_of(name, trial))]
    if not found:
        return []
    trial, at = found[0]
    stream, first = getattr(trial, name), int(at[0])
    sizes = [(abs(float(np.hypot(*(np.diff(one)[first] for one in (stream.x, stream.y))))), "m")]
    sizes += [] if stream.yaw is None else [(abs(float(np.diff(stream.yaw)[first])), "rad")]
    size = " and ".join(f"{step:.2f} {unit}" for step, unit in sizes if step > JUMP[0])
    said = (f"{name}: in {len(found)} of {len(trials)} trials ({trial.name}, at {stream.t[first + 1]:.1f} s) its pose "
            f"jumps by {size} from one row to the next, ")
    if name == "ground_truth":
        return [f"{said}faster than it moves elsewhere: tracking was lost, or took another body for the vehicle. Leave "
                "those rows out, or split the trial there."]
    if (held := _held_before(stream, first)) > HELD:
        return [f"{said}after rows that repeat for {held:.1f} s: its driver was held up. Split the trial there."]
    return [f"{said}which its speeds do not: it was reset there. Split the trial there."]


def _jumps_of(name: str, trial: Trial) -> np.ndarray:
    """Rows before the jumps (J,) of a stream of a trial; none where there are so many that they are noise."""
    stream, odometry, none = getattr(trial, name), trial.odometry, np.zeros(0, int)
    if stream is None or stream.x is None or stream.y is None or len(stream.t) < 20:
        return none
    dt = np.diff(stream.t)
    steps = [np.hypot(np.diff(stream.x), np.diff(stream.y))]
    steps += [] if stream.yaw is None else [np.abs(np.diff(stream.yaw))]
    found = np.zeros(len(dt), bool)
    for step, speed in zip(steps, ("v", "omega"), strict=False):
        usual = float(np.percentile(step / dt, 95)) * dt
        if odometry is not None:
            rate = np.abs(np.interp(stream.t, odometry.t, getattr(odometry, speed)))
            way = np.maximum(rate[1:], rate[:-1]) * dt
            usual = np.maximum(usual, np.max([np.roll(way, shift) for shift in (-2, -1, 0, 1, 2)], axis=0))
        found |= step > JUMP[0] + JUMP[1] * usual  # rows held up catch up at once
    most = RARE[0] if name == "odometry" else max(RARE[0], RARE[1] * len(dt))
    at = np.flatnonzero(found)
    return at if len(at) <= most else none


def _held_before(stream: Any, row: int) -> float:
    """For how long rows repeat up to one [s]."""
    rows = np.stack([stream.x, stream.y], axis=-1)[: row + 1]
    other = np.flatnonzero((rows != rows[-1]).any(axis=1))
    return float(stream.t[row] - stream.t[other[-1] + 1 if len(other) else 0])


def frozen(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on a pose that stands still while another stream shows that the vehicle drives on."""
    found = [(trial, *span) for trial in trials if (span := _frozen_of(name, trial)) is not None]
    if not found:
        return []
    trial, begin, end, other, way = found[0]
    return [f"{name}: in {len(found)} of {len(trials)} trials ({trial.name}, from {begin:.1f} to {end:.1f} s) its rows "
            f"repeat while the {other} moves on by {way:.1f} m: nothing was measured there. Leave these rows "
            "out."]


def _frozen_of(name: str, trial: Trial) -> tuple[float, float, str, float] | None:
    """Begin and end [s] of the longest time in which a pose repeats, what moves on meanwhile, and how far."""
    stream = getattr(trial, name)
    other = "odometry" if name == "ground_truth" else "ground_truth"
    beside = getattr(trial, other)
    if stream is None or beside is None or beside.x is None:
        return None
    if stream.x is None or stream.y is None or stream.yaw is None:
        return None
    same = (np.diff(stream.x) == 0) & (np.diff(stream.y) == 0) & (np.diff(stream.yaw) == 0)
    if name == "odometry":  # at rest it repeats as well
        same &= (np.abs(stream.v[:-1]) > STILL) | (np.abs(stream.omega[:-1]) > STILL)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    runs = [(float(stream.t[a]), float(stream.t[b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    begin, end = max(runs, key=lambda one: one[1] - one[0], default=(0.0, 0.0))
    inside = (beside.t >= begin) & (beside.t <= end)
    if end - begin < FROZEN or inside.sum() < 2:
        return None
    steps = np.stack([np.diff(one[inside]) for one in (beside.x, beside.y)])
    steps[:, np.isin(np.flatnonzero(inside)[:-1], _jumps_of(other, trial))] = 0.0  # no vehicle drives these
    way = float(np.hypot(*np.ptp(np.cumsum(steps, axis=1), axis=1)))
    return (begin, end, other, way) if way > MOVED else None


def constant_columns(name: str, trials: Sequence[Trial]) -> list[str]:
    """A sentence on a pose of which one column never changes, though the vehicle drives and turns."""
    moving = [stream for trial in trials if (stream := getattr(trial, name)) is not None and _moves(trial)]
    for column in ("yaw", "x", "y"):
        values = [getattr(one, column) for one in moving]
        if not values or any(one is None or np.ptp(one) > 0 for one in values):
            continue
        remedy = ("the column is empty. Record the heading, or leave the pose out" if column == "yaw" else
                  "is another axis up? Take the two axes of the floor")
        return [f"{name}: its {column} never changes, though the vehicle drives and turns: {remedy}."]
    return []


def _moves(trial: Trial) -> bool:
    """Whether a vehicle is commanded to go and to turn so far that each column of its pose changes."""
    command = trial.command
    hold = np.diff(np.append(command.t, max(trial.duration, float(command.t[-1]))))
    return all(float((np.abs(one) * hold).sum()) > MOVED for one in (command.v, command.omega))
