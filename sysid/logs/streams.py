"""Rates, gaps, repeated samples and clock offsets of measured streams.

Offsets come from shifting one signal against the other. Between command and motion a first-order lag, the vehicle's own
response, is fitted with the shift; the rest is clock offset and transport delay, which no drive can separate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sysid.logs.records import Command, OdometryStream, PoseStream, Trial

GRID_DT = 0.02  # s, of the signals that are compared
SMOOTHING = 0.2  # s, over which positions are differenced
LAGS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0)  # s, first-order responses that are tried
GAP = 2.5  # sampling periods without a sample
MOVING = 0.05  # m/s or rad/s, above which a vehicle should not repeat its pose
MIN_SIGNAL = {"v": 0.03, "omega": 0.03}  # m/s, rad/s of standard deviation below which a channel shows no shift


@dataclass(frozen=True)
class StreamQuality:
    """How regularly one stream was sampled."""

    samples: int
    period: float  # median interval [s]
    jitter: float  # half the spread of the middle 90 % of the intervals that are no gaps [s]
    longest: float  # longest interval [s]
    gaps: int  # intervals longer than GAP periods
    missing: float  # share of samples that the mean interval outside gaps promises and the stream lacks
    held: float
    """Share of samples that repeat the one before while the command moves: of the pose or of the speeds, whichever
    repeats more; nan for commands."""

    @property
    def rate(self) -> float:
        """Median rate [Hz]."""
        return 1.0 / self.period


def quality(
    t: np.ndarray, values: Sequence[np.ndarray] = (), moving: np.ndarray | None = None
) -> StreamQuality:
    """Sampling of a stream.

    Args:
        t: (T,) times [s], increasing.
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
    found = {}
    if len(trial.command.t) > 1:
        found["command"] = quality(trial.command.t)
    if trial.gyro is not None and len(trial.gyro.t) > 1:
        found["gyro"] = quality(trial.gyro.t)
    for name, stream in (("odometry", trial.odometry), ("ground_truth", trial.ground_truth)):
        if stream is None or len(stream.t) < 2:
            continue
        values = []
        if stream.x is not None and stream.y is not None and stream.yaw is not None:
            values.append(np.column_stack([stream.x, stream.y, stream.yaw]))
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
    if odometry is not None and not any(one is None for one in (odometry.x, odometry.y, odometry.yaw)):
        trial = replace(trial, odometry=_new_rows(odometry, _moving(odometry.v, odometry.omega)))
    return trial


def _new_rows(stream: Any, moving: np.ndarray) -> Any:
    """The stream's rows that differ from the one before or are at rest; itself where all are, or hardly any is."""
    columns = {one.name: getattr(stream, one.name) for one in fields(stream)}
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
    best: tuple[float, float, np.ndarray, int, np.ndarray] | None = None
    target = signal[count:-count]
    for lag in lags:
        slow = _first_order(reference, lag, dt)
        scores = np.abs(_correlations(slow, target))[::-1]  # the earliest window is that of the latest signal
        k = int(np.argmax(scores))
        if best is None or scores[k] > best[0]:
            best = (float(scores[k]), lag, scores, k, slow[2 * count - k : len(slow) - k])
    assert best is not None
    top, lag, scores, k, aligned = best
    if k in (0, 2 * count) or not np.isfinite(top):
        return None
    left, right = scores[k - 1], scores[k + 1]
    bend = left - 2 * top + right
    fraction = 0.5 * (left - right) / bend if bend < 0 else 0.0
    centred = aligned - aligned.mean()
    gain = float(centred @ target / (centred @ centred))
    return Shift(float((k - count + fraction) * dt), float(lag), float(np.copysign(top, gain)), gain)


def response_shift(trial: Trial, stream: str) -> dict[str, Shift]:
    """Shift of measured "v" and "omega" of a stream ("odometry", "ground_truth") against the commands."""
    rates = speeds(trial, stream)
    if rates is None:
        return {}
    pose = trial.ground_truth if stream == "ground_truth" else None
    when = rates[0] if pose is None else np.arange(pose.t[0], pose.t[-1] + GRID_DT, GRID_DT)
    found = {}
    for name, commanded, measured in zip(("v", "omega"), trial.command.at(when, (0.0, 0.0)), rates[1:], strict=True):
        if pose is not None:
            commanded = _as_seen(when, commanded, pose, rates[0])
        if commanded.std() > MIN_SIGNAL[name] and (shift := find_shift(commanded, measured, lags=LAGS)) is not None:
            found[name] = shift
    return found


