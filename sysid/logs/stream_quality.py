"""Rates, gaps, repeated samples and clock offsets of measured streams.

Offsets come from shifting one signal against the other. Between command and motion a first-order lag, the vehicle's own
response, is fitted with the shift; the rest is clock offset and transport delay, which no drive can separate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid.logs.planar import added_up, differenced, half_span, turned_by
from sysid.logs.records import Command, OdometryStream, PoseStream, Trial, logged_pose

GRID_DT = 0.02  # s, of the signals that are compared
SMOOTHING = 0.2  # s, over which positions are differenced
LAGS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)  # s, first-order responses that are tried
GAP = 2.5  # sampling periods without a sample
MOVING = 0.05  # m/s or rad/s, above which a vehicle should not repeat its pose
MIN_SIGNAL = 0.03  # m/s, rad/s of standard deviation below which a channel shows no shift


@dataclass(frozen=True)
class StreamQuality:
    """How regularly one stream was sampled."""

    samples: int
    period: float  # median interval [s]
    jitter: float  # half the spread of the middle 90 % of the intervals that are no gaps [s]
    longest: float  # longest interval [s]
    gaps: int  # intervals longer than GAP periods
    missing: float  # share of samples that the mean interval outside gaps promises and the stream lacks
    held: float  # largest share of samples, of pose or speeds, that repeat while the command moves; nan for commands

    @property
    def rate(self) -> float:
        """Median rate [Hz]."""
        return 1.0 / self.period


def quality(
    t: np.ndarray, values: Sequence[np.ndarray] = (), moving: np.ndarray | None = None
) -> StreamQuality:
    """Sampling of a stream at times (T,) [s].

    Args:
        values: tables (T, C) whose repeated rows count, each for itself: a pose may be updated less often than speeds.
        moving: (T,) bool, where the vehicle should move: at rest it rightly repeats its pose.
    """
    steps = np.diff(t)
    period = float(np.median(steps))
    gaps = steps > GAP * period
    regular = steps[~gaps]
    low, high = np.percentile(regular, [5, 95]) if len(regular) else (period, period)
    held = np.nan
    if values and moving is not None:
        repeated = [((np.diff(table, axis=0) == 0).all(axis=1) & moving[1:]).sum() for table in values]
        held = float(max(repeated) / max(moving[1:].sum(), 1))
    expected = (t[-1] - t[0]) / (regular.mean() if len(regular) else period) + 1
    return StreamQuality(len(t), period, float(high - low) / 2, float(steps.max()), int(gaps.sum()),
                         float(max(1 - len(t) / expected, 0.0)), held)


def trial_quality(trial: Trial) -> dict[str, StreamQuality]:
    """Sampling of each stream of a trial that has at least two samples."""
    found = {name: quality(stream.t) for name, stream in (("command", trial.command), ("gyro", trial.gyro))
             if stream is not None and len(stream.t) > 1}
    for name, stream in (("odometry", trial.odometry), ("ground_truth", trial.ground_truth)):
        if stream is None or len(stream.t) < 2:
            continue
        values = [] if (pose := logged_pose(stream)) is None else [pose.values]
        if isinstance(stream, OdometryStream):
            values.append(np.column_stack([stream.v, stream.omega]))
        found[name] = quality(stream.t, values, _commanded(trial, stream.t))
    return found


def without_held(trial: Trial) -> Trial:
    """The trial without rows held between two updates, which would be scored again, each later than it was measured.

    An outside pose should move where the command does, a row of odometry where it reports a speed itself.
    """
    pose, odometry = trial.ground_truth, trial.odometry
    if pose is not None:
        trial = replace(trial, ground_truth=_new_rows(pose, _commanded(trial, pose.t)))
    if odometry is not None and logged_pose(odometry) is not None:
        trial = replace(trial, odometry=_new_rows(odometry, _moving(odometry.v, odometry.omega)))
    return trial


def _new_rows(stream: Any, moving: np.ndarray) -> Any:
    """The stream's rows that differ from the one before or are at rest; itself where all are, or hardly any is."""
    columns = vars(stream)
    repeated = np.all([np.diff(column) == 0 for name, column in columns.items() if name != "t"], axis=0)
    kept = np.append(True, ~repeated | ~moving[1:])
    return stream if kept.all() or kept.sum() < 2 else type(stream)(**{
        name: column[kept] for name, column in columns.items()})


