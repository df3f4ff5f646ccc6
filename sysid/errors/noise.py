"""What differs between two equal drives, the filter that makes it white, and how noisy channels are beside a reference.

The level of a channel is the median of second differences in time, of replicates' deviations from one another or else
of what the model leaves at constant commands. A missing effect is smooth and hardly shows in them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from sysid.logs.floor import last_change
from sysid.logs.records import Trial
from sysid.logs.replicates import same_course
from sysid.replay.arrays import added

ORDER = 4  # bins of memory of the filter
RIDGE = 2e-3  # of the regression, as a share of its data
USUAL = (0.01, 0.02, 0.02, 0.02, 0.03, 0.01)  # noise of the features where there are no replicates [m/s, rad/s]
BIN_SHIFT = 0.05  # s that the commands of two drives may be apart while their bins still correspond
FLOOR = 0.02  # least innovation of a channel, as a share of its standard deviation


@dataclass(frozen=True)
class Whitener:
    """x_t = sum_j A_j x_(t-j) + L e_t with e white and of unit size."""

    scale: np.ndarray  # (C,) standard deviation of each channel
    coefficients: np.ndarray  # (ORDER, C, C), of scaled channels
    inverse: np.ndarray  # (C, C) L^-1

    def apply(self, series: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """White series (B, K, C, ...) of such series; `mask`: (B, K, C) weights of the bins, 0 where nothing was
        measured."""
        extra = (1,) * (series.ndim - 3)
        shown = mask.reshape(*mask.shape, *extra)
        scaled = series / self.scale.reshape(-1, *extra) * shown
        white = scaled.copy()
        for lag, matrix in enumerate(self.coefficients, start=1):
            white = added(white, np.s_[:, lag:], -_mixed(matrix, scaled[:, :-lag]))
        return _mixed(self.inverse, white * (shown > 0))

    def flat(self, series: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """The same flat, (B, K C, ...)."""
        return self.apply(series, mask).reshape(len(mask), -1, *series.shape[3:])

    def scaled(self, factor: float | np.ndarray) -> Whitener:
        """The filter for noise that is larger by a factor, () or (C,)."""
        return Whitener(self.scale * factor, self.coefficients, self.inverse)


def _mixed(matrix: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Series (B, K, C, ...) whose channels are mixed by a matrix (C, C)."""
    flat = series.reshape(*series.shape[:3], -1)
    return (matrix @ flat).reshape(series.shape)


def fit_whitener(series: np.ndarray, mask: np.ndarray, order: int = ORDER) -> Whitener:
    """Whitener of noise series (B, K, C) by ridge regression of each bin on the `order` bins before it."""
    count = np.maximum((mask > 0).sum((0, 1)), 1)
    scale = np.sqrt(np.maximum(np.square(series * mask).sum((0, 1)) / count, 1e-12))
    scaled = series / scale * mask
    channels = series.shape[-1]
    past = np.concatenate([scaled[:, order - lag : -lag] for lag in range(1, order + 1)], axis=-1)
    now, weight = scaled[:, order:], mask[:, order:].prod(-1)
    rows = weight.reshape(-1) > 0
    x, y = past.reshape(-1, past.shape[-1])[rows], now.reshape(-1, channels)[rows]
    if len(x) < 10 * x.shape[-1]:  # too short to show a memory
        return Whitener(scale, np.zeros((order, channels, channels)), np.eye(channels))
    solution = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[-1]), x.T @ y)  # (order C, C)
    left = y - x @ solution
    covariance = left.T @ left / max(len(left) - x.shape[-1], 1) + FLOOR**2 * np.eye(channels)
    coefficients = solution.reshape(order, channels, channels).swapaxes(1, 2)
    return Whitener(scale, coefficients, np.linalg.inv(np.linalg.cholesky(covariance)))


ROUGH = (0.1, 0.5, 1.5)  # accelerations [m/s^2] between which a bin counts as ever rougher


def roughness(simulated: np.ndarray, width: float, track: float) -> np.ndarray:
    """(B, K) class of each bin, 0 to 3, by the largest acceleration of a wheel around it: where wheels are pulled hard
    they slip, and what a model leaves counts as noise of its own size. `simulated`: features; `width` of the bins
    [s]."""
    speeds = simulated[..., :2] * np.array([1.0, track / 2])
    change = np.abs(np.diff(speeds, axis=1, prepend=speeds[:, :1])).sum(-1) / width
    padded = np.pad(change, ((0, 0), (3, 1)))
    most = np.max([padded[:, shift : shift + change.shape[1]] for shift in range(5)], axis=0)
    return np.digitize(most, ROUGH)