def clock_shift(trial: Trial) -> dict[str, Shift]:
    """How much later the outside pose shows "v" and "omega" than the odometry does."""
    odometry, pose, theirs = trial.odometry, trial.ground_truth, speeds(trial, "ground_truth")
    if odometry is None or len(odometry.t) < 2 or pose is None or theirs is None:
        return {}
    half = _half_span(pose)
    inside = (theirs[0] >= odometry.t[0] + half) & (theirs[0] <= odometry.t[-1] - half)
    grid, found = theirs[0][inside], {}
    for name, rate, signal in (("v", odometry.v, theirs[1]), ("omega", odometry.omega, theirs[2])):
        reference = _as_seen(odometry.t, rate, pose, grid)
        if (inside.sum() > 1 and reference.std() > MIN_SIGNAL[name]
                and (shift := find_shift(reference, signal[inside], reach=0.6)) is not None):
            found[name] = shift
    return found


def speeds(trial: Trial, stream: str, smooth: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Times (G,) [s] every GRID_DT with speed (G,) [m/s] and yaw rate (G,) [rad/s] of a stream; None where it has none.

    `smooth`: average the odometry over the time that a usual pose is differenced over.
    """
    source = trial.odometry if stream == "odometry" else trial.ground_truth
    if source is None or len(source.t) < 8 or source.t[-1] - source.t[0] < 4 * SMOOTHING:
        return None
    if isinstance(source, PoseStream):
        return _pose_speeds(source)
    grid = np.arange(source.t[0], source.t[-1], GRID_DT)
    columns = [np.interp(grid, source.t, values) for values in (source.v, source.omega)]
    if smooth:
        half = SMOOTHING / 2
        columns = [_mean_over(grid, column, half) for column in columns]
        inside = (grid >= grid[0] + half) & (grid <= grid[-1] - half)
        return grid[inside], columns[0][inside], columns[1][inside]
    return grid, columns[0], columns[1]


def pose_jitter(trial: Trial) -> float:
    """Seconds by which the odometry's pose is out of step with its own speeds, as a standard deviation; nan where slow.

    A pose that is updated on one clock and sampled on another moves by uneven steps at a steady speed.
    """
    odometry = trial.odometry
    if odometry is None or odometry.x is None or odometry.y is None or len(odometry.t) < 20:
        return float("nan")
    dt = np.diff(odometry.t)
    speed = np.abs(odometry.v[1:] + odometry.v[:-1]) / 2
    steady = (speed > 0.2) & (np.abs(np.diff(odometry.v)) < 0.05 * speed) & (dt < GAP * np.median(dt))
    if steady.sum() < 20:
        return float("nan")
    steps = np.hypot(np.diff(odometry.x), np.diff(odometry.y))[steady] / speed[steady]
    return float(np.std(steps / np.mean(steps / dt[steady]) - dt[steady]) / np.sqrt(2))


def standstill(command: Command, end: float) -> tuple[float, float]:
    """Seconds of standstill before the first command to move and after the last one, until `end`."""
    moving = np.flatnonzero((np.abs(command.v) > 1e-6) | (np.abs(command.omega) > 1e-6))
    if not len(moving):
        return end, end
    after = command.t[moving[-1] + 1] if moving[-1] + 1 < len(command.t) else end
    return float(max(command.t[moving[0]], 0.0)), float(max(end - after, 0.0))


def _half_span(pose: PoseStream) -> float:
    """Half of the time over which a pose is differenced [s]."""
    return max(SMOOTHING / 2, float(np.median(np.diff(pose.t))))


def _as_seen(when: np.ndarray, rate: np.ndarray, pose: PoseStream, grid: np.ndarray) -> np.ndarray:
    """A rate (T,) at times `when` (T,) as `_pose_speeds` would show it (G,) on its grid (G,): what it adds up to, known
    at the times of the pose alone. A pose that comes seldom shows everything smoother, and so it must be compared."""
    way, half = added_up(when, rate, pose.t), _half_span(pose)
    return np.asarray(np.interp(grid + half, pose.t, way) - np.interp(grid - half, pose.t, way)) / (2 * half)


def _pose_speeds(pose: PoseStream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    half = _half_span(pose)
    grid = np.arange(pose.t[0] + half, pose.t[-1] - half, GRID_DT)

    def at(t: np.ndarray, column: np.ndarray) -> np.ndarray:
        return np.interp(t, pose.t, column)

    dx, dy, turn = (at(grid + half, column) - at(grid - half, column) for column in (pose.x, pose.y, pose.yaw))
    yaw = at(grid, pose.yaw)
    return grid, (np.cos(yaw) * dx + np.sin(yaw) * dy) / (2 * half), turn / (2 * half)


def _mean_over(t: np.ndarray, values: np.ndarray, half: float) -> np.ndarray:
    """Mean of values over t - half to t + half, by the integral."""
    integral = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(t))])
    return (np.interp(t + half, t, integral) - np.interp(t - half, t, integral)) / (2 * half)


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


def added_up(when: np.ndarray, rate: np.ndarray, t: np.ndarray) -> np.ndarray:
    """What a rate (T,) at times `when` (T,) [s] adds up to at times t (M,) from its first; before it was as then."""
    added = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(when))])
    return np.asarray(np.interp(t, when, added) + np.minimum(t - when[0], 0.0) * rate[0])