def _commanded(trial: Trial, t: np.ndarray) -> np.ndarray:
    """(T,) whether the command at times (T,) is to move."""
    return _moving(*trial.command.at(t))


def _moving(v: np.ndarray, omega: np.ndarray) -> np.ndarray:
    return (np.abs(v) > MOVING) | (np.abs(omega) > MOVING)


@dataclass(frozen=True)
class Shift:
    """How much later a signal is than its reference."""

    delay: float  # [s]; positive where the signal comes later
    lag: float  # time constant of the first-order response that fits best [s]; 0 where none was asked for
    correlation: float  # of the two signals at this shift; negative where one has the other's sign reversed
    gain: float  # signal over reference at this shift


def find_shift(
    reference: np.ndarray, signal: np.ndarray, dt: float = GRID_DT, reach: float = 1.0, lags: tuple[float, ...] = (0.0,)
) -> Shift | None:
    """Shift of a signal (T,) against its reference (T,), both every dt seconds, within +-reach seconds.

    Of all shifts and lags the pair with the largest correlation, of either sign, is refined between grid points. None
    where a signal does not vary away from its ends, or where the best shift is as far as the search went.
    """
    count = round(reach / dt)
    if len(signal) < 4 * count or min(np.std(reference), np.std(signal)) < 1e-9:
        return None
    if np.std(reference[count:-count]) < 0.3 * np.std(reference):
        return None  # a step near an end moves out of sight with the shift
    target = signal[count:-count]
    slow = [_first_order(reference, lag, dt) for lag in lags]
    every = [np.abs(_correlations(one, target))[::-1] for one in slow]  # the earliest window is of the latest signal
    best = int(np.argmax([scores.max() for scores in every]))
    scores, k = every[best], int(np.argmax(every[best]))
    top, aligned = float(scores[k]), slow[best][2 * count - k : len(reference) - k]
    if k in (0, 2 * count) or not np.isfinite(top):
        return None
    left, right = scores[k - 1], scores[k + 1]
    bend = left - 2 * top + right
    fraction = 0.5 * (left - right) / bend if bend < 0 else 0.0
    centred = aligned - aligned.mean()
    gain = float(centred @ target / (centred @ centred))
    return Shift(float((k - count + fraction) * dt), float(lags[best]), float(np.copysign(top, gain)), gain)


def response_shift(trial: Trial, stream: str) -> dict[str, Shift]:
    """Shift of measured "v" and "omega" of a stream ("odometry", "ground_truth") against the commands."""
    rates = speeds(trial, stream)
    if rates is None:
        return {}
    pose = trial.ground_truth if stream == "ground_truth" else None
    when = rates[0] if pose is None else np.arange(pose.t[0], pose.t[-1] + GRID_DT, GRID_DT)
    commanded = list(trial.command.at(when, (0.0, 0.0)))
    if pose is not None:
        commanded = [_as_seen(when, one, pose, rates[0]) for one in commanded]
    return _shifts(commanded, rates[1:], lags=LAGS)


def clock_shift(trial: Trial) -> dict[str, Shift]:
    """How much later the outside pose shows "v" and "omega" than the odometry does."""
    odometry, pose, theirs = trial.odometry, trial.ground_truth, speeds(trial, "ground_truth")
    if odometry is None or len(odometry.t) < 2 or pose is None or theirs is None:
        return {}
    half = half_span(pose.t)
    inside = (theirs[0] >= odometry.t[0] + half) & (theirs[0] <= odometry.t[-1] - half)
    if inside.sum() < 2:
        return {}
    references = [_as_seen(odometry.t, rate, pose, theirs[0][inside]) for rate in (odometry.v, odometry.omega)]
    return _shifts(references, [one[inside] for one in theirs[1:]], reach=0.6)


def _shifts(references: Sequence[np.ndarray], signals: Sequence[np.ndarray], **how: Any) -> dict[str, Shift]:
    """`find_shift` of each signal (T,), of "v" and of "omega", that has a reference (T,) with something to compare."""
    return {name: shift for name, reference, signal in zip(("v", "omega"), references, signals, strict=True)
            if reference.std() > MIN_SIGNAL and (shift := find_shift(reference, signal, **how)) is not None}