def fit_roughness(series: np.ndarray, mask: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(4, C) size of the noise in each class beside that of the first, at least 1 and never falling."""
    channels = series.shape[-1]
    size = np.ones((len(ROUGH) + 1, channels))
    for c in range(channels):
        for k in range(len(ROUGH) + 1):
            chosen = (level == k) & (mask[..., c] > 0)
            size[k, c] = np.sqrt(np.mean(np.square(series[..., c][chosen]))) if chosen.sum() > 30 else np.nan
    known = np.where(np.isfinite(size), size, np.inf).min(0)
    first = np.where(np.isfinite(size[0]) & (size[0] > 0), size[0], np.where(np.isfinite(known), known, 1.0))
    factors = np.where(np.isfinite(size), size, 0.0) / np.maximum(first, 1e-12)
    return np.maximum(np.maximum.accumulate(factors, axis=0), 1.0)


def replicate_groups(trials: tuple[Trial, ...]) -> list[list[int]]:
    """Indices of trials with the same commands at the same time, so that their bins correspond, by first appearance."""
    return same_course(trials, BIN_SHIFT)


def courses_of(trials: Sequence[Trial]) -> np.ndarray:
    """(B,) number of the group of replicates that each trial is in."""
    courses = np.zeros(len(trials), int)
    for number, group in enumerate(replicate_groups(tuple(trials))):
        courses[group] = number
    return courses


def repeated(trials: Sequence[Trial]) -> bool:
    """Whether any trials are replicates."""
    return any(len(group) > 1 for group in replicate_groups(tuple(trials)))


def deviations(series: np.ndarray, groups: list[list[int]]) -> np.ndarray:
    """Series (B, K, C) less the mean of their replicates, scaled to a single drive's noise; 0 without a replicate."""
    out = np.zeros_like(series)
    for group in groups:
        if len(group) > 1:
            part = series[group]
            out[group] = (part - part.mean(0)) * np.sqrt(len(group) / (len(group) - 1))
    return out


def first_scales(target: np.ndarray, mask: np.ndarray, groups: list[list[int]]) -> Whitener:
    """Noise of each channel without a memory: what replicates do not share, or that of usual sensors."""
    part = deviations(target, groups)
    inside = [i for group in groups if len(group) > 1 for i in group]
    scale = np.array(USUAL[: target.shape[-1]])
    if len(inside) >= 3:
        count = np.maximum(mask[inside].sum((0, 1)), 1)
        found = np.sqrt((np.square(part[inside]) * mask[inside]).sum((0, 1)) / count)
        scale = np.where(found > 0, found, scale)
    channels = target.shape[-1]
    return Whitener(scale, np.zeros((1, channels, channels)), np.eye(channels))


def scatter(residual: np.ndarray, courses: np.ndarray) -> float:
    """Excess of what replicates do not share: mean square, less 1, of white residuals (B, n) about their courses'
    means; nan where no course (B,) was driven twice."""
    square, count = 0.0, 0.0
    for course in np.unique(courses):
        mine = residual[courses == course]
        measured = np.abs(mine).min(0) > 0
        square += float(np.square(mine - mine.mean(0))[:, measured].sum())
        count += (len(mine) - 1) * float(measured.sum())
    return square / count - 1 if count else float("nan")


SETTLED = 2.0  # s of constant commands after which a motion counts as steady
BLOCKS = 3  # independent parts of the drives that an error needs at least
BINS = 40  # of a channel that a size needs at least
CONFIDENCE = 0.95
SPOKEN = {"odometry.v": "reported speed", "odometry.omega": "reported yaw rate",
          "pose.forward": "outside pose, forward", "pose.left": "outside pose, sideways",
          "pose.yaw": "outside pose, heading", "gyro.omega": "gyro"}


@dataclass(frozen=True)
class NoisyDrives:
    """What the model leaves of some drives."""

    series: np.ndarray  # (B, K, C)
    weight: np.ndarray  # (B, K, C) that makes the noise of all bins alike; 0 where nothing was measured
    replicates: Sequence[Sequence[int]]  # trials that repeat one another on the same day
    steady: np.ndarray  # (B, K) bool


@dataclass(frozen=True)
class NoiseLevels:
    """The noise of each channel over that of the reference days."""

    channels: tuple[str, ...]
    factor: np.ndarray  # (C,) nan where one of the two was not measured
    error: float  # standard error of the factors' logarithms
    freedom: float  # degrees of freedom of that error
    changed: np.ndarray  # (C,) bool: surely another than on the reference days

    @property
    def louder(self) -> np.ndarray:
        """(C,) factors of the channels that surely are noisier, 1 of the others."""
        return np.where(self.changed & (np.nan_to_num(self.factor) > 1), self.factor, 1.0)

    @property
    def quieter(self) -> np.ndarray:
        """(C,) factors of the channels that surely are less noisy, 1 of the others."""
        return np.where(self.changed & ~(np.nan_to_num(self.factor) > 1), self.factor, 1.0)

    def interval(self, channel: int) -> tuple[float, float]:
        """95 % interval of a factor."""
        reach = np.exp(special.stdtrit(self.freedom, (1 + CONFIDENCE) / 2) * self.error)
        return float(self.factor[channel] / reach), float(self.factor[channel] * reach)

    def report(self) -> dict[str, dict[str, Any]]:
        """Channel -> factor, 95 % interval, and whether it surely is another than on the reference days."""
        return {name: {"factor": float(self.factor[c]), "interval": list(self.interval(c)),
                       "changed": bool(self.changed[c])}
                for c, name in enumerate(self.channels) if np.isfinite(self.factor[c])}


def noise_levels(ours: NoisyDrives, theirs: NoisyDrives, channels: Sequence[str], alpha: float) -> NoiseLevels | None:
    """Noise of some drives beside that of the reference's; None where too little was measured. `alpha`: probability
    that any channel counts as changed where the noise is as usual."""
    for parts in (_between_replicates, _in_steady_motion):
        mine, usual = _size(parts(ours)), _size(parts(theirs))
        if mine is None or usual is None:
            continue
        apart = mine.log - usual.log
        measured = np.isfinite(apart)
        if measured.any():
            error = float(np.hypot(mine.error, usual.error))
            freedom = float((min(mine.parts, usual.parts) - 1) * measured.sum())
            limit = special.stdtrit(freedom, 1 - alpha / (2 * len(channels))) * error
            return NoiseLevels(tuple(channels), np.exp(apart), error, freedom, np.nan_to_num(np.abs(apart)) > limit)
    return None


def steady_bins(trial: Trial, bins: int, width: float) -> np.ndarray:
    """(K,) bool: bins in which the commands have been constant for a while."""
    end = (np.arange(bins) + 1) * width
    return np.asarray(end - width - last_change(trial.command, end - 1e-6) >= SETTLED - 1e-6)


def said(levels: Mapping[str, Mapping[str, Any]], alone: bool) -> str:
    """The channels that changed in a sentence without its full stop, "" without any; `alone`: nothing else changed."""
    parts = []
    for name, one in levels.items():
        low, high = one["interval"]
        if one["changed"]:
            parts.append(f"the {SPOKEN.get(name, name)} is {one['factor']:.2g} times as noisy as on the reference days "
                         f"({low:.2g} to {high:.2g})")
    return "; ".join([*parts, *["nothing else has changed"] * (alone and bool(parts))])


Parts = list[tuple[np.ndarray, np.ndarray]]  # independent parts: series (n, K, C), and which bins count (n, K, C)


def _between_replicates(drives: NoisyDrives) -> Parts:
    parts = []
    apart = deviations(drives.series * drives.weight, [list(group) for group in drives.replicates])
    for group in (list(each) for each in drives.replicates if len(each) > 1):
        measured = (drives.weight[group] > 0).all(0)  # by all of them: else they differ by what was not measured
        parts.append((apart[group], np.broadcast_to(measured, apart[group].shape)))
    return parts


def _in_steady_motion(drives: NoisyDrives) -> Parts:
    seen = (drives.weight > 0) & drives.steady[..., None]
    return [(one[None], inside[None]) for one, inside in zip(drives.series * drives.weight, seen, strict=True)
            if inside.any()]


@dataclass(frozen=True)
class _Size:
    """Noise of some drives."""

    log: np.ndarray  # (C,) logarithm of its size, up to a constant; nan where not measured
    error: float  # standard error of all channels together: a few parts show it of one badly
    parts: int


def _size(parts: Parts) -> _Size | None:
    """Size of the noise, with its error by leaving out each part in turn; None where there are too few."""
    changes = [_changes(*one) for one in parts]
    if len(changes) < BLOCKS:
        return None
    size = _log_median(changes)
    if not np.isfinite(size).any():
        return None
    without = np.stack([_log_median([*changes[:i], *changes[i + 1 :]]) for i in range(len(changes))])
    count = len(without)
    variance = (count - 1) * np.square(without - without.mean(0)).mean(0)
    known = variance[np.isfinite(variance)]
    return _Size(size, float(np.sqrt(known.mean())), count) if len(known) else None


def _changes(series: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """Sizes of the second differences in time, channel by channel."""
    second = np.abs(np.diff(series, 2, axis=1))
    inside = seen[:, 2:] & seen[:, 1:-1] & seen[:, :-2]
    return [second[..., c][inside[..., c]] for c in range(series.shape[-1])]


def _log_median(parts: Sequence[list[np.ndarray]]) -> np.ndarray:
    values = [np.concatenate(each) for each in zip(*parts, strict=True)]
    middle = [np.median(each) if len(each) >= BINS else np.nan for each in values]
    return np.log(np.where(np.array(middle) > 0, middle, np.nan))
