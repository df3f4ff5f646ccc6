"""Long drives in windows, each from where the vehicle was measured to be.

Over minutes an open-loop replay drifts by more than any parameter moves it, and a single drive shows no noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.logs.records import Command, Log, Start, Trial, cell_of, logged_pose, seen_from
from sysid.logs.replicates import same_course

WINDOW = 20.0
"""Greatest length of a window [s]: long for a vehicle's delays, lags and turns, short for the drift of a replay."""
LONG = 6 * WINDOW  # length from which a drive is cut [s]
AROUND = 0.25
"""Time before and after a window's start [s] over which its speeds, and its pose from outside, are taken as a line."""
TINY = 1e-9


def in_windows(log: Log) -> Log:
    """The log with its long drives in windows, and a note. Repeated drives stay whole: they show the noise."""
    if all(trial.duration < LONG for trial in log.trials):
        return log
    again = {log.trials[i].name for group in same_course(log.trials) if len(group) > 1 for i in group}
    trials: list[Trial] = []
    notes = list(log.notes)
    for trial in log.trials:
        if trial.duration < LONG or trial.name in again:
            trials.append(trial)
            continue
        length = trial.duration / np.ceil(trial.duration / WINDOW - TINY)  # equal ones, so that no end is lost
        count = round(trial.duration / length)
        parts = [one for k in range(count) if (one := _window(trial, k, length)) is not None]
        trials += parts
        notes.append(f"{trial.name} lasts {trial.duration:.0f} s: it is taken as {len(parts)} windows of "
                     f"{length:.3g} s, each from where it was measured to be")
    return replace(log, trials=tuple(trials), notes=tuple(notes))


def _window(trial: Trial, number: int, length: float) -> Trial | None:
    """The window of that number; the trial's own start for the first one. None where hardly anything was measured."""
    begin, end = number * length, (number + 1) * length
    end += TINY if end > trial.duration - TINY else 0.0  # its last sample counts
    path = trial.ground_truth
    if path is not None:  # it begins at a pose that was measured
        later = path.t[(path.t >= begin) & (path.t < end)]
        if len(later) < 2:
            return None
        begin = float(later[0]) if number else 0.0
    start, odometry = trial.start, trial.odometry
    if number:
        start = _start(trial, begin)
        if (pose := logged_pose(odometry)) is not None and odometry is not None:  # counted from where it was then
            odometry = replace(odometry, **vars(pose.seen_from(*(float(np.interp(begin, pose.t, one))
                                                                 for one in pose.values.T))))
    streams = [None if one is None else _between(one, begin, end) for one in (path, odometry, trial.gyro)]
    if not any(one is not None and len(one.t) > 1 for one in streams[:2]):
        return None
    breaks = tuple((a - begin, b - begin) for a, b in trial.breaks if a < end and b > begin)
    window = replace(trial, name=f"{trial.name}/{number:03d}", command=_commands(trial.command, begin, end),
                     start=start, ground_truth=streams[0], odometry=streams[1], gyro=streams[2], breaks=breaks)
    return seen_from(window, cell_of(start))


def _commands(command: Command, begin: float, end: float) -> Command:
    """What is commanded from `begin` until `end`, from 0 on: the command in force comes first."""
    inside = np.flatnonzero((command.t > begin) & (command.t < end))
    held = int(np.searchsorted(command.t, begin, side="right")) - 1
    rows = np.append(held, inside) if held >= 0 else inside
    if not len(rows):
        return Command(np.zeros(1), np.zeros(1), np.zeros(1))
    return Command(np.maximum(command.t[rows] - begin, 0.0), command.v[rows], command.omega[rows])


def _start(trial: Trial, begin: float) -> Start:
    """Pose and speeds where a window begins: of lines through what was measured around it."""
    path, odometry = trial.ground_truth, trial.odometry
    start = Start()
    if path is not None:
        (x, y, yaw), (vx, vy, omega), (error, turned) = _line(path.t - begin, path.values)
        v = vx * np.cos(yaw) + vy * np.sin(yaw)
        start = Start(x, y, yaw, float(v), omega, position_sigma=error, yaw_sigma=turned, measured=True)
    if odometry is not None:
        (v, omega), _, _ = _line(odometry.t - begin, np.stack([odometry.v, odometry.omega], axis=-1))
        start = replace(start, v=v, omega=omega)
    return start


def _line(t: np.ndarray, values: np.ndarray) -> tuple[Sequence[float], Sequence[float], tuple[float, float]]:
    """Values (C,) at 0 and slopes (C,) of lines through samples (T, C) around it, and the standard errors of the first
    two and of the last of these values; of the nearest sample where there are too few."""
    near = np.abs(t) <= AROUND
    if near.sum() < 4:
        first = int(np.argmin(np.abs(t)))
        pair = np.array([max(first - 1, 0), min(first + 1, len(t) - 1)])
        slope = np.diff(values[pair], axis=0)[0] / max(float(np.diff(t[pair])[0]), TINY)
        return values[first].tolist(), slope.tolist(), (0.0, 0.0)
    design = np.column_stack([np.ones(near.sum()), t[near]])
    found = np.linalg.lstsq(design, values[near], rcond=None)[0]
    left = np.square(values[near] - design @ found).sum(axis=0) / (near.sum() - 2)
    error = np.sqrt(left * np.linalg.pinv(design.T @ design)[0, 0])
    return found[0].tolist(), found[1].tolist(), (float(np.sqrt(np.mean(error[:2] ** 2))), float(error[-1]))


def _between(stream: Any, begin: float, end: float) -> Any:
    """Samples of a stream from `begin` until `end`, from 0 on; None where there are none."""
    inside = (stream.t >= begin) & (stream.t < end)
    if not inside.any():
        return None
    columns = {name: None if column is None else column[inside] for name, column in vars(stream).items()}
    return type(stream)(**{**columns, "t": stream.t[inside] - begin})