def speeds(trial: Trial, stream: str, smooth: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Times (G,) [s] every GRID_DT with speed (G,) [m/s] and yaw rate (G,) [rad/s] of a stream; None where it has none.

    `smooth`: average the odometry over the time that a usual pose is differenced over.
    """
    source = trial.odometry if stream == "odometry" else trial.ground_truth
    if source is None or len(source.t) < 8 or source.t[-1] - source.t[0] < 4 * SMOOTHING:
        return None
    if isinstance(source, PoseStream):
        return _pose_speeds(source)
    grid, half = np.arange(source.t[0], source.t[-1], GRID_DT), SMOOTHING / 2
    v, omega = (np.interp(grid, source.t, values) for values in (source.v, source.omega))
    if not smooth:
        return grid, v, omega
    inside = grid[(grid >= grid[0] + half) & (grid <= grid[-1] - half)]
    v, omega = (differenced(grid, added_up(grid, one, grid), inside, half) for one in (v, omega))
    return inside, v, omega


def pose_jitter(trial: Trial) -> float:
    """Seconds by which the odometry's pose is out of step with its own speeds, as a standard deviation; nan where slow.

    A pose that is updated on one clock and sampled on another moves by uneven steps at a steady speed.
    """
    odometry, pose = trial.odometry, logged_pose(trial.odometry, 20)
    if odometry is None or pose is None:
        return float("nan")
    dt = np.diff(odometry.t)
    speed = np.abs(odometry.v[1:] + odometry.v[:-1]) / 2
    steady = (speed > 0.2) & (np.abs(np.diff(odometry.v)) < 0.05 * speed) & (dt < GAP * np.median(dt))
    if steady.sum() < 20:
        return float("nan")
    steps = np.hypot(np.diff(pose.x), np.diff(pose.y))[steady] / speed[steady]
    return float(np.std(steps / np.mean(steps / dt[steady]) - dt[steady]) / np.sqrt(2))


def standstill(command: Command, end: float) -> tuple[float, float]:
    """Seconds of standstill before the first command to move and after the last one, until `end`."""
    moving = np.flatnonzero((np.abs(command.v) > 1e-6) | (np.abs(command.omega) > 1e-6))
    if not len(moving):
        return end, end
    after = command.t[moving[-1] + 1] if moving[-1] + 1 < len(command.t) else end
    return float(max(command.t[moving[0]], 0.0)), float(max(end - after, 0.0))


def _as_seen(when: np.ndarray, rate: np.ndarray, pose: PoseStream, grid: np.ndarray) -> np.ndarray:
    """A rate (T,) at times `when` (T,) as `_pose_speeds` would show it (G,) on its grid (G,): what it adds up to, known
    at the times of the pose alone. A pose that comes seldom shows everything smoother, and so it must be compared."""
    return differenced(pose.t, added_up(when, rate, pose.t), grid, half_span(pose.t))


def _pose_speeds(pose: PoseStream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    half = half_span(pose.t)
    grid = np.arange(pose.t[0] + half, pose.t[-1] - half, GRID_DT)
    dx, dy, turn = (differenced(pose.t, column, grid, half) for column in (pose.x, pose.y, pose.yaw))
    yaw = np.interp(grid, pose.t, pose.yaw)
    return grid, turned_by(dx, dy, -yaw)[0], turn


def _correlations(values: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Correlations (T - M + 1,) of a target (M,) with all windows of values (T,) as long."""
    from scipy.signal import correlate

    centred, size = target - target.mean(), len(target)
    values = values - values.mean()
    sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (values, values**2)]
    total, squares = (one[size:] - one[:-size] for one in sums)
    power = np.maximum(squares - total**2 / size, 0.0) * float(centred @ centred)
    found = correlate(values, centred, mode="valid")
    return np.asarray(np.where(power > 1e-18, found / np.sqrt(np.maximum(power, 1e-18)), 0.0))


def _first_order(values: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Response (T,) of lag y' + y = u, for u that holds from each sample to the next."""
    if lag <= 0:
        return values
    from scipy.signal import lfilter

    keep = np.exp(-dt / lag)
    response = lfilter([1 - keep], [1, -keep], values[:-1], zi=[keep * values[0]])[0]
    return np.concatenate([values[:1], response])
